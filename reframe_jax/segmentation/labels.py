"""Which segments have the same constraint."""

import numpy as np

from reframe_jax.identification.results import Identification
from reframe_jax.segmentation.blocks import Blocks
from reframe_jax.segmentation.spans import Fits, fit_spans

__all__ = ["label_segments"]


def label_segments(
    blocks: Blocks,
    spans: np.ndarray,
    fits: Fits,
    found: list[Identification | None],
    options: tuple[float, float],
) -> list[int]:
    """Number the constraints in order of appearance, the same number where the same one comes back.

    Segments of one class have the same constraint if one frame costs less for all their motions than a frame
    for each. Free motion has no frame: all of it is the same. Neighbours differ: there would be no boundary
    between them otherwise.

    Args:
        blocks: of the recording.
        spans: (S, 2) blocks of the segments.
        fits: of the segments.
        found: their identifications; None for those too short.
        options: noise ratio and reach, as in :func:`fit_spans`.
    """
    classes = [_class_of(one) for one in found]
    groups: list[list[int]] = []
    costs: list[float] = []
    for i, own in enumerate(classes):
        alike = [
            k
            for k, group in enumerate(groups)
            if own is not None and classes[group[0]] == own and group[-1] != i - 1
        ]
        if alike and own == (3, 3):
            groups[alike[0]].append(i)
            continue
        pieces = [[(int(a), int(b)) for a, b in spans[[*groups[k], i]]] for k in alike]
        together = fit_spans(blocks, pieces, *options).cost if alike else np.zeros(0)
        gains = [costs[k] + fits.cost[i] - cost for k, cost in zip(alike, together, strict=True)]
        if gains and max(gains) > 0:
            best = int(np.argmax(gains))
            groups[alike[best]].append(i)
            costs[alike[best]] = float(together[best])
        else:
            groups.append([i])
            costs.append(float(fits.cost[i]))
    labels = [0] * len(classes)
    for number, group in enumerate(groups):
        for i in group:
            labels[i] = number
    return labels


def _class_of(found: Identification | None) -> tuple[int, int] | None:
    """Numbers of free rotations and translations."""
    if found is None:
        return None
    return int(np.sum(found.angular.dof)), int(np.sum(found.linear.dof))

"""Borders to the sample: where the one model explains the poses better, and where the other."""

import numpy as np

from reframe_jax.segmentation.bank import misfit
from reframe_jax.segmentation.cells import Cells, path_features
from reframe_jax.segmentation.constants import SEGMENTS as C
from reframe_jax.segmentation.pieces import Piece

__all__ = ["place_border"]

_INTERVAL = 0.025, 0.975


def place_border(
    cells: Cells, rotation: np.ndarray, position: np.ndarray, before: Piece, after: Piece
) -> tuple[int, int, int]:
    """The pose at which the second piece begins.

    Args:
        cells: of the recording.
        rotation: (P, 3, 3) of all poses.
        position: (P, 3) m, of all poses.
        before: the piece that ends there.
        after: the piece that begins.

    Returns:
        Index of that pose, the likeliest, and the two indices between which it lies with 95 %.
    """
    samples = cells.samples
    near = round(C.cells) + 1
    first, last = (
        max(before.start, before.stop - 4 * near) * samples,
        min(after.stop, after.start + 4 * near) * samples,
    )
    # at most half of each piece, so that borders keep their order
    low = max((before.start + before.stop) * samples // 2, (before.stop - near) * samples) - first
    high = min((after.start + after.stop) * samples // 2, (after.start + near) * samples) - first
    border = before.stop * samples - first
    linear, angular = path_features(rotation[first:last], position[first:last])
    gain = [np.zeros(last - first), np.zeros(last - first)]
    for side, (piece, own) in enumerate(((before, slice(0, border)), (after, slice(border, None)))):
        if piece.model is not None:
            values = piece.model.coordinates(linear, angular, np.arange(last - first)[None])[0]
            # summed paths begin anew here; the values are those away from the border
            inner = values[own]
            cut = len(inner) // 4
            inner = inner[: len(inner) - cut] if side == 0 else inner[cut:]
            model = piece.model._replace(middle=np.median(inner, axis=0)[None])
            # beyond the border a free coordinate sets out from where it was held: small residuals are no
            # evidence against it
            held = 1 + np.sum(np.isfinite(model.size))
            gain[side] = (C.border * held - misfit(model, values[None])[0]) * cells.weight / samples
    evidence = np.concatenate([[0.0], np.cumsum(gain[0] - gain[1])])[low : high + 1]
    weight = np.exp(evidence - evidence.max())
    total = np.cumsum(weight) / weight.sum()
    earliest, latest = (int(np.searchsorted(total, part)) for part in _INTERVAL)
    return tuple(first + low + k for k in (int(evidence.argmax()), earliest, latest))  # type: ignore[return-value]

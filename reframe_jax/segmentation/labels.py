"""Labels: find the pieces with the same constraint."""

import numpy as np

from reframe_jax.segmentation.cells import Cells
from reframe_jax.segmentation.constants import SEGMENTS as C
from reframe_jax.segmentation.pieces import Piece
from reframe_jax.segmentation.rows import Fits, fit_spans

__all__ = ["label_pieces"]


def label_pieces(cells: Cells, pieces: list[Piece], reach: float) -> list[int]:
    """Number the constraints of pieces in order of appearance; a still body has the label -1.

    Two pieces have the same constraint if they hold equal numbers of translations and rotations, and if the
    held coordinates of one piece hardly move in the other piece. The mean values of these coordinates may
    differ, because the frame may be fixed in the body. All free motion has one label. Neighbours have
    different labels.

    Args:
        cells: cells of the recording.
        pieces: pieces in order of time, without common cells.
        reach: half the width of the cube in which origins are searched, m.
    """
    fits = fit_spans(cells, np.array([(piece.start, piece.stop) for piece in pieces]), reach)
    labels: list[int] = []
    groups: list[list[int]] = []
    for i, piece in enumerate(pieces):
        if piece.still:
            labels.append(-1)
            continue
        alike = [
            number
            for number, group in enumerate(groups)
            if labels[-1:] != [number] and any(_same(cells, pieces, fits, i, j) for j in group)
        ]
        labels.append(alike[0] if alike else len(groups))
        if not alike:
            groups.append([])
        groups[labels[-1]].append(i)
    return labels


def _same(cells: Cells, pieces: list[Piece], fits: Fits, i: int, j: int) -> bool:
    """Whether two pieces have the same constraint."""
    if pieces[i].held != pieces[j].held:
        return False
    translations, rotations = pieces[i].held
    for a, b in ((i, j), (j, i)):
        spans = [slice(pieces[k].start, pieces[k].stop) for k in (a, b)]
        weights = fits.weights[a, max(translations - 1, 0)]
        if _holds(cells.linear, weights, translations, cells.floor[0], spans) and _holds(
            cells.angular, fits.axes[a], rotations, cells.floor[1], spans
        ):
            return True
    return False


def _holds(features: np.ndarray, rows: np.ndarray, count: int, floor: float, spans: list[slice]) -> bool:
    """Whether ``count`` rows (T, 3, F) of any type are held in the first span and in the second span."""
    if count == 0:
        return True
    own, other = (
        np.stack([np.std(z[span] @ w[:count].T, axis=0).max() for z, w in zip(features, rows, strict=True)])
        for span in spans
    )
    return bool(np.any(np.maximum(own, other) <= max(C.same * own.min(), 2 * floor)))

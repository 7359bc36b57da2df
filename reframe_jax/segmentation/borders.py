"""Place the border between two pieces: each pose goes to the piece whose model fits the pose better."""

import numpy as np

from reframe_jax.segmentation.bank import misfit
from reframe_jax.segmentation.cells import Cells, path_features
from reframe_jax.segmentation.constants import SEGMENTS as C
from reframe_jax.segmentation.pieces import Piece

_INTERVAL = 0.025, 0.975


def place_border(cells: Cells, before: Piece, after: Piece) -> tuple[int, int, int]:
    """Find the pose at which the second piece begins: its index, and the ends of its 95 % interval."""
    samples = cells.samples
    near = round(C.cells) + 1
    first = max(before.start, before.stop - 4 * near) * samples
    last = min(after.stop, after.start + 4 * near) * samples
    # a border moves by at most half of each piece, so that borders keep their order
    low = max((before.start + before.stop) * samples // 2, (before.stop - near) * samples) - first
    high = min((after.start + after.stop) * samples // 2, (after.start + near) * samples) - first
    border = before.stop * samples - first
    linear, angular = path_features(cells.rotation[first:last], cells.position[first:last])
    gain = [np.zeros(last - first), np.zeros(last - first)]
    for side, (piece, own) in enumerate(((before, slice(0, border)), (after, slice(border, None)))):
        if piece.model is not None:
            values = piece.model.coordinates(linear, angular, np.arange(last - first)[None])[0]
            # integrated paths have another start here, so the mean is computed again, away from the border
            inner = values[own]
            inner = inner[: -(len(inner) // 4) or None] if side == 0 else inner[len(inner) // 4 :]
            middle = np.median(inner, axis=0)[None]
            # a single pose has more noise than the mean pose of a cell
            spread = np.sqrt(np.mean((inner - middle) ** 2, axis=0))[None]
            model = piece.model._replace(middle=middle, size=np.maximum(piece.model.size, spread))
            # beyond the border, a free coordinate starts at its held value: small residuals are no evidence
            # against free motion
            held = 1 + np.sum(np.isfinite(model.size))
            gain[side] = (C.border * held - misfit(model, values[None])[0]) * cells.weight / samples
    evidence = np.concatenate([[0.0], np.cumsum(gain[0] - gain[1])])[low : high + 1]
    weight = np.exp(evidence - evidence.max())
    total = np.cumsum(weight) / weight.sum()
    earliest, latest = (int(np.searchsorted(total, part)) for part in _INTERVAL)
    return tuple(first + low + k for k in (int(evidence.argmax()), earliest, latest))  # type: ignore[return-value]

"""How little a fitted row moves by chance.

In a short span, the best of all rows hardly moves even in a motion without constraints. Such a row is no
evidence.
"""

import dataclasses

import numpy as np

from reframe_jax.segmentation.cells import Cells, path_features
from reframe_jax.segmentation.constants import SEGMENTS as C
from reframe_jax.segmentation.rows import fit_spans

__all__ = ["with_chance"]

_SPANS = 64  # spans per length
_WINDOWS = 2, 4, 8, 16  # cells, lengths of the windows in which motions are compared
_TURNED = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3, 3)))[0]


def with_chance(cells: Cells, reach: float) -> Cells:
    """Return cells with the fields ``chance`` and ``progress``.

    For ``chance``, rows are fitted to a surrogate motion, which has the times and speeds of the recording,
    but no constraint. Its positions are the sum of three copies of the path, delayed by thirds of the
    recording and rotated; its rotations are those of the recording in reverse order.

    Args:
        cells: cells of the recording.
        reach: half the width of the cube in which origins are searched, m.
    """
    number = cells.linear.shape[1]
    poses = cells.linear[1].reshape(-1, 3, 4)  # position and rotation
    u, _, v = np.linalg.svd(poses[::-1, :, 1:])
    u[:, :, 2] *= np.linalg.det(u @ v)[:, None]
    copies = [np.roll(poses[:, :, 0], number * k // 3, axis=0) @ turn for k, turn in enumerate(_TURNED)]
    linear, angular = path_features(u @ v, np.sum(copies, axis=0) / np.sqrt(3))
    mixed = dataclasses.replace(cells, linear=linear, angular=angular)
    lengths = 2 ** np.arange(2, max(3, min(10, int(np.log2(number)) + 1)))
    chance = []
    for length in lengths:
        start = np.unique(np.linspace(0, number - length, _SPANS).astype(int))
        size = fit_spans(mixed, np.stack([start, start + length], axis=1), reach).size
        logs = np.log(np.where(np.isfinite(size), size, 1))
        mean = np.sum(logs, axis=-1) / np.arange(1, 4)[:, None]
        chance.append(np.quantile(mean.min(axis=-1), C.chance, axis=0))
    return dataclasses.replace(cells, chance=(np.log(lengths), np.stack(chance)), progress=_progress(cells))


def _progress(cells: Cells) -> np.ndarray:
    """Return the path length before each cell, as a number (N + 1,) of cells with the usual speed.

    In slower motion, rows stay small by chance for a longer time. The speed is the ratio of path length to
    amplitude in a window; the same ratio in shorter windows of the recording is the comparison.
    """
    z = np.concatenate([cells.linear[1, :, ::4], C.lever * cells.angular[1]], axis=1)
    z = z - z.mean(axis=0)
    noise = 6 * float(np.sum(np.square([cells.floor[0], C.lever * cells.floor[1]])))
    step = np.sqrt(np.maximum(np.sum(np.diff(z, axis=0) ** 2, axis=1) - noise, 0))
    path = np.concatenate([[0], np.cumsum(step)])
    sums = [np.concatenate([np.zeros((1, 6)), np.cumsum(each, axis=0)]) for each in (z, z**2)]

    def travel(length: int) -> np.ndarray:
        mean, square = ((total[length:] - total[:-length]) / length for total in sums)
        amplitude = np.sqrt(np.maximum(np.sum(square - mean**2, axis=1), noise))
        return np.asarray((path[length - 1 :] - path[: len(z) - length + 1]) / amplitude)

    lengths = [length for length in _WINDOWS if length <= len(z)]
    usual = np.maximum.accumulate([np.quantile(travel(length), C.usual) for length in lengths])
    longest = lengths[-1]
    here = np.pad(travel(longest), (longest // 2, (longest - 1) // 2), mode="edge")
    return np.concatenate([[0], np.cumsum(np.interp(here, usual, np.array(lengths) / longest))])

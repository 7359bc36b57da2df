"""How still a coordinate becomes by chance: what the best of all rows achieves where nothing is held."""

import dataclasses

import numpy as np

from reframe_jax.segmentation.cells import Cells, path_features
from reframe_jax.segmentation.constants import SEGMENTS as C
from reframe_jax.segmentation.rows import fit_spans

__all__ = ["with_chance"]

_SPANS = 64  # of a length
_WINDOWS = 2, 4, 8, 16  # cells, in which motions are compared
_TURNED = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3, 3)))[0]


def with_chance(cells: Cells, reach: float) -> Cells:
    """Cells with the sizes of rows that are fitted to spans of a motion in which nothing is held.

    The motion has the times and speeds of the recording: positions are the sum of three copies of its path,
    a third of the recording apart and turned each, and rotations are those of the recording in reverse order.
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
    """Cells (N + 1,) in which the usual motion would have come as far as the motion up to each cell.

    In a motion that is slower than usual, rows are still by chance for longer. The path in a window over the
    amplitude there is compared with the usual one in shorter windows.
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

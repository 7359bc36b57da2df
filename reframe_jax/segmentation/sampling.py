"""The poses that segmentation uses: unusable poses are left out, and short gaps are filled."""

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry.numpy_rotations import nearest_rotations
from reframe_jax.motion.noise import unit_of_rounding
from reframe_jax.motion.outliers import find_outliers, find_repeats
from reframe_jax.tuning import MOTION

_BLOCK, _MARGIN = 512, 16  # poses of a block, and poses at its ends that count in the next block
_BLOCKS = 8  # blocks at a time: one program serves recordings of any length


def find_left_out(poses: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Find outliers and repeated poses, (N,) bool; see :mod:`reframe_jax.motion.outliers`."""
    rotation, position = poses[:, :3, :3].reshape(-1, 9), poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)
    path, found = np.concatenate([rotation, position], axis=1), np.zeros(len(poses), bool)
    starts = np.arange(0, max(len(poses) - 2 * _MARGIN, 1), _BLOCK - 2 * _MARGIN)
    for some in np.split(starts, np.arange(_BLOCKS, len(starts), _BLOCKS)):
        at = np.resize(some, _BLOCKS) + np.arange(_BLOCK)[:, None]
        count = np.minimum(len(poses) - at[0], _BLOCK)
        at = np.minimum(at, len(poses) - 1)
        steps = np.maximum(np.diff(times[at], axis=0), np.finfo(float).eps)
        left_out = np.asarray(_left_out_of_blocks(np.moveaxis(path[at], 2, 0), steps, count))
        for k, start in enumerate(some):
            first = min(start, _MARGIN)
            found[start + first : start + _BLOCK] = left_out[first : count[k], k]
    return found


@jax.jit
def _left_out_of_blocks(path: jax.Array, steps: jax.Array, count: jax.Array) -> jax.Array:
    own = jnp.arange(path.shape[1])[:, None] < count
    return find_repeats(path, own) | find_outliers(path, steps, count, unit_of_rounding(path[9:], own))


def fill_gaps(
    poses: np.ndarray, times: np.ndarray, step: float, longest: float
) -> tuple[np.ndarray, np.ndarray]:
    """Fill gaps of at most ``longest`` s between poses (N, 4, 4) with poses about every ``step``, s.

    The new poses are on the cubic of time through four poses: those on both sides of the gap, and those half
    as far before and after it. The result is the poses (P, 4, 4), and the index in the recording of each,
    (P,); new poses have the index of the next pose.
    """
    spans = np.diff(times)
    missing = np.maximum(np.rint(spans / step).astype(int) - 1, 0) * (spans < longest)
    missing[[0, -1]] = 0  # there is one pose on one side
    gaps, moved = np.flatnonzero(missing), np.linalg.norm(np.diff(poses, axis=0), axis=(1, 2))
    if moved[gaps].sum() < MOTION.gap * (moved[gaps - 1] + moved[gaps + 1]).sum() / 2:
        missing[:] = 0  # no poses are missing: the times are those of arrival, in bursts
    source = np.repeat(np.arange(len(times)), np.append(1, missing + 1))
    number = np.arange(1, len(source) + 1) - np.searchsorted(source, source)
    new = np.flatnonzero(number <= np.append(0, missing)[source])
    start = source[new] - 1
    gap = spans[start]
    before = np.minimum(np.searchsorted(times, times[start] - gap / 2), start - 1)
    after = np.maximum(np.searchsorted(times[:-1], times[start + 1] + gap / 2), start + 2)
    near = np.stack([before, start, start + 1, after])
    apart = times[start] + gap * number[new] / (missing[start] + 1) - times[near]
    between = times[near][:, None] - times[near] + np.eye(4)[:, :, None]
    weights = np.prod(apart, axis=0) / apart / np.prod(between, axis=1)  # Lagrange's
    filled = poses[source]
    filled[new] = np.einsum("kn,knij->nij", weights, poses[near])
    filled[new, :3, :3] = nearest_rotations(filled[new, :3, :3])
    return filled, source

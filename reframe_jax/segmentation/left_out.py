"""Find the poses that segmentation leaves out, in recordings of any length."""

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.motion.noise import unit_of_rounding
from reframe_jax.motion.outliers import find_outliers, find_repeats

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

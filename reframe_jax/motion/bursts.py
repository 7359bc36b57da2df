"""Find bursts of outliers: runs of poses that jump away together and return.

Typical causes are flipped orientations, and swapped or occluded markers. A run starts with a jump and ends
with a jump back; across the run, the body moved as before and after the run. A body that stays at the place
of a jump, or that only moves fast, makes no run.

"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax, vmap

from reframe_jax.geometry import rotations
from reframe_jax.geometry.products import matmul

__all__ = ["LONGEST_RUN", "find_runs"]

LONGEST_RUN = 24  # poses
_SHORTEST_RUN = 3  # poses; the test in outliers finds shorter runs
_BESIDE = 5  # steps before and after a run that give the usual motion
_JUMP = 6.0  # distance of a step from adjacent steps, in units of their scatter
_LATE = 3.0  # longest regular step, in usual steps
_BRIDGE = (
    0.5  # largest difference of the motion across the run from the usual motion, as a fraction of the jump
)
_UNEVEN = 4.0  # largest ratio of the two jumps of a run
_FRACTION = 6  # a run is at most the window length divided by this number


def find_runs(poses: jax.Array, count: jax.Array, unit: jax.Array) -> jax.Array:
    """Find the runs of a window that have at least three poses, and start and end inside the window.

    Args:
        poses: (K+1, 4, 4) m.
        count: () number of poses before the padding.
        unit: () m, rounding unit of the positions, or 0.

    Returns:
        (K+1,) bool, True for poses of runs.
    """
    size = poses.shape[0]
    longest = min(LONGEST_RUN, size // _FRACTION)
    if longest < _SHORTEST_RUN:
        return jnp.zeros(size, bool)
    length = np.arange(longest + 1, dtype=np.int32)
    here = np.arange(size - 1, dtype=np.int32)
    last = np.minimum(here[:, None] + length, size - 2)  # last step of a run with this length
    inside = (here[:, None] >= _BESIDE) & (here[:, None] + length + _BESIDE < count - 1)
    inverse = jnp.swapaxes(poses[:, :3, :3], -1, -2)
    beyond = np.minimum(last + 1, size - 1)
    turns = rotations.rotation_log(matmul(poses[beyond, :3, :3], inverse[here][:, None]))
    shifts = poses[beyond, :3, 3] - poses[here, None, :3, 3]

    def is_return(moves: jax.Array, least: jax.Array) -> jax.Array:
        before, after = (_usual_step(moves[:, 0], side) for side in (-1, 1))
        away, back = _jump_distance(*before, least)[:, None], _jump_distance(*after, least)[last]
        smaller, larger = jnp.minimum(away, back), jnp.maximum(away, back)
        jump = jnp.where(larger < _UNEVEN * smaller, smaller, 0)
        usual = (before[0][:, None] + after[0][last]) / 2 * (length + 1)[None, :, None].astype(moves.dtype)
        across = jnp.linalg.norm(moves - usual, axis=-1)
        return (jump > 0) & (across < _BRIDGE * jump)

    returns = vmap(is_return)(jnp.stack([turns, shifts]), jnp.stack([jnp.zeros_like(unit), unit]))
    return _poses_of_runs(jnp.any(returns, axis=0) & inside)


def _usual_step(steps: jax.Array, side: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Median step (K, 3) before (-1) or after (1) each step, distance of each step from it, and scatter.

    The body may be early or late on its path. Distances are therefore relative to the segment from the usual
    step to three times the usual step.
    """
    number = steps.shape[0]
    near = np.arange(number)[:, None] + side * np.arange(1, _BESIDE + 1)
    others = steps[np.clip(near, 0, number - 1)]
    usual = jnp.median(others, axis=1)
    scatter = jnp.median(jnp.linalg.norm(others - usual[:, None], axis=-1), axis=1)
    square = jnp.sum(jnp.square(usual), axis=-1)
    times = jnp.sum(steps * usual, axis=-1) / jnp.where(square > 0, square, 1)
    late = jnp.clip(times, 0, _LATE)[:, None] * usual
    return usual, jnp.linalg.norm(steps - late, axis=-1), scatter


def _jump_distance(usual: jax.Array, distance: jax.Array, scatter: jax.Array, least: jax.Array) -> jax.Array:
    """Distance (K,) of each step from the usual step if the step is a jump; else 0."""
    typical = jnp.median(distance)
    rounding = 64 * jnp.finfo(usual.dtype).eps * (1 + jnp.max(distance))
    level = _JUMP * jnp.maximum(jnp.maximum(scatter, typical), least) + rounding
    return jnp.where(distance > level, distance, 0)


def _poses_of_runs(returns: jax.Array) -> jax.Array:
    """Poses (K+1,) of the runs, from possible starts and lengths (K, longest + 1), with the shortest length.

    A run can start only after the end of the previous run, because the jump back is no start.
    """
    shortest = jnp.where(jnp.any(returns[:, 1:], axis=1), jnp.argmax(returns[:, 1:], axis=1) + 1, 0)

    def next_end(end: jax.Array, step: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        here, length = step
        end = jnp.where((length > 0) & (here > end), here + length, end)
        return end, here < end

    here = jnp.arange(len(returns), dtype=jnp.int32)
    long_enough = jnp.where(shortest >= _SHORTEST_RUN, shortest, 0).astype(jnp.int32)
    _, within = lax.scan(next_end, jnp.int32(-1), (here, long_enough))
    return jnp.concatenate([jnp.zeros(1, bool), within])

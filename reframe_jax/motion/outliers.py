"""Find outliers: poses that jump away and back because of flips, swapped markers or lost frames.

Robust lines through the neighbours of a pose find up to two consecutive outliers; :mod:`.bursts` finds longer
runs. The identification ignores outliers. Paths across outliers are interpolated between the adjacent poses.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax, vmap

from reframe_jax.compilation import update_marked
from reframe_jax.geometry import rotations
from reframe_jax.geometry.products import matmul
from reframe_jax.motion.bursts import find_runs
from reframe_jax.motion.noise import masked_median, unit_of_rounding

__all__ = ["repair_poses"]

_HALF = 3  # neighbours on each side, enough for a majority against two outliers
_OUTLIER = 6.0  # distance from the line through the neighbours, in units of their scatter
_SUSPICIOUS = 6.0  # ratio of a fourth difference to its median, above which a window is examined
_MOST = 0.3  # largest fraction of outliers; beyond this fraction, no pose is left out


def repair_poses(poses: jax.Array, times: jax.Array, count: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Find outliers, and replace them by poses interpolated between the adjacent poses.

    Args:
        poses: (N, K+1, 4, 4) m.
        times: (N, K+1) s.
        count: (N,) number of poses in each window before the padding.

    Returns:
        The poses (N, K+1, 4, 4), and (N, K+1) bool, False for outliers and padding.
    """
    own = jnp.arange(poses.shape[1], dtype=jnp.int32)[None] < count[:, None]
    if poses.shape[1] <= 2 * _HALF:
        return poses, own

    def find_block(block: tuple[jax.Array, ...]) -> jax.Array:
        poses, times, count, own = (jnp.moveaxis(array, -1, 0) for array in block)
        unit = unit_of_rounding(block[0][:, :3, 3].swapaxes(0, 1), block[3])
        runs = vmap(find_runs)(poses, count, unit)
        outliers = vmap(_find)(vmap(_fill)(poses, times, ~runs), times, count)
        outliers = (outliers | runs) & own
        fraction = jnp.sum(outliers, axis=1, dtype=poses.dtype) / count.astype(poses.dtype)
        return (own & ~(outliers & (fraction <= _MOST)[:, None])).T

    measured = lax.stop_gradient(poses)
    inputs = jnp.moveaxis(measured, 0, -1), times.T, count, own.T  # windows last
    counted = update_marked(find_block, _is_suspicious(measured, own), inputs, own.T).T

    def interpolate(_: None) -> jax.Array:
        return vmap(_fill)(poses, times, counted)

    return lax.cond(jnp.any(counted != own), interpolate, lambda _: poses, None), counted


def _is_suspicious(poses: jax.Array, own: jax.Array) -> jax.Array:
    """Whether a window has an unusually large fourth difference, (N,): a fast test that misses no jump."""
    whole = own[:, :-4] & own[:, 4:]
    jumps = []
    for columns in (slice(3), slice(3, 4)):
        x = poses[:, :, :3, columns]
        size = jnp.sqrt(jnp.sum(jnp.square(jnp.diff(x, n=4, axis=1)), axis=(2, 3)))
        median = masked_median(size.T, whole.T)
        rounding = 64 * jnp.finfo(x.dtype).eps * jnp.max(jnp.abs(x), axis=(1, 2, 3))
        level = jnp.maximum(_SUSPICIOUS * median, rounding)[:, None]
        jumps.append(jnp.any(whole & (size > level), axis=1))
    return jumps[0] | jumps[1]


def _find(poses: jax.Array, times: jax.Array, count: jax.Array) -> jax.Array:
    """Outliers of a window, (K+1,) bool.

    The test fits a robust line (medians of slopes and of intercepts) to the six neighbours of every pose, in
    the tangent space at the pose. The distance of an outlier from the line exceeds six times the scatter of
    the neighbours, or six times the median scatter of the window, whichever is larger. Also, the poses before
    and after an outlier are on the same side. Fast motion, and a body at a new place after lost frames, are
    no outliers.
    """
    here, width = np.arange(poses.shape[0], dtype=np.int32), 2 * _HALF
    first = jnp.clip(here - _HALF, 0, count - width - 1)
    near = first[:, None] + np.arange(width, dtype=np.int32)[None]
    near = near + (near >= here[:, None]).astype(np.int32)  # skip the pose itself
    after = near > here[:, None]
    later = times[near] - times[:, None]
    inverse = jnp.swapaxes(poses[:, None, :3, :3], -1, -2)
    turns = _unwrap(rotations.rotation_log(matmul(inverse, poses[near, :3, :3])))
    shifts = poses[near, :3, 3] - poses[:, None, :3, 3]
    inside = (here > 0) & (here < count - 1)
    # rotations and translations in one call, because only their numbers differ
    strays = vmap(partial(_strays, later=later, after=after, own=jnp.asarray(here < count)))
    return jnp.any(strays(jnp.stack([turns, shifts])), axis=0) & inside


def _strays(offsets: jax.Array, later: jax.Array, after: jax.Array, own: jax.Array) -> jax.Array:
    """Poses (K+1,) that are distant from the line through their neighbours, with all neighbours on one side.

    Args:
        offsets: (K+1, 6, 3) rad or m, offsets of the neighbours from each pose.
        later: (K+1, 6) s, times of the neighbours relative to each pose.
        after: (K+1, 6) bool, whether each neighbour is later than the pose.
        own: (K+1,) bool, False for padding.
    """
    one, other = np.triu_indices(offsets.shape[1], 1)
    slopes = (offsets[:, other] - offsets[:, one]) / (later[:, other] - later[:, one])[..., None]
    level = offsets - jnp.median(slopes, axis=1)[:, None] * later[..., None]
    line = jnp.median(level, axis=1)
    scatter = jnp.median(jnp.linalg.norm(level - line[:, None], axis=-1), axis=1)
    typical = jnp.nanmedian(jnp.where(own, scatter, jnp.nan))
    rounding = 64 * jnp.finfo(offsets.dtype).eps * (1 + jnp.max(jnp.abs(offsets)))
    outlying = jnp.linalg.norm(line, axis=-1) > _OUTLIER * jnp.maximum(scatter, typical) + rounding
    sides = vmap(lambda side: jnp.nanmedian(jnp.where(side[..., None], offsets, jnp.nan), axis=1))
    ahead, behind = sides(jnp.stack([after, ~after]))
    return outlying & (jnp.sum(ahead * behind, axis=-1) > 0)


def _unwrap(turns: jax.Array) -> jax.Array:
    """Choose rotation vectors (K, M, 3) on the side of the largest vector in each row.

    Every rotation has two rotation vectors. The neighbours of a pose with an error of about a half turn are
    close to each other, but their shortest rotation vectors may have opposite directions. Rotations below a
    quarter turn do not change.
    """
    angles = jnp.linalg.norm(turns, axis=-1, keepdims=True)
    largest = jnp.take_along_axis(turns, jnp.argmax(angles, axis=1)[..., None], axis=1)
    others = turns * (1 - 2 * jnp.pi / jnp.where(angles == 0, 1, angles))
    nearer = jnp.linalg.norm(others - largest, axis=-1) < jnp.linalg.norm(turns - largest, axis=-1)
    return jnp.where(nearer[..., None] & (angles > jnp.pi / 2), others, turns)


def _fill(poses: jax.Array, times: jax.Array, counted: jax.Array) -> jax.Array:
    """Keep valid poses, and replace outliers by poses interpolated between the nearest valid poses."""
    here = np.arange(poses.shape[0], dtype=np.int32)
    before = lax.cummax(jnp.where(counted, here, -1))
    after = lax.cummin(jnp.where(counted, here, len(here)), reverse=True)
    before, after = jnp.where(before < 0, after, before), jnp.where(after == len(here), before, after)
    span = times[after] - times[before]
    fraction = jnp.where(span > 0, (times - times[before]) / jnp.where(span > 0, span, 1), 0)
    start, end = poses[before], poses[after]
    turn = rotations.rotation_log(matmul(jnp.swapaxes(start[:, :3, :3], -1, -2), end[:, :3, :3]))
    rotation = matmul(start[:, :3, :3], rotations.rotation_exp(fraction[:, None] * turn))
    position = start[:, :3, 3] + fraction[:, None] * (end[:, :3, 3] - start[:, :3, 3])
    filled = poses.at[np.s_[:, :3, :3]].set(rotation).at[np.s_[:, :3, 3]].set(position)
    return jnp.where(counted[:, None, None], poses, filled)

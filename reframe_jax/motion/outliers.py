"""Poses that jump away and back: flips, swapped markers, lost frames.

Robust lines through the neighbours find up to two in a row; :mod:`.bursts` finds longer runs. They do not
count; paths that run across them use the motion interpolated between the poses beside them.
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

_HALF = 3  # neighbours on each side: a majority of them outvotes outliers of up to two poses
_OUTLIER = 6.0  # distance from the line through the neighbours, in units of their scatter
_SUSPICIOUS = 6.0  # fourth difference over its median, above which a window is looked at
_MOST = 0.3  # share of poses that can be outliers; beyond it nothing is left out


def repair_poses(poses: jax.Array, times: jax.Array, count: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Find outliers, and replace them by motion interpolated between the poses beside them.

    Args:
        poses: (N, K+1, 4, 4) m.
        times: (N, K+1) s.
        count: (N,) number of poses in each window; the others are padding.

    Returns:
        The poses, (N, K+1, 4, 4), and which of them count, (N, K+1) bool: neither outliers nor padding.
    """
    own = jnp.arange(poses.shape[1], dtype=jnp.int32)[None] < count[:, None]
    if poses.shape[1] <= 2 * _HALF:
        return poses, own

    def look(block: tuple[jax.Array, ...]) -> jax.Array:
        poses, times, count, own = (jnp.moveaxis(array, -1, 0) for array in block)
        unit = unit_of_rounding(block[0][:, :3, 3].swapaxes(0, 1), block[3])
        runs = vmap(find_runs)(poses, count, unit)
        outliers = vmap(_find)(vmap(_fill)(poses, times, ~runs), times, count)
        outliers = (outliers | runs) & own
        fraction = jnp.sum(outliers, axis=1, dtype=poses.dtype) / count.astype(poses.dtype)
        return (own & ~(outliers & (fraction <= _MOST)[:, None])).T

    measured = lax.stop_gradient(poses)
    inputs = jnp.moveaxis(measured, 0, -1), times.T, count, own.T  # windows last
    counted = update_marked(look, _is_suspicious(measured, own), inputs, own.T).T

    def fill(_: None) -> jax.Array:
        return vmap(_fill)(poses, times, counted)

    return lax.cond(jnp.any(counted != own), fill, lambda _: poses, None), counted


def _is_suspicious(poses: jax.Array, own: jax.Array) -> jax.Array:
    """Whether a fourth difference stands out, (N,): a test that is cheap, and misses no jump."""
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

    A line (medians of slopes and of intercepts) is drawn through the six neighbours of every pose, in the
    tangent space there. An outlier lies further from it than six times their scatter about it, or the median
    scatter in the window if that is larger; and the poses before and after it lie on the same side of it.
    Fast motion, and a body that is elsewhere after lost frames, are no outliers.
    """
    here, width = np.arange(poses.shape[0], dtype=np.int32), 2 * _HALF
    first = jnp.clip(here - _HALF, 0, count - width - 1)
    near = first[:, None] + np.arange(width, dtype=np.int32)[None]
    near = near + (near >= here[:, None]).astype(np.int32)  # not the pose itself
    after = near > here[:, None]
    later = times[near] - times[:, None]
    inverse = jnp.swapaxes(poses[:, None, :3, :3], -1, -2)
    turns = _unwrap(rotations.rotation_log(matmul(inverse, poses[near, :3, :3])))
    shifts = poses[near, :3, 3] - poses[:, None, :3, 3]
    inside = (here > 0) & (here < count - 1)
    # of both groups at once, as nothing but the numbers differs
    strays = vmap(partial(_strays, later=later, after=after, own=jnp.asarray(here < count)))
    return jnp.any(strays(jnp.stack([turns, shifts])), axis=0) & inside


def _strays(offsets: jax.Array, later: jax.Array, after: jax.Array, own: jax.Array) -> jax.Array:
    """Poses (K+1,) that lie far off the line through their neighbours, and on the same side of all of them.

    Args:
        offsets: (K+1, 6, 3) of the neighbours from each pose, rad or m.
        later: (K+1, 6) s, how much later they are.
        after: (K+1, 6) bool, whether they are.
        own: (K+1,) bool, poses of the window.
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
    """Rotation vectors (K, M, 3), of the two for each rotation those on the side of the largest in its row.

    Neighbours of a pose that is off by about a half turn are close to each other, their logarithms are not.
    Rotations of less than a quarter turn stay as they are.
    """
    angles = jnp.linalg.norm(turns, axis=-1, keepdims=True)
    largest = jnp.take_along_axis(turns, jnp.argmax(angles, axis=1)[..., None], axis=1)
    others = turns * (1 - 2 * jnp.pi / jnp.where(angles == 0, 1, angles))
    nearer = jnp.linalg.norm(others - largest, axis=-1) < jnp.linalg.norm(turns - largest, axis=-1)
    return jnp.where(nearer[..., None] & (angles > jnp.pi / 2), others, turns)


def _fill(poses: jax.Array, times: jax.Array, counted: jax.Array) -> jax.Array:
    """Poses that count as they are, others on the way between the nearest that do."""
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

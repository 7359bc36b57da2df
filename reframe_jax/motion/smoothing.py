"""Poses averaged over their neighbours, as far as the motion permits.

At a high rate a body moves less between two poses than their noise, so steps are mostly noise. Angular paths
and the paths of BB and GG are sums of products of steps, and their noise grows in a way that no later average
removes. Therefore neighbours are averaged first. The filter is linear in the entries of the pose. So are the
constraints of GB and BG, which it leaves as they are; the others it changes by the fourth power of its width.

All arrays have components first, then samples, then windows.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

__all__ = ["noise_share", "smooth_noise", "smooth_poses", "smoothing_width"]

_NARROW = 15.0  # noises that the motion may go, root mean square, over the width of an average
_PART = 3  # of the chord that the width may take
_GAP = 3.0  # a step so many times as long as the median one ends an average
_PROJECTIONS = 4  # steps of Newton's iteration towards the nearest rotation


def smoothing_width(
    rotation: jax.Array,
    position: jax.Array,
    counted: jax.Array,
    noise: tuple[jax.Array, jax.Array],
    lag: jax.Array,
) -> jax.Array:
    """Choose how many neighbours on each side an average takes, (N,) int32; 0 leaves the poses as they are.

    Over the whole width the body moves by at most 15 noises, in position and in orientation, and the width is
    at most a third of the lag. Motion is then straight to a small part of the noise that is left.

    Args:
        rotation: (3, 3, K+1, N) rotation matrices.
        position: (3, K+1, N) m.
        counted: (K+1, N) bool, poses that count.
        noise: as :func:`reframe_jax.motion.noise.estimate_noise` returns it.
        lag: (N,) samples between the poses of a chord.
    """
    width = jnp.zeros(lag.shape, jnp.int32)
    fits = jnp.ones(lag.shape, bool)
    for half in _half_widths(counted.shape[0]):
        span = 2 * half
        both = (counted[span:] & counted[:-span]).astype(position.dtype)
        number = jnp.maximum(jnp.sum(both, axis=0), 1)
        shift = jnp.sum(both * jnp.sum(jnp.square(position[:, span:] - position[:, :-span]), axis=0), axis=0)
        turn = jnp.sum(
            both * jnp.sum(jnp.square(rotation[:, :, span:] - rotation[:, :, :-span]), axis=(0, 1)), axis=0
        )
        fits = fits & (shift <= number * jnp.square(_NARROW * noise[0])) & (_PART * span <= lag)
        fits = fits & (turn / 2 <= number * jnp.square(_NARROW * noise[1]))
        width = jnp.where(fits, jnp.int32(half), width)
    return width


def _half_widths(poses: int) -> list[int]:
    """1, 2, 3, 4, 6, 8, 12, ...: as far as a third of the longest lag, a sixth of the window."""
    halves = sorted({half for n in range(16) for half in (2**n, 3 * 2 ** (n - 1) if n else 1)})
    return [half for half in halves if 2 * 18 * half < poses]


def noise_share(width: jax.Array, dtype: jnp.dtype) -> jax.Array:
    """Standard deviation that an average of so many neighbours leaves of white noise: 1 for none, (N,)."""
    m = (2 * width + 1).astype(dtype)
    return jnp.sqrt(4 / m - (3 * m**2 + 1) / m**3 + (2 * m**2 + 1) / (3 * m**3))


def smooth_poses(
    rotation: jax.Array, position: jax.Array, times: jax.Array, count: jax.Array, width: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Average every pose with its neighbours, without loss of curvature.

    The filter is 2 b - b b, where b is the mean over the width: straight lines and parabolas pass unchanged.
    Near the ends of the window and at gaps the width shrinks, so that it stays symmetric.

    Args:
        rotation: (3, 3, K+1, N) rotation matrices.
        position: (3, K+1, N) m.
        times: (K+1, N) s.
        count: (N,) number of poses in each window; the others are padding.
        width: (N,) neighbours on each side.

    Returns:
        Rotation matrices and positions, of the same shapes.
    """
    poses, windows = position.shape[1:]
    entries = jnp.concatenate([rotation.reshape(9, poses, windows), position])
    half = jnp.minimum(width[None], _room(times, count))
    mean = _mean_of_neighbours(entries, half)
    entries = 2 * mean - _mean_of_neighbours(mean, half)
    near = entries[:9].reshape(rotation.shape)
    for _ in range(_PROJECTIONS):
        gram = jnp.sum(near[:, :, None] * near[:, None], axis=0)  # R' R
        near = 1.5 * near - 0.5 * jnp.sum(near[:, :, None] * gram[None], axis=1)
    smooth = (width > 0)[None]
    return jnp.where(smooth[None, None], near, rotation), jnp.where(smooth[None], entries[9:], position)


def smooth_noise(
    rotation: jax.Array,
    position: jax.Array,
    times: jax.Array,
    counted: jax.Array,
    count: jax.Array,
    noise: tuple[jax.Array, jax.Array],
    lag: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Average neighbours as :func:`smoothing_width` permits; arguments of it and of :func:`smooth_poses`.

    Returns:
        Rotation matrices, positions and the width, (N,).
    """
    none = jnp.zeros_like(count)
    if not _half_widths(counted.shape[0]):
        return rotation, position, none

    def average(_: None) -> tuple[jax.Array, jax.Array, jax.Array]:
        rest = lax.stop_gradient((rotation, position))
        width = smoothing_width(*rest, counted, noise, lag)
        return *smooth_poses(rotation, position, times, count, width), width

    worthwhile = jnp.any(lag >= 2 * _PART)  # not for an encoder's noise
    return lax.cond(worthwhile, average, lambda _: (rotation, position, none), None)


def _room(times: jax.Array, count: jax.Array) -> jax.Array:
    """Poses between each pose and the nearest end or gap, (K+1, N) int32."""
    here = np.arange(times.shape[0], dtype=np.int32)[:, None]
    steps = jnp.diff(times, axis=0)
    own = here[1:] < count[None]
    mean = jnp.sum(jnp.where(own, steps, 0), axis=0) / jnp.maximum(count - 1, 1).astype(times.dtype)
    gap = own & (steps > _GAP * mean[None])
    ends = jnp.zeros((1, *count.shape), bool)
    first = lax.cummax(jnp.where(jnp.concatenate([ends, gap]), here, 0), axis=0)
    last = lax.cummin(jnp.where(jnp.concatenate([gap, ends]), here, count[None] - 1), axis=0, reverse=True)
    return jnp.maximum(jnp.minimum(here - first, last - here), 0)


def _mean_of_neighbours(values: jax.Array, half: jax.Array) -> jax.Array:
    """Mean of (C, K+1, N) over so many neighbours on each side, (K+1, N), and the sample itself."""
    total = jnp.concatenate([jnp.zeros_like(values[:, :1]), jnp.cumsum(values, axis=1)], axis=1)
    here = np.arange(values.shape[1], dtype=np.int32)[:, None]
    later, earlier = (
        jnp.take_along_axis(total, index[None], axis=1) for index in (here + half + 1, here - half)
    )
    return (later - earlier) / (2 * half + 1).astype(values.dtype)[None]

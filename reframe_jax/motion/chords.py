"""Velocities from overlapping chords of any length.

A chord joins the poses k and k + L; all of them are used, none is thinned out. Its velocity is the
difference of the path (see :func:`reframe_jax.motion.kinematics.velocity_paths`) over the time between
them, so that a long lag costs no more than a short one.
"""

import jax
import jax.numpy as jnp
import numpy as np

__all__ = ["chord_velocities", "moving_chords", "spread_of"]

_REST = 4.0  # noises that a chord must be long not to count as rest
_MOVING = 0.1  # share of chords that must move for the others to be left out


def chord_velocities(paths: jax.Array, times: jax.Array, lag: jax.Array, weights: jax.Array) -> jax.Array:
    """Velocity maps of all chords, scaled so that the mean of their squares is the weighted one.

    Args:
        paths: (3, 4, K+1, 4, N).
        times: (K+1, N) s.
        lag: (N,) samples.
        weights: (K, N) of the chords, by their first pose; those that reach beyond the window have none.

    Returns:
        (3, 4, K, 4, N) m/s and 1/s.
    """
    samples = paths.shape[2] - 1
    end = jnp.minimum(np.arange(samples, dtype=np.int32)[:, None] + lag[None], samples)
    ends = jnp.take_along_axis(paths, end[None, None, :, None], axis=2)
    span = jnp.take_along_axis(times, end, axis=0) - times[:-1]
    share = weights / jnp.maximum(jnp.mean(weights, axis=0, keepdims=True), jnp.finfo(weights.dtype).tiny)
    scale = jnp.sqrt(share) / jnp.where(weights > 0, span, 1)
    return (ends - paths[:, :, :-1]) * scale[None, None, :, None]


def moving_chords(
    rotation: jax.Array,
    position: jax.Array,
    counted: jax.Array,
    lag: jax.Array,
    noise: tuple[jax.Array, jax.Array],
) -> jax.Array:
    """Weight of every chord, (K, N): 1, or 0 where a pose at its ends does not count, or the body rests.

    Rest says nothing about a constraint, and its noise would dilute what motion says.

    Args:
        rotation: (3, 3, K+1, N).
        position: (3, K+1, N) m.
        counted: (K+1, N) bool.
        lag: (N,) samples.
        noise: (N,) m and (N,) rad.
    """
    samples = counted.shape[0] - 1
    reach = np.arange(samples, dtype=np.int32)[:, None] + lag[None]
    end = jnp.minimum(reach, samples)
    both = counted[:-1] & jnp.take_along_axis(counted, end, axis=0) & (reach <= samples)
    shift = jnp.take_along_axis(position, end[None], axis=1) - position[:, :-1]
    turn = jnp.take_along_axis(rotation, end[None, None], axis=2) - rotation[:, :, :-1]
    far = jnp.sum(jnp.square(shift), axis=0) > jnp.square(_REST * noise[0])[None]
    far = far | (jnp.sum(jnp.square(turn), axis=(0, 1)) / 2 > jnp.square(_REST * noise[1])[None])
    moving = both & far
    number, all_of_them = (jnp.sum(chords, axis=0, dtype=position.dtype) for chords in (moving, both))
    few = number < jnp.maximum(_MOVING * all_of_them, 4)
    return jnp.where(few[None], both, moving).astype(position.dtype)


def spread_of(paths: jax.Array, counted: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Paths about their mean, (3, 4, K+1, 4, N), scaled like :func:`chord_velocities`, and that mean.

    Their mean square is half that of the displacements between all pairs of poses.
    """
    weights = counted.astype(paths.dtype)[None, None, :, None]
    total = jnp.maximum(jnp.sum(weights, axis=2), 1)
    mean = jnp.sum(weights * paths, axis=2) / total
    return (paths - mean[:, :, None]) * jnp.sqrt(weights * (paths.shape[2] / total)[:, :, None]), mean

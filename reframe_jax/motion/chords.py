"""Velocities from overlapping chords of any length.

A chord joins the poses k and k + L, for every k; no pose is thinned out. Its velocity is the difference of
the path (see :func:`reframe_jax.motion.kinematics.velocity_paths`) over the time between them, so a long lag
costs no more than a short one.
"""

import jax
import jax.numpy as jnp
import numpy as np

__all__ = ["chord_velocities", "moving_chords", "spread_of"]

_REST = 4.0  # noises that a chord must be long not to count as rest
_MOVING = 0.1  # share of chords that must move for the others to be left out


def chord_velocities(paths: jax.Array, times: jax.Array, lag: jax.Array, weights: jax.Array) -> jax.Array:
    """Compute the velocity maps of all chords, scaled so that their mean square is the weighted mean square.

    Args:
        paths: (3, 4, K+1, 4, N) m and 1, components first; the last but one axis is over frame types.
        times: (K+1, N) s.
        lag: (N,) samples.
        weights: (K, N) weights of the chords, by their first pose; 0 for chords that end beyond the window.

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
    """Weigh every chord, (K, N): 1, or 0 if one of its poses does not count or the body rests.

    A chord rests if it is shorter than four times the noise. Rest says nothing about a constraint, and its
    noise would dilute the motion. If nearly all chords rest, all count.

    Args:
        rotation: (3, 3, K+1, N) rotation matrices.
        position: (3, K+1, N) m.
        counted: (K+1, N) bool, poses that count.
        lag: (N,) samples.
        noise: (N,) m and (N,) rad, standard deviations of position and orientation.
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
    """Return paths about their mean, (3, 4, K+1, 4, N), scaled as in :func:`chord_velocities`, and the mean.

    Their mean square is half the mean square of the displacements between all pairs of poses.
    """
    weights = counted.astype(paths.dtype)[None, None, :, None]
    total = jnp.maximum(jnp.sum(weights, axis=2), 1)
    mean = jnp.sum(weights * paths, axis=2) / total
    return (paths - mean[:, :, None]) * jnp.sqrt(weights * (paths.shape[2] / total)[:, :, None]), mean

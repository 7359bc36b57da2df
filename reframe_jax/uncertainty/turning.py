"""Sensitivities of an axis that the rotations keep in place.

Where a body turns about a single axis, that axis is taken from the mean rotation M: y, in the body, belongs
to its largest singular value, and x = M y is the axis in the ground (:mod:`reframe_jax.motion.single_axis`).
With errors e of the rotations, in the ground, and s the other singular values, the axis moves along m,
perpendicular to it, by the mean over the poses of

    e . ((R - M) m x x) / (1 - s^2)  in the body,      e . ((R M^T - 1) m x x) / (1 - s^2)  in the ground.

Rotations that are brought back to that axis keep of their errors those about it, (e . x) x, and those of the
axis itself, x x (dx - R dy).
"""

import jax
import jax.numpy as jnp

from reframe_jax.uncertainty.propagation import apply_to_rows, cross_rows

__all__ = ["axis_rows", "combine_rows", "kept_rows"]


def axis_rows(
    rotation: jax.Array, shares: jax.Array, axes: jax.Array, odd: jax.Array, on_body: jax.Array
) -> jax.Array:
    """Sensitivities to rotation errors of the turns that take the axis along with the frame, (3, 3, K+1, N).

    Args:
        rotation: (3, 3, K+1, N), of {b} in {g}.
        shares: (K+1, N) weight of each pose, of sum 1.
        axes: (3, 3, N) of the frame, columns; a turn about each of them is a row.
        odd: (3, N) the one that lies along the axis of rotation.
        on_body: (N,) bool, whether the frame is oriented in {b}; else in {g}.
    """
    mean = jnp.sum(shares[None, None] * rotation, axis=2)
    # a turn about k moves the axis along k x a, by minus that along a x k
    beside = cross_rows(odd[None], jnp.swapaxes(axes, 0, 1))
    in_body = jnp.where(on_body[None, None], beside, apply_to_rows(jnp.swapaxes(mean, 0, 1), beside))
    rest = jnp.where(on_body[None, None], apply_to_rows(mean, beside), beside)
    here = jnp.broadcast_to(in_body[:, :, None], (*in_body.shape[:2], *rotation.shape[2:]))
    apart = apply_to_rows(rotation, here) - rest[:, :, None]
    in_ground = jnp.where(on_body[None], apply_to_rows(mean, odd[None])[0], odd)
    left = 1 - jnp.sum(jnp.square(jnp.where(on_body[None, None], rest, in_body)), axis=1)
    size = jnp.sum(jnp.square(beside), axis=1)
    known = (size > 0.5) & (left > 0)
    scale = jnp.where(known, -1 / jnp.where(known, left, 1), 0)
    arms = jnp.broadcast_to(in_ground[None, :, None], apart.shape)
    return scale[:, None, None] * shares[None, None] * cross_rows(apart, arms)


def kept_rows(
    rows: jax.Array, rotation: jax.Array, shares: jax.Array, in_ground: jax.Array, kept: jax.Array
) -> jax.Array:
    """Sensitivities to measured rotations, from those to rotations that were kept about an axis.

    Args:
        rows: (m, 3, K+1, N) sensitivities to errors in the ground.
        rotation: (3, 3, K+1, N), of {b} in {g}.
        shares: (K+1, N) weight of each pose, of sum 1.
        in_ground: (3, N) the axis.
        kept: (N,) bool, which windows were kept about it.
    """
    mean = jnp.sum(shares[None, None] * rotation, axis=2)
    axis = jnp.broadcast_to(in_ground[None, :, None], (1, *rows.shape[1:]))
    tilts = cross_rows(rows, axis)
    of_ground = jnp.sum(tilts, axis=2)
    of_body = jnp.sum(apply_to_rows(jnp.swapaxes(rotation, 0, 1), tilts), axis=2)
    back = apply_to_rows(jnp.swapaxes(mean, 0, 1), of_ground)
    apart = apply_to_rows(rotation, jnp.broadcast_to((back - of_body)[:, :, None], rows.shape))
    apart = apart - (of_ground - apply_to_rows(mean, of_body))[:, :, None]
    left = 1 - _middle_singular_value(mean, in_ground)
    scale = shares / jnp.where(kept, left, 1)[None]
    along = jnp.sum(rows * axis, axis=1, keepdims=True) * axis
    return jnp.where(kept[None, None, None], along + scale[None, None] * cross_rows(apart, axis), rows)


def _middle_singular_value(mean: jax.Array, axis: jax.Array) -> jax.Array:
    """Square of the singular values across the axis, (N,), which are equal for turns about one axis."""
    return (jnp.sum(jnp.square(mean), axis=(0, 1)) - 1) / 2


def combine_rows(
    own: tuple[jax.Array, jax.Array],
    weighed: tuple[jax.Array, jax.Array],
    other: tuple[jax.Array, jax.Array],
    both: jax.Array,
    noise: tuple[jax.Array, jax.Array],
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Sensitivities of the mean of two estimates of the same numbers, weighted by their information.

    Args:
        own: sensitivities of one to rotations and positions, (m, 3, K+1, N) each.
        weighed: those that its weight is taken from.
        other: of the other.
        both: (m, N) bool, which numbers are the mean of both; the rest are ``own``.
        noise: (N,) m and (N,) rad.

    Returns:
        Those to rotations and positions, and the weight of the other estimate, (m, N).
    """

    def variance(rows: tuple[jax.Array, jax.Array]) -> jax.Array:
        turn, shift = (jnp.sum(jnp.square(part), axis=(1, 2)) for part in rows)
        return jnp.square(noise[1])[None] * turn + jnp.square(noise[0])[None] * shift

    first, second = variance(weighed), variance(other)
    total = first + second
    weight = jnp.where(both & (second > 0), first / jnp.where(total > 0, total, 1), 0)
    share = weight[:, None, None]
    turn, shift = ((1 - share) * a + share * b for a, b in zip(own, other, strict=True))
    return turn, shift, weight

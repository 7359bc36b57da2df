"""Rotations about a single axis: how to find the axis, and how to remove the noise that tilts it.

A body that turns about an axis x of the ground, which is y in the body, keeps R(k) y = x. What tilts R(k) y
away from x is noise: two of its three components are known, and removing them keeps them from acting as
motion at the end of a lever.

All arrays have components first, then samples, then windows.
"""

from typing import NamedTuple, cast

import jax
import jax.numpy as jnp

from reframe_jax.geometry import symmetric
from reframe_jax.geometry.symmetric import Vector

__all__ = ["SingleAxis", "find_single_axis", "keep_axis"]

_AWAY = 1.6  # noises that the axis may be off, root mean square
_TURNS = 8.0  # noises that the body must turn about it, root mean square


class SingleAxis(NamedTuple):
    """The axis about which a body turns.

    Attributes:
        in_ground: (3, N) unit vectors.
        in_body: (3, N) unit vectors.
        spread: (N,) rad^2, variance of the angle about it.
        found: (N,) bool, whether the rotation is one about this axis and noise.
    """

    in_ground: jax.Array
    in_body: jax.Array
    spread: jax.Array
    found: jax.Array


def find_single_axis(rotation: jax.Array, counted: jax.Array, noise: jax.Array) -> SingleAxis:
    """Find the axis that the rotations keep in place best, by least squares.

    The mean of |R(k) y - x|^2 is smallest for the singular vectors of the mean rotation that belong to its
    largest singular value s. It is then 1 - s^2, half of it for each component of the tilt.

    Args:
        rotation: (3, 3, K+1, N) rotation matrices.
        counted: (K+1, N) bool, poses that count.
        noise: (N,) rad, of every component of the orientation.
    """
    weights = counted.astype(rotation.dtype)
    number = jnp.maximum(jnp.sum(weights, axis=0), 1)
    mean = jnp.sum(weights[None, None] * rotation, axis=2) / number[None, None]
    gram = tuple(jnp.sum(mean[:, i] * mean[:, j], axis=0) for i, j in symmetric.INDEX_PAIRS)
    (_, second, first), (_, _, axis) = symmetric.eigh(cast(symmetric.Symmetric, gram))
    in_body = jnp.stack(axis)
    in_ground = jnp.sum(mean * in_body[None], axis=1)
    length = jnp.sqrt(jnp.sum(jnp.square(in_ground), axis=0))
    variance = jnp.square(noise)
    found = (1 - first < 2 * _AWAY**2 * variance) & (1 - second > _TURNS**2 * variance)
    return SingleAxis(in_ground / jnp.where(length > 0, length, 1)[None], in_body, 1 - second, found)


def keep_axis(rotation: jax.Array, axis: SingleAxis) -> jax.Array:
    """Turn every rotation (3, 3, K+1, N) by the least angle that brings the axis to its place.

    Windows without a single axis stay as they are.
    """
    here = cast(Vector, tuple(jnp.sum(rotation * axis.in_body[None, :, None], axis=1)))
    x, y, z = (component[None] for component in axis.in_ground)
    turn = here[1] * z - here[2] * y, here[2] * x - here[0] * z, here[0] * y - here[1] * x
    cosine = here[0] * x + here[1] * y + here[2] * z

    def cross(matrix: jax.Array) -> jax.Array:
        """Cross product of the turn with every column."""
        a, b, c = (t[None] for t in turn)
        return jnp.stack(
            [b * matrix[2] - c * matrix[1], c * matrix[0] - a * matrix[2], a * matrix[1] - b * matrix[0]]
        )

    turned = cross(rotation)
    turned = rotation + turned + cross(turned) / (1 + jnp.where(axis.found[None], cosine, 1))[None, None]
    return jnp.where(axis.found[None, None, None], turned, rotation)

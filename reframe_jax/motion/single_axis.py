"""Rotations about a single axis: how to find the axis, and how to remove the noise that tilts it.

A body that turns about an axis x of the ground, which is y in the body, keeps R(k) y = x. What tilts R(k) y
away from x is noise: two of its three components are known, and removing them keeps them from acting as
motion at the end of a lever.

All arrays have components first, then samples, then windows.
"""

from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
from jax import lax

from reframe_jax.geometry import symmetric
from reframe_jax.geometry.symmetric import Vector
from reframe_jax.motion.components import cross

__all__ = [
    "SingleAxis",
    "TurnMoments",
    "across_axis",
    "find_single_axis",
    "keep_axis",
    "tilt_to_plane",
    "turn_moments",
]

_AWAY = 1.6  # noises that the axis may be off, root mean square
_TURNS = 8.0  # noises that the body must turn about it, root mean square
_INSTANT = 1e-30  # s^2, of times that are all the same


class SingleAxis(NamedTuple):
    """The axis about which a body turns.

    Attributes:
        in_ground: (3, N) unit vectors.
        in_body: (3, N) unit vectors.
        spread: (N,) rad^2, variance of the angle about it.
        found: (N,) bool, whether the rotation is one about this axis and noise.
        planar: (N,) bool, whether it is, and the body does not slide along the axis either.
        stiffness: (N,) m^2, how much the rotations resist a tilt of the axis where it is, by the noise.
    """

    in_ground: jax.Array
    in_body: jax.Array
    spread: jax.Array
    found: jax.Array
    planar: jax.Array
    stiffness: jax.Array


class TurnMoments(NamedTuple):
    """What moves with the angle about the axis.

    Attributes:
        variance: (N,) rad^2, of the angle. It counts full turns, unlike the spread of :class:`SingleAxis`.
        unsteady: (N,) rad^2, what is left of it without the part that grows evenly in time.
        with_paths: (3, 4, N) m rad and rad, covariance of the paths of points of the body with the angle.
    """

    variance: jax.Array
    unsteady: jax.Array
    with_paths: jax.Array


def turn_moments(
    axis: jax.Array, turns: jax.Array, paths: jax.Array, times: jax.Array, counted: jax.Array
) -> TurnMoments:
    """Sum up what moves with the angle about an axis.

    Args:
        axis: (3, N) unit vectors in {g}.
        turns: (3, K+1, N) rad, path whose derivative is the angular velocity in {g}, about its mean.
        paths: (3, 4, K+1, N) m and 1, of the type GB about their mean; see :func:`.kinematics.paths_of`.
        times: (K+1, N) s.
        counted: (K+1, N) bool, poses that count; ``turns`` and ``paths`` are zero at the others.
    """
    angle = jnp.sum(lax.stop_gradient(axis)[:, None] * turns, axis=0)
    variance = jnp.mean(jnp.square(angle), axis=0)
    weights = counted.astype(times.dtype)
    middle = jnp.sum(weights * times, axis=0) / jnp.maximum(jnp.sum(weights, axis=0), 1)
    passed = weights * (times - middle[None])
    evenly = jnp.sum(angle * passed, axis=0) / jnp.maximum(jnp.sum(jnp.square(passed), axis=0), _INSTANT)
    unsteady = jnp.mean(jnp.square(angle - evenly[None] * passed), axis=0)
    return TurnMoments(variance, unsteady, jnp.mean(paths * angle[None, None], axis=2))


def find_single_axis(
    rotation: jax.Array, position: jax.Array, counted: jax.Array, noise: tuple[jax.Array, jax.Array]
) -> SingleAxis:
    """Find the axis that the rotations keep in place best, by least squares.

    The mean of |R(k) y - x|^2 is smallest for the singular vectors of the mean rotation that belong to its
    largest singular value s. It is then 1 - s^2, half of it for each component of the tilt.

    A body that does not slide along the axis moves in a plane, and the axis is its normal. Both measure it,
    and with the information of both it is where the sum of the squares of all errors, each over its noise, is
    least.

    Args:
        rotation: (3, 3, K+1, N) rotation matrices.
        position: (3, K+1, N) m.
        counted: (K+1, N) bool, poses that count.
        noise: (N,) m and (N,) rad, of every component of position and orientation.
    """
    weights = counted.astype(rotation.dtype)
    number = jnp.maximum(jnp.sum(weights, axis=0), 1)
    mean = jnp.sum(weights[None, None] * rotation, axis=2) / number[None, None]
    gram = tuple(jnp.sum(mean[:, i] * mean[:, j], axis=0) for i, j in symmetric.INDEX_PAIRS)
    (_, second, first), (_, _, axis) = symmetric.eigh(cast(symmetric.Symmetric, gram))
    in_body = jnp.stack(axis)
    in_ground = _unit(jnp.sum(mean * in_body[None], axis=1))
    of_position, of_rotation = (jnp.square(size) for size in noise)
    found = (1 - first < 2 * _AWAY**2 * of_rotation) & (1 - second > _TURNS**2 * of_rotation)
    centre = jnp.sum(weights[None] * position, axis=1) / number[None]
    about = weights[None] * (position - centre[:, None])
    spread = tuple(jnp.sum(about[i] * about[j], axis=0) / number for i, j in symmetric.INDEX_PAIRS)
    known = found & (of_position > 0) & (of_rotation > 0)
    ratio = jnp.where(known, of_position, 1) / jnp.where(known, of_rotation, 1)
    # positions spread by their noise in all directions alike
    stiffness = jnp.where(known, ratio * (1 - second) - of_position, 1)
    normal = tilt_to_plane(in_ground, cast(symmetric.Symmetric, spread), stiffness)
    x, y, z = normal
    left = symmetric.quadratic_form((x, y, z), cast(symmetric.Symmetric, spread), (x, y, z))
    # an arc of a screw looks planar from an axis that is tilted far more than the rotations allow
    tilt = stiffness * jnp.sum(jnp.square(normal - in_ground), axis=0)
    planar = known & (left + tilt < _AWAY**2 * of_position)
    in_ground = jnp.where(planar[None], normal, in_ground)
    in_body = jnp.where(planar[None], _unit(jnp.sum(mean * normal[:, None], axis=0)), in_body)
    return SingleAxis(in_ground, in_body, 1 - second, found, planar, stiffness)


def tilt_to_plane(axis: jax.Array, spread: symmetric.Symmetric, stiffness: jax.Array) -> jax.Array:
    """The axis (3, N) tilted towards the normal of a plane: n with the least n.P.n + s |n - axis|^2.

    Args:
        axis: (3, N) unit vectors.
        spread: P, covariance of the positions, m^2.
        stiffness: (N,) m^2, s.
    """
    matrix, pull = across_axis(axis, spread, stiffness)
    return _unit(axis - jnp.stack(symmetric.solve(matrix, pull)))


def across_axis(
    axis: jax.Array, spread: symmetric.Symmetric, stiffness: jax.Array
) -> tuple[symmetric.Symmetric, Vector]:
    """Q P Q + s and Q P n, with Q = 1 - n n^T for the axis n.

    Args:
        axis: (3, N) unit vectors, n.
        spread: P, covariance of the positions, m^2.
        stiffness: (N,) m^2, s.
    """
    pulled = jnp.stack(symmetric.apply(spread, (axis[0], axis[1], axis[2])))
    along = jnp.sum(pulled * axis, axis=0)
    entries = [
        spread[k] - axis[i] * pulled[j] - pulled[i] * axis[j] + along * axis[i] * axis[j]
        for k, (i, j) in enumerate(symmetric.INDEX_PAIRS)
    ]
    xx, xy, xz, yy, yz, zz = entries
    a, b, c = pulled - along[None] * axis
    return (xx + stiffness, xy, xz, yy + stiffness, yz, zz + stiffness), (a, b, c)


def _unit(vector: jax.Array) -> jax.Array:
    """(3, N) of length 1."""
    length = jnp.sqrt(jnp.sum(jnp.square(vector), axis=0))
    return vector / jnp.where(length > 0, length, 1)[None]


def keep_axis(rotation: jax.Array, axis: SingleAxis) -> jax.Array:
    """Turn every rotation (3, 3, K+1, N) by the least angle that brings the axis to its place.

    Windows without a single axis stay as they are.
    """
    here, place = jnp.sum(rotation * axis.in_body[None, :, None], axis=1), axis.in_ground[:, None]
    turn = cross(here, place)[:, None]
    cosine = jnp.sum(here * place, axis=0)
    turned = cross(turn, rotation)
    turned = (
        rotation + turned + cross(turn, turned) / (1 + jnp.where(axis.found[None], cosine, 1))[None, None]
    )
    return jnp.where(axis.found[None, None, None], turned, rotation)

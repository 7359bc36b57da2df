"""Compute velocities from poses: twists, and the velocity of every possible origin of a frame.

The velocity of the origin of a frame is affine in the unknown position p of this origin,

    u(k; p) = a(k) + B(k) p,

for each step k and each of the four linear frame types (section 4 and Table 3 of the paper). This module
computes a and B. Here p is the position of the origin, so that its velocity is v + w x p; the paper's p is
minus this position.

Internal arrays have components first, then samples, then windows: rotations are (3, 3, K, ...). The public
functions take and return arrays with the components last, except :func:`split_poses`,
:func:`velocity_components` and :func:`turns_of`.
"""

from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp

from reframe_jax.geometry.small import axial, times
from reframe_jax.motion.paths import mean_twists, step_twists

Discretization = Literal["chord", "left"]


def _step_times(dt: jax.Array | float, poses: jax.Array) -> jax.Array:
    """Return the duration of each step, (..., K) s; batch axes with equal durations have size 1."""
    dt = jnp.asarray(dt, dtype=poses.dtype)
    dt = dt.reshape((1,) * (poses.ndim - 2 - dt.ndim) + dt.shape)
    return jnp.broadcast_to(dt, (*dt.shape[:-1], poses.shape[-3] - 1))


def split_poses(poses: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Split poses (..., K+1, 4, 4) into rotations (3, 3, K+1, ...) and positions (3, K+1, ...)."""
    top = jnp.moveaxis(poses[..., :3, :], (-2, -1, -3), (0, 1, 2))
    return top[:, :3], top[:, 3]


def velocity_components(
    poses: jax.Array, dt: jax.Array | float, discretization: Discretization = "chord"
) -> tuple[jax.Array, jax.Array]:
    """Compute angular velocities and linear velocity maps with components first, as moments need them.

    Arguments and errors as in :func:`linear_velocity_maps`.

    Returns:
        Angular velocities (3, 1, K, 2, ...), rad/s, for the types G and B; and maps (3, 4, K, 4, ...), m/s
        and 1/s, for the types BB, GB, GG and BG.
    """
    if discretization not in ("chord", "left"):
        raise ValueError(f"discretization must be 'chord' or 'left', not {discretization!r}.")
    rotation, position = split_poses(poses)
    steps = _step_times(dt, poses)
    step, inverse = jnp.moveaxis(steps, -1, 0)[None, None], jnp.swapaxes(rotation, 0, 1)
    # twists are functions of arrays with one axis of windows
    windows, number = rotation.shape[3:], steps.shape[-1]
    if any(size > 1 for size in steps.shape[:-1]):
        steps = jnp.broadcast_to(steps, (*windows, number))
    steps = steps.reshape(-1, number)
    count = jnp.full(1, number + 1, jnp.int32)
    flat = rotation.reshape(3, 3, number + 1, -1), position.reshape(3, number + 1, -1)
    logarithms = step_twists((flat[0][:, :, :-1], flat[1][:, :-1]), (flat[0][:, :, 1:], flat[1][:, 1:]))
    twists = logarithms / steps.T if discretization == "left" else mean_twists(logarithms, steps, count)
    body, spatial = jnp.moveaxis(twists, (2, 1), (0, 1)).reshape(2, 6, number, *windows)
    bb, gg = (_twist_map(twist) for twist in (body, spatial))
    if discretization == "left":
        gb, bg = times(rotation[:, :, :-1], bb), times(inverse[:, :, :-1], gg)
    else:
        in_ground = jnp.concatenate([position[:, None], rotation], axis=1)
        # a point p of the ground is R^T (p - x) in the body; relative to the body, it moves the opposite way
        in_body = jnp.concatenate([times(inverse, position)[:, None], -inverse], axis=1)
        gb, bg = jnp.diff(in_ground, axis=2) / step, jnp.diff(in_body, axis=2) / step
    rates = jnp.stack([spatial[:3], body[:3]], axis=2)
    return rates[:, None], jnp.stack([bb, gb, gg, bg], axis=3)


def turns_of(rotation: jax.Array) -> jax.Array:
    """Return axis times sine of the angle, (3, K, ...), of the steps between rotations (3, 3, K+1, ...)."""
    return -axial(times(jnp.swapaxes(rotation[:, :, :-1], 0, 1), rotation[:, :, 1:])) / 2


def _twist_map(twist: jax.Array) -> jax.Array:
    """Map (3, 4, ...) from a point p to its velocity v + w x p, for twists (6, ...)."""
    (x, y, z), v = twist[:3], twist[3:]
    zero = jnp.zeros_like(x)
    rows = v[0], zero, -z, y, v[1], z, zero, -x, v[2], -y, x, zero
    return jnp.stack(rows).reshape(3, 4, *x.shape)


@partial(jax.jit, static_argnames="discretization", inline=True)
def angular_velocities(
    poses: jax.Array, dt: jax.Array | float, discretization: Discretization = "chord"
) -> jax.Array:
    """Compute the angular velocity of {b} in the axes of the two angular frame types.

    Arguments and errors as in :func:`linear_velocity_maps`.

    Returns:
        (..., 2, K, 3) rad/s: in the axes of {g}, then in the axes of {b} (the order of ``AngularType``).
    """
    return jnp.moveaxis(velocity_components(poses, dt, discretization)[0][:, 0], (2, 1, 0), (-3, -2, -1))


@partial(jax.jit, static_argnames="discretization", inline=True)
def linear_velocity_maps(
    poses: jax.Array, dt: jax.Array | float, discretization: Discretization = "chord"
) -> jax.Array:
    """Compute, for the four linear frame types, the map from the position of an origin to its velocity.

    The velocity of the origin of a frame in step k is u(k; p) = a(k) + B(k) p. Its axes are those of the body
    that the first letter of the type names. The position p is in the body that the second letter names.

    Args:
        poses: (..., K+1, 4, 4) of {b} in {g}, m.
        dt: time between two poses, s: a scalar, or (..., K) for irregular sampling.
        discretization: method to compute a velocity from two poses. ``"chord"`` is for measured motion. For
            GB and BG, the velocity is the displacement of the origin divided by dt. For BB and GG, it follows
            from the mean of the twist over the step: the logarithm of the step without the brackets of the
            Magnus expansion. The error is of sixth order in dt, or of third order if the sample times jitter.
            ``"left"`` is the method of the paper's Table 3: the logarithm of the step, expressed at the pose
            at the start of the step. It is exact for poses that the paper's Eq. 9 generates.

    Returns:
        (..., 4, K, 3, 4) matrices (a | B), m/s and 1/s, for the types BB, GB, GG and BG (the order of
        ``LinearType``).

    Raises:
        ValueError: for an unknown discretization.
    """
    return jnp.moveaxis(velocity_components(poses, dt, discretization)[1], (3, 2, 0, 1), (-4, -3, -2, -1))

"""Velocities along the axes of identified frames."""

from functools import partial

import jax

from reframe_jax.geometry.products import apply, matmul
from reframe_jax.identification.results import Identification
from reframe_jax.motion import kinematics
from reframe_jax.motion.kinematics import Discretization

__all__ = ["frame_velocities"]


@partial(jax.jit, static_argnames="discretization")
def frame_velocities(
    poses: jax.Array,
    steps: jax.Array,
    found: Identification,
    discretization: Discretization = "chord",
) -> tuple[jax.Array, jax.Array]:
    """Velocities along the axes of the identified frames, over time: what is left where they are zero.

    For one window; use ``jax.vmap`` for many.

    Args:
        poses: (K+1, 4, 4), m.
        steps: (K,) sample times, s.
        found: identification of these poses.
        discretization: the one it was made with.

    Returns:
        Angular velocities (K, 3), rad/s, and linear velocities of the origin (K, 3), m/s. Their RMS are
        ``rms`` of the two frames, except along free axes where the position was left a choice.
    """
    rates = kinematics.angular_velocities(poses, steps, discretization)[found.angular.type_code]
    maps = kinematics.linear_velocity_maps(poses, steps, discretization)[found.linear.type_code]
    velocities = maps[..., 0] + apply(maps[..., 1:], found.linear.position)
    return matmul(rates, found.angular.axes), matmul(velocities, found.linear.axes)

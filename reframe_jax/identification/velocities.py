"""Velocities along the axes of identified frames."""

from functools import partial

import jax
import jax.numpy as jnp

from reframe_jax.geometry.products import apply, matmul
from reframe_jax.identification.results import Identification
from reframe_jax.motion import kinematics
from reframe_jax.motion.kinematics import Discretization


@partial(jax.jit, static_argnames="discretization")
def frame_velocities(
    poses: jax.Array, steps: jax.Array, found: Identification, discretization: Discretization = "chord"
) -> tuple[jax.Array, jax.Array]:
    """Compute the velocities along the axes of identified frames; constrained axes have small velocities.

    The function takes one window; use ``jax.vmap`` for a batch.

    Args:
        poses: (K+1, 4, 4) m.
        steps: (K,) s, durations of the steps between consecutive poses.
        found: identification of these poses.
        discretization: method to compute a velocity from two poses, as in :func:`identify`.

    Returns:
        Angular velocities about the axes of the angular frame, (K, 3) rad/s, and velocities of the origin
        along the axes of the linear frame, (K, 3) m/s. Row k belongs to the step from pose k to pose k + 1;
        it is NaN if one of these poses is an outlier.

    Raises:
        ValueError: for an unknown discretization, or for arrays that do not fit the identification.
    """
    if poses.shape != (*found.counted.shape, 4, 4) or steps.shape != (len(poses) - 1,):
        raise ValueError(f"Expected the poses and steps of one window, not {poses.shape} and {steps.shape}.")
    rates = kinematics.angular_velocities(poses, steps, discretization)[found.angular.type_code]
    maps = kinematics.linear_velocity_maps(poses, steps, discretization)[found.linear.type_code]
    velocities = maps[..., 0] + apply(maps[..., 1:], found.linear.position)
    known = (found.counted[:-1] & found.counted[1:])[:, None]
    return (
        jnp.where(known, matmul(rates, found.angular.axes), jnp.nan),
        jnp.where(known, matmul(velocities, found.linear.axes), jnp.nan),
    )

"""Rigid-body transforms: the group SE(3) as 4x4 pose matrices and 6-vectors.

A pose ``T`` of frame {b} in frame {g} maps coordinates in {b} to coordinates in {g}. A twist (or any
tangent vector) is (angular, linear) = (w, v), in that order, as in Lynch & Park's *Modern Robotics*
and the paper's section 2. Every function accepts leading batch axes.

The 6x6 left Jacobian follows from the 3x3 left Jacobian, because SE(3) is SO(3) over dual numbers: the block
that couples v to w is the derivative of the 3x3 Jacobian at w in the direction v.
"""

import jax
import jax.numpy as jnp

from reframe_jax.geometry import rotations
from reframe_jax.geometry.products import apply

__all__ = ["make_pose", "pose_exp", "pose_left_jacobian_inverse"]


def make_pose(rotation: jax.Array, position: jax.Array) -> jax.Array:
    """Pose matrices (..., 4, 4) from rotation matrices (..., 3, 3) and positions (..., 3), m."""
    top = jnp.concatenate([rotation, position[..., None]], axis=-1)
    bottom = jnp.broadcast_to(jnp.asarray([0, 0, 0, 1], dtype=top.dtype), (*top.shape[:-2], 1, 4))
    return jnp.concatenate([top, bottom], axis=-2)


def pose_exp(twist: jax.Array) -> jax.Array:
    """Poses (..., 4, 4) after motions with constant twists (..., 6) for unit time: exponentials of SE(3)."""
    w, v = twist[..., :3], twist[..., 3:]
    return make_pose(rotations.rotation_exp(w), apply(rotations.left_jacobian(w), v))


def pose_left_jacobian_inverse(twist: jax.Array) -> jax.Array:
    """Inverses (..., 6, 6) of the left Jacobians of SE(3): ``exp(x + dx) ~ exp(J_l(x) dx) exp(x)``.

    The twists x (..., 6), rad and m, have rotation angles below 2 pi.
    """
    diagonal, lower = jax.jvp(rotations.left_jacobian_inverse, (twist[..., :3],), (twist[..., 3:],))
    top = jnp.concatenate([diagonal, jnp.zeros_like(diagonal)], axis=-1)
    return jnp.concatenate([top, jnp.concatenate([lower, diagonal], axis=-1)], axis=-2)

"""Rigid-body transforms: the group SE(3) as 4x4 pose matrices and 6-vectors.

A pose ``T`` of frame {b} in frame {g} maps coordinates in {b} to coordinates in {g}. A twist is (w, v): the
angular part first, then the linear part, as in Lynch & Park's *Modern Robotics* and the paper's section 2.
Every function accepts leading batch axes.

The 6x6 left Jacobian follows from the 3x3 left Jacobian, because SE(3) is SO(3) over dual numbers: the block
that couples v to w is the derivative of the 3x3 Jacobian at w in the direction v.
"""

import jax
import jax.numpy as jnp

from reframe_jax.geometry import rotations
from reframe_jax.geometry.products import apply

__all__ = ["make_pose", "pose_exp", "pose_left_jacobian_inverse"]


def make_pose(rotation: jax.Array, position: jax.Array) -> jax.Array:
    """Build pose matrices (..., 4, 4) from rotation matrices (..., 3, 3) and positions (..., 3), m."""
    top = jnp.concatenate([rotation, position[..., None]], axis=-1)
    bottom = jnp.broadcast_to(jnp.asarray([0, 0, 0, 1], dtype=top.dtype), (*top.shape[:-2], 1, 4))
    return jnp.concatenate([top, bottom], axis=-2)


def pose_exp(twist: jax.Array) -> jax.Array:
    """Return the poses (..., 4, 4) after 1 s of constant twists (..., 6): the exponential of SE(3)."""
    w, v = twist[..., :3], twist[..., 3:]
    return make_pose(rotations.rotation_exp(w), apply(rotations.left_jacobian(w), v))


def pose_left_jacobian_inverse(twist: jax.Array) -> jax.Array:
    """Return the inverses (..., 6, 6) of the left Jacobians J_l of SE(3) at vectors x (..., 6), rad and m.

    The left Jacobian maps a small change of x to a small motion: ``exp(x + dx) ~ exp(J_l(x) dx) exp(x)``. The
    rotation angle of x must be below 2 pi.
    """
    diagonal, lower = jax.jvp(rotations.left_jacobian_inverse, (twist[..., :3],), (twist[..., 3:],))
    top = jnp.concatenate([diagonal, jnp.zeros_like(diagonal)], axis=-1)
    return jnp.concatenate([top, jnp.concatenate([lower, diagonal], axis=-1)], axis=-2)

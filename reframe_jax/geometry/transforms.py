"""Rigid-body transforms: the group SE(3) as 4x4 pose matrices and 6-vectors.

A pose ``T`` of frame {b} in frame {g} maps coordinates in {b} to coordinates in {g}. A twist is (w, v): the
angular part first, then the linear part, as in Lynch & Park's *Modern Robotics* and the paper's section 2.
Every function accepts leading batch axes.
"""

import jax
import jax.numpy as jnp

from reframe_jax.geometry import rotations
from reframe_jax.geometry.products import apply


def make_pose(rotation: jax.Array, position: jax.Array) -> jax.Array:
    """Build pose matrices (..., 4, 4) from rotation matrices (..., 3, 3) and positions (..., 3), m."""
    top = jnp.concatenate([rotation, position[..., None]], axis=-1)
    bottom = jnp.broadcast_to(jnp.asarray([0, 0, 0, 1], dtype=top.dtype), (*top.shape[:-2], 1, 4))
    return jnp.concatenate([top, bottom], axis=-2)


def pose_exp(twist: jax.Array) -> jax.Array:
    """Return the poses (..., 4, 4) after 1 s of constant twists (..., 6): the exponential of SE(3)."""
    w, v = twist[..., :3], twist[..., 3:]
    return make_pose(rotations.rotation_exp(w), apply(rotations.left_jacobian(w), v))

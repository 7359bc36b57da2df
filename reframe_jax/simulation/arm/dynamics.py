"""The arm's equations of motion, by the method of Newton and Euler, in the axes of the base.

Gravity and the gravity compensation of the robot cancel, so neither is computed. Small matrices are
multiplied elementwise, because a library call per matrix of a batch costs more than the product.
"""

from dataclasses import dataclass
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.constraints.located import multiply
from reframe_jax.geometry.numpy_rotations import quaternions_to_matrices
from reframe_jax.simulation.arm.model import PANDA, Arm, link_poses


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Motion:
    """The state of the arm at an instant, in the axes of its base.

    Attributes:
        joints: (7,) rad.
        velocity: (7,) rad/s.
        rotation: (3, 3), orientation of {b} in {g}.
        position: (3,) m, origin of {b} in {g}.
        jacobian: (6, 7) from joint velocities to the twist of {b}: its angular velocity (rad/s), then the
            velocity of its origin (m/s), both in the axes of {g}.
        mass: (7, 7) kg m^2, the mass matrix, including the armature.
        bias: (7,) N m, Coriolis and centrifugal torques.
    """

    joints: jax.Array
    velocity: jax.Array
    rotation: jax.Array
    position: jax.Array
    jacobian: jax.Array
    mass: jax.Array
    bias: jax.Array

    @property
    def twist(self) -> jax.Array:
        """(6,) rad/s and m/s: angular velocity of {b}, velocity of its origin, in the axes of {g}."""
        return multiply(self.jacobian, self.velocity)


@cache
def _inertias(arm: Arm) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Masses (8,), kg, centres of mass (8, 3), m, and inertias (8, 3, 3), kg m^2, of the links and the hand.

    The centres, and the inertias about them, are in the frames of :func:`link_poses`.
    """
    model = arm.model
    axes = quaternions_to_matrices(np.roll(model.body_iquat[1:], -1, axis=1))
    centres = model.body_ipos[1:].copy()
    centres[-1] -= model.site("tcp").pos
    return model.body_mass[1:], centres, axes * model.body_inertia[1:, None] @ axes.swapaxes(1, 2)


def arm_motion(joints: jax.Array, velocity: jax.Array, arm: Arm = PANDA) -> Motion:
    """Kinematics and dynamics of the arm.

    Args:
        joints: (7,) rad.
        velocity: (7,) rad/s.
        arm: the robot.
    """
    dtype = joints.dtype
    masses, centres, inertias = (jnp.asarray(part, dtype=dtype) for part in _inertias(arm))
    rotations, origins = link_poses(joints, arm)
    levers = origins + jnp.sum(rotations * centres[:, None], axis=-1)
    inertias = jnp.sum(rotations[..., None] * inertias[:, None], axis=2)
    inertias = jnp.sum(inertias[:, :, None] * rotations[:, None], axis=-1)
    # masses, first moments and inertias about the origin of the base
    firsts = masses[:, None] * levers
    square = jnp.sum(firsts * levers, axis=-1)[:, None, None] * jnp.eye(3, dtype=dtype)[None]
    bodies = masses[:, None], firsts, inertias + square - firsts[:, :, None] * levers[:, None]
    # twists (7, 6) of the joints at unit velocity: rad/s, and m/s of the point at the origin of the base
    axes = rotations[:7, :, 2]
    screws = _pair(axes, jnp.cross(origins[:7], axes))
    upper = jnp.triu(jnp.sum(screws[:, None] * _momenta(jax.tree.map(_after, bodies), screws)[None], axis=-1))
    # twists (8, 6) of the links, and their rates of change at constant joint velocities
    twists = _before(screws * velocity[:, None])
    (turning, moving), (spins, pushes) = jnp.split(twists, 2, 1), jnp.split(_momenta(bodies, twists), 2, 1)
    angular, linear = jnp.split(screws * velocity[:, None], 2, axis=1)
    w, v = turning[:7], moving[:7]
    rates = _before(_pair(jnp.cross(w, angular), jnp.cross(w, linear) + jnp.cross(v, angular)))
    forces = _momenta(bodies, rates)
    forces = forces + _pair(jnp.cross(turning, spins) + jnp.cross(moving, pushes), jnp.cross(turning, pushes))
    return Motion(
        joints=joints,
        velocity=velocity,
        rotation=rotations[7],
        position=origins[7],
        jacobian=_pair(axes, jnp.cross(axes, origins[7] - origins[:7])).T,
        mass=upper + jnp.triu(upper, 1).T + jnp.diag(jnp.asarray(arm.model.dof_armature, dtype=dtype)),
        bias=jnp.sum(screws * _after(forces), axis=-1),
    )


def _pair(angular: jax.Array, linear: jax.Array) -> jax.Array:
    return jnp.concatenate([angular, linear], axis=1)


def _after(parts: jax.Array) -> jax.Array:
    """Sums over the links (8, ...) that each joint moves, (7, ...)."""
    return jnp.cumsum(parts[::-1], axis=0)[:0:-1]


def _before(parts: jax.Array) -> jax.Array:
    """Sums over the joints (7, 6) that move each link, (8, 6)."""
    total = jnp.cumsum(parts, axis=0)
    return jnp.concatenate([total, total[6:]])


def _momenta(bodies: tuple[jax.Array, jax.Array, jax.Array], twists: jax.Array) -> jax.Array:
    """Angular and linear momenta (n, 6) about the origin of the base, from twists (n, 6).

    The bodies are masses (n, 1), first moments (n, 3) and inertias (n, 3, 3) about the same point.
    """
    (mass, first, inertia), (w, v) = bodies, jnp.split(twists, 2, axis=1)
    return _pair(jnp.sum(inertia * w[:, None], axis=-1) + jnp.cross(first, v), mass * v + jnp.cross(w, first))


def solve_positive(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Solve A X = B, (n, m), for a symmetric positive definite A (n, n), by Gauss and Jordan.

    For a batch of small matrices, library calls cost more than the arithmetic; these elementwise operations
    are vectorized over the batch.
    """
    both = jnp.concatenate([matrix, right], axis=1)
    for i in range(len(matrix)):
        row = both[i] / both[i, i]
        both = (both - both[:, i, None] * row[None]).at[i].set(row)
    return both[:, len(matrix) :]

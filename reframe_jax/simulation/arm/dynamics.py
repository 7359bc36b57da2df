"""The arm's equations of motion: kinematics, mass matrix, and Coriolis and centrifugal torques.

The joints form a chain, so sums along the chain replace the recursions of a general simulator. This package
adds the forces of constraints, hands and controllers, and solves the constraint of a demonstration exactly
(see ``rollout``). Gravity and the gravity compensation of the robot cancel, so neither is computed.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from reframe_jax.constraints.located import multiply
from reframe_jax.simulation.arm.model import PANDA, Arm, link_inertias, link_poses

__all__ = ["Motion", "arm_motion", "solve_positive"]


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


def arm_motion(joints: jax.Array, velocity: jax.Array, arm: Arm = PANDA) -> Motion:
    """Kinematics and dynamics of the arm.

    Args:
        joints: (7,) rad.
        velocity: (7,) rad/s.
        arm: the robot.
    """
    masses, centres, inertias = (jnp.asarray(part, dtype=joints.dtype) for part in link_inertias(arm))
    turns, anchors, rotation, position = link_poses(joints, arm)
    # all vectors in the axes of the base, all moments and velocities at its origin: an axis has the twist
    # (axes, shifts), a link the mass, the first moment and the inertia
    axes = turns[:, :, 2]
    shifts = jnp.cross(anchors, axes)
    places = anchors + _times(turns, centres)
    first = masses[:, None] * places
    about = jnp.sum(turns[:, :, :, None] * inertias[:, None, :, :], axis=2)
    about = jnp.sum(about[:, :, None, :] * turns[:, None, :, :], axis=-1)
    lengths = jnp.sum(places * first, axis=-1)[:, None, None] * jnp.eye(3, dtype=joints.dtype)[None]
    inertia = about + lengths - first[:, :, None] * places[:, None, :]
    # a joint accelerates its own link and the later ones
    later = _backwards(masses), _backwards(first), _backwards(inertia)
    every = _momentum(*later, axes, shifts)
    upper = jnp.triu(jnp.sum(axes[:, None] * every[0][None] + shifts[:, None] * every[1][None], axis=-1))
    # velocities, and accelerations while the joints do not accelerate
    own = velocity[:, None] * axes, velocity[:, None] * shifts
    spin, drift = (jnp.cumsum(part, axis=0) for part in own)
    twisting = jnp.cumsum(jnp.cross(spin, own[0]), axis=0)
    pulling = jnp.cumsum(jnp.cross(spin, own[1]) + jnp.cross(drift, own[0]), axis=0)
    angular, linear = _momentum(masses, first, inertia, spin, drift)
    moment, force = _momentum(masses, first, inertia, twisting, pulling)
    moment = _backwards(moment + jnp.cross(spin, angular) + jnp.cross(drift, linear))
    force = _backwards(force + jnp.cross(spin, linear))
    armature = jnp.diag(jnp.asarray(arm.armature, dtype=joints.dtype))
    return Motion(
        joints=joints,
        velocity=velocity,
        rotation=rotation,
        position=position,
        jacobian=jnp.concatenate([axes.T, jnp.cross(axes, position[None] - anchors).T]),
        mass=upper + jnp.triu(upper, 1).T + armature,
        bias=jnp.sum(axes * moment + shifts * force, axis=-1),
    )


def _times(matrices: jax.Array, vectors: jax.Array) -> jax.Array:
    """Products (n, 3) of matrices (n, 3, 3) and vectors (n, 3), elementwise."""
    return jnp.sum(matrices * vectors[:, None, :], axis=-1)


def _momentum(
    mass: jax.Array, first: jax.Array, inertia: jax.Array, spin: jax.Array, drift: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Angular and linear momentum (n, 3) of n bodies with twists (n, 3) each, at the origin."""
    return _times(inertia, spin) + jnp.cross(first, drift), mass[:, None] * drift + jnp.cross(spin, first)


def _backwards(values: jax.Array) -> jax.Array:
    """Sums over each link and the later ones."""
    return jnp.flip(jnp.cumsum(jnp.flip(values, 0), axis=0), 0)


def solve_positive(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Solve A X = B, (n, m), for a symmetric positive definite A (n, n), with n up to about 7.

    For a batch of small matrices, library calls cost more than the arithmetic. This unrolled Cholesky
    factorization is vectorized over the batch.
    """
    size = matrix.shape[0]
    lower: list[list[jax.Array]] = []
    for i in range(size):
        row: list[jax.Array] = []
        for j in range(i + 1):
            value = matrix[i, j]
            for k in range(j):
                value = value - row[k] * (row[k] if j == i else lower[j][k])
            row.append(jnp.sqrt(value) if j == i else value / lower[j][j])
        lower.append(row)
    forward: list[jax.Array] = []
    for i in range(size):
        value = right[i]
        for k in range(i):
            value = value - lower[i][k] * forward[k]
        forward.append(value / lower[i][i])
    solution: list[jax.Array] = [right[0]] * size
    for i in reversed(range(size)):
        value = forward[i]
        for k in range(i + 1, size):
            value = value - lower[k][i] * solution[k]
        solution[i] = value / lower[i][i]
    return jnp.stack(solution)

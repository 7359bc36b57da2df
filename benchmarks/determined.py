"""Find windows that determine their constraint: the exact motion obeys no other constraint as restrictive.

For every frame type, the exact motion is evaluated at the optimum of the norm of the measured poses over time
scales. (With exact poses, every origin that keeps the constrained axes at zero is an optimum; the noise
selects one of these.) An axis counts as constrained if the displacement along it is at most ten times the
noise of a pose: a constraint that also fixes this axis fits the recording equally well. The degrees of
freedom are determined if no frame type has more constrained axes than the truth. The type is determined if no
other type has as many.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import reframe_jax as rf
from reframe_jax.constraints.types import POSITION_BODIES
from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.motion.kinematics import velocity_components

__all__ = ["Determination", "determined", "distances"]

_NOISES = 10  # smallest displacement of a free axis, in units of the noise


class Determination(NamedTuple):
    """Whether the motion determines the constraint, for N windows.

    Attributes:
        dof: (N,) bool, whether the motion determines the degrees of freedom.
        name: (N,) bool, whether the motion also determines the frame type, if the name depends on the type.
    """

    dof: np.ndarray
    name: np.ndarray


def determined(
    label: str,
    frame: rf.ConstraintFrame,
    exact: np.ndarray,
    measured: np.ndarray,
    dt: float,
    sigma: np.ndarray,
    rotation_ratio: np.ndarray,
) -> Determination:
    """Compute whether the motion of windows determines the true constraint.

    Args:
        label: label of the constraint.
        frame: true geometry of the constraint.
        exact: (N, K+1, 4, 4) true poses, m.
        measured: (N, K+1, 4, 4) poses with noise, m.
        dt: s.
        sigma: (N,) m, standard deviation of the noise in every component of the position.
        rotation_ratio: (N,) rad/m, ratio of the standard deviation of every component of the rotation to
            ``sigma``.
    """
    found = rf.identify(measured, dt=dt).candidates
    position = jnp.asarray(found.linear.position)
    rotvecs = found.angular.rotvec, found.linear.rotvec
    turns, moves, levers = distances(jnp.asarray(exact), dt, rotvecs, position)
    turning = np.asarray(turns) / (rotation_ratio * sigma)[:, None, None]
    noise = sigma[:, None] * np.sqrt(1 + (rotation_ratio[:, None] * np.asarray(levers)) ** 2)
    moving = np.asarray(moves) / noise[:, :, None]
    free_rotations, free_translations = (np.sum(x > _NOISES, axis=2) for x in (turning, moving))
    entry = rf.CONSTRAINTS[label]
    number = sum(entry.linear_dof)
    angular = free_rotations[:, int(frame.angular_type)] == sum(entry.angular_dof)
    own = free_translations[:, int(frame.linear_type)] == number
    dof = angular & own & (np.min(free_translations, axis=1) == number)
    unique_type = np.sum(free_translations == number, axis=1) == 1
    return Determination(dof, dof & (unique_type | (entry.linear_type is None)))


@jax.jit
def distances(
    poses: jax.Array, dt: float, rotvecs: tuple[jax.Array, jax.Array], position: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Displacements of frames along their axes, (N, 2, 3) rad and (N, 4, 3) m, and their levers, (N, 4) m.

    A displacement is a standard deviation over the window; a lever is an RMS distance.

    Args:
        poses: (N, K+1, 4, 4) m.
        dt: s.
        rotvecs: rotation vectors of the axes, (N, 2, 3) and (N, 4, 3).
        position: (N, 4, 3) m, origins.
    """
    rates, maps = velocity_components(poses, dt)  # (3, 1, K, 2, N) and (3, 4, K, 4, N)
    origin = jnp.moveaxis(position, 0, -1)  # (4, 3, N)
    velocity = maps[:, 0] + sum(maps[:, 1 + i] * origin[None, None, :, i] for i in range(3))

    def along(rate: jax.Array, rotvec: jax.Array) -> jax.Array:
        axes = rotation_exp(rotvec)
        path = jnp.cumsum(dt * jnp.einsum("iktn,ntij->kntj", rate, axes), axis=0)
        return jnp.std(path, axis=0)

    ground = jnp.asarray(int(rf.AngularType.G) == POSITION_BODIES)
    body = jnp.where(ground[None, :, None, None], poses[:, None, :, :3, 3], 0)
    apart = jnp.sum(jnp.square(position[:, :, None] - body), axis=-1)
    lever = jnp.sqrt(jnp.mean(apart, axis=-1))
    return along(rates[:, 0], rotvecs[0]), along(velocity, rotvecs[1]), lever

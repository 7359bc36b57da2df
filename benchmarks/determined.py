"""Which windows tell the constraint: those whose exact motion obeys no other as tight, nor a tighter one.

The exact motion is seen at the optimum of the norm for every frame type. The optimum is that of the measured
poses over time scales: of exact poses it is any origin that leaves the constrained axes at zero, and among
these the noise decides which holds the other axes best. An axis along which the frame
goes no farther than ten times the noise of a pose counts as held there: a constraint that holds it as well
explains the recording as well. The degrees of freedom are determined where the true type holds no more axes
than the truth does, and no other type does; the type where no other holds as many.
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

_NOISES = 10  # that an axis goes at least to be seen free


class Determination(NamedTuple):
    """What the motion tells of N windows.

    Attributes:
        dof: (N,) bool, whether the degrees of freedom.
        name: (N,) bool, whether the frame type as well, where it makes a difference.
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
    """What the motion tells of the truth.

    Args:
        label: of the constraint.
        frame: its geometry.
        exact: (N, K+1, 4, 4) true poses, m.
        measured: (N, K+1, 4, 4) the same with noise.
        dt: s.
        sigma: (N,) standard deviation of the noise in every component of the position, m.
        rotation_ratio: (N,) that of every component of the rotation over ``sigma``, rad/m.
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
    """How far frames go along their axes, (N, 2, 3) rad and (N, 4, 3) m, and their levers, (N, 4) m.

    Distances are standard deviations over the window; a lever is the root of the mean square.

    Args:
        poses: (N, K+1, 4, 4) m.
        dt: s.
        rotvecs: of the axes, (N, 2, 3) and (N, 4, 3).
        position: (N, 4, 3) m, of the origins.
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

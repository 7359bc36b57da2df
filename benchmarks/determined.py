"""Which windows tell the degrees of freedom: those whose exact motion obeys no tighter constraint.

The exact motion is seen at the optimum of the paper's objective for every frame type. An axis along which the
frame goes no farther than ten times the noise of a pose counts as held there: a constraint that holds it as
well explains the recording as well. The truth is determined where its own type holds no more axes than the
truth does, and no other type does.
"""

import jax
import jax.numpy as jnp
import numpy as np

import reframe_jax as rf
from benchmarks.lags import identify_at
from reframe_jax.constraints.types import POSITION_BODIES
from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.motion.kinematics import velocity_components

__all__ = ["determined"]

_NOISES = 10  # that an axis goes at least to be seen free


def determined(
    frame: rf.ConstraintFrame, exact: np.ndarray, dt: float, sigma: np.ndarray, rotation_ratio: np.ndarray
) -> np.ndarray:
    """Whether the motion tells the degrees of freedom of the truth, (N,) bool.

    Args:
        frame: the true constraint.
        exact: (N, K+1, 4, 4) true poses, m.
        dt: s.
        sigma: (N,) standard deviation of the noise in every component of the position, m.
        rotation_ratio: (N,) that of every component of the rotation over ``sigma``, rad/m.
    """
    found = identify_at(1, exact, dt=dt).candidates
    position = jnp.asarray(found.linear.position)
    rotvecs = found.angular.rotvec, found.linear.rotvec
    turns, moves, levers = _distances(jnp.asarray(exact), dt, rotvecs, position)
    turning = np.asarray(turns) / (rotation_ratio * sigma)[:, None, None]
    noise = sigma[:, None] * np.sqrt(1 + (rotation_ratio[:, None] * np.asarray(levers)) ** 2)
    moving = np.asarray(moves) / noise[:, :, None]
    free_rotations, free_translations = (np.sum(x > _NOISES, axis=2) for x in (turning, moving))
    angular = free_rotations[:, int(frame.angular_type)] == sum(frame.angular_dof)
    own = free_translations[:, int(frame.linear_type)] == sum(frame.linear_dof)
    return angular & own & (np.min(free_translations, axis=1) == sum(frame.linear_dof))


@jax.jit
def _distances(
    poses: jax.Array, dt: float, rotvecs: tuple[jax.Array, jax.Array], position: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """How far frames go along their axes, (N, 2, 3) rad and (N, 4, 3) m, and their levers, (N, 4) m.

    Distances are standard deviations over the window; a lever is the root of the mean square.
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

"""The arm's equations of motion, from the smooth dynamics of MJX.

MJX computes the mass matrix and the Coriolis and centrifugal torques, as in a step of :func:`mujoco.mjx.step`
before its solver. This package adds the forces of constraints, hands and controllers, and solves the
constraint of a demonstration exactly (see ``rollout``). Gravity and the gravity compensation of the robot
cancel, so neither is computed by default.
"""

import contextlib
import io
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

with contextlib.redirect_stdout(io.StringIO()):  # MJX prints the names of missing optional packages
    from mujoco import mjx
    from mujoco.mjx._src import scan as mjx_scan

from reframe_jax.geometry.products import apply
from reframe_jax.simulation.arm.model import PANDA, Arm, arm_xml

__all__ = ["Motion", "arm_motion", "fence_levels", "inverse_dynamics", "jacobian", "solve_positive"]


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
        bias: (7,) N m, Coriolis and centrifugal torques, and gravity if requested.
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
        return jnp.sum(self.jacobian * self.velocity[None, :], axis=-1)


@contextlib.contextmanager
def fence_levels() -> Iterator[None]:
    """Prevent XLA from recomputing the kinematic chain at every link while MJX is traced.

    On the CPU, XLA's fusion emitters (jax 0.7 to 0.10) inline each level of MJX's scan over the tree into the
    next level. The work then grows at least with the square of the depth: 10 ms per step instead of 0.05
    (google-deepmind/mujoco#2957). A barrier around the value that each link passes to the next prevents the
    inlining, and costs nothing on other devices. MJX has no public hook for this barrier.
    """
    body_tree = mjx_scan.body_tree

    def with_barriers(model: Any, function: Any, *args: Any, **options: Any) -> Any:
        def run_barred(carry: Any, *rest: Any) -> Any:
            return function(carry if carry is None else jax.lax.optimization_barrier(carry), *rest)

        return body_tree(model, run_barred, *args, **options)

    mjx_scan.body_tree = with_barriers
    try:
        yield
    finally:
        mjx_scan.body_tree = body_tree


@contextlib.contextmanager
def allow_mixing() -> Iterator[None]:
    """Allow MJX to mix dtypes and ranks, independent of the user's JAX settings."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


@cache
def mujoco_model(arm: Arm, gravity: bool = False) -> mujoco.MjModel:
    """The arm compiled by MuJoCo."""
    return mujoco.MjModel.from_xml_string(arm_xml(arm, gravity=gravity))


@cache
def _mjx_parts(arm: Arm, gravity: bool) -> tuple[Any, Any]:
    return mjx_parts(mujoco_model(arm, gravity))


def mjx_parts(model: mujoco.MjModel) -> tuple[Any, Any]:
    """MJX model and data in double precision, as NumPy arrays that any trace can use as constants."""
    with jax.ensure_compile_time_eval(), jax.enable_x64(True), allow_mixing():
        parts = mjx.put_model(model, impl="jax"), mjx.make_data(model, impl="jax")
        return jax.tree.map(np.asarray, parts)


def in_dtype(tree: Any, dtype: Any) -> Any:
    """Convert the floating-point leaves of a tree to a dtype."""

    def cast(leaf: Any) -> Any:
        return jnp.asarray(leaf, dtype=dtype if np.issubdtype(leaf.dtype, np.floating) else None)

    return jax.tree.map(cast, tree)


def arm_motion(joints: jax.Array, velocity: jax.Array, arm: Arm = PANDA, *, gravity: bool = False) -> Motion:
    """Kinematics and dynamics of the arm.

    Args:
        joints: (7,) rad.
        velocity: (7,) rad/s.
        arm: the robot.
        gravity: whether to include uncompensated gravity in ``bias``.
    """
    model, data = in_dtype(_mjx_parts(arm, gravity), joints.dtype)
    data = smooth_terms(model, data.replace(qpos=joints, qvel=velocity))
    return motion_of(model, data, mujoco_model(arm, gravity).site("tcp").id)


def smooth_terms(model: Any, data: Any) -> Any:
    """Kinematics, mass matrix and bias of MJX data, from its ``qpos`` and ``qvel``."""
    with fence_levels(), allow_mixing():
        for stage in (mjx.kinematics, mjx.com_pos, mjx.crb, mjx.com_vel, mjx.rne):
            data = stage(model, data)
    return data


def full_step(model: Any, data: Any) -> Any:
    """A full step of MJX, including its constraint solver."""
    with fence_levels(), allow_mixing():
        return mjx.step(model, data)


def motion_of(model: Any, data: Any, tcp: int) -> Motion:
    """Extract the motion of the arm from MJX data after :func:`smooth_terms`; its joints are the first seven.

    Args:
        model: MJX model.
        data: MJX data.
        tcp: index of the TCP site.
    """
    with allow_mixing():
        mass = mjx.full_m(model, data)[:7, :7]
        axes, anchors, position = data.xaxis[:7], data.xanchor[:7], data.site_xpos[tcp]
        linear = jnp.cross(axes, position - anchors)
    motion = Motion(
        joints=data.qpos[:7],
        velocity=data.qvel[:7],
        rotation=data.site_xmat[tcp],
        position=position,
        jacobian=jnp.concatenate([axes.T, linear.T]),
        mass=mass,
        bias=data.qfrc_bias[:7],
    )
    # constants inside MJX have the default precision, not the precision of the input
    return jax.tree.map(lambda leaf: leaf.astype(data.qvel.dtype), motion)


def jacobian(joints: jax.Array, arm: Arm = PANDA) -> jax.Array:
    """Jacobian of the TCP.

    Args:
        joints: (7,) rad.
        arm: the robot.

    Returns:
        (6, 7) from joint velocities to the angular velocity and the velocity of the origin of {b}, in the
        axes of the base.
    """
    return arm_motion(joints, jnp.zeros_like(joints), arm).jacobian


def inverse_dynamics(
    joints: jax.Array, velocity: jax.Array, acceleration: jax.Array, arm: Arm = PANDA
) -> jax.Array:
    """Compute the joint torques of a motion of the free arm without friction: M(q) a + c(q, v) + g(q).

    Args:
        joints: (7,) rad.
        velocity: (7,) rad/s.
        acceleration: (7,) rad/s^2.
        arm: the robot.

    Returns:
        (7,) N m.
    """
    motion = arm_motion(joints, velocity, arm, gravity=True)
    return apply(motion.mass, acceleration) + motion.bias


def solve_positive(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Solve A X = B for a small symmetric positive definite A with an unrolled Cholesky factorization.

    For a batch of small matrices, library calls cost more than the arithmetic. The unrolled form is
    vectorized over the batch.

    Args:
        matrix: (n, n), with n up to about 7.
        right: (n, m).

    Returns:
        (n, m).
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

"""The arm's equations of motion, from the smooth dynamics of MJX.

MJX computes the kinematics, the mass matrix, and the Coriolis and centrifugal torques, as in a step of
:func:`mujoco.mjx.step` before its solver. This package adds the forces of constraints, hands and controllers,
and solves the constraint of a demonstration exactly (see ``rollout``). Gravity and the gravity compensation
of the robot cancel, so neither is computed.
"""

import contextlib
import io
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

with contextlib.redirect_stdout(io.StringIO()):  # MJX prints the names of missing optional packages
    from mujoco import mjx

    try:
        from mujoco.mjx._src import scan as mjx_scan  # private, see fence_levels
    except ImportError:
        mjx_scan = None

from reframe_jax.constraints.frame import multiply
from reframe_jax.simulation.arm.model import PANDA, Arm


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


@contextlib.contextmanager
def fence_levels() -> Iterator[None]:
    """Prevent XLA from recomputing the kinematic chain at every link while ``mjx.kinematics`` is traced.

    On the CPU, XLA's fusion emitters (jax 0.7 to 0.10) inline each level of MJX's scan over the tree into the
    next level: a step of 64 arms takes 1.4 s instead of 0.6 ms (google-deepmind/mujoco#2957). A barrier
    around the value that each link passes to the next prevents the inlining, and costs nothing on other
    devices. MJX has no public hook for it, and a barrier around the public function does not help. An MJX
    without this private scan runs unfenced: the results are the same.
    """
    body_tree = getattr(mjx_scan, "body_tree", None)
    if body_tree is None:
        yield
        return

    def with_barriers(model: Any, function: Any, *args: Any, **options: Any) -> Any:
        def run_barred(carry: Any, *rest: Any) -> Any:
            return function(carry if carry is None else jax.lax.optimization_barrier(carry), *rest)

        return body_tree(model, run_barred, *args, **options)

    mjx_scan.body_tree = with_barriers
    try:
        yield
    finally:
        mjx_scan.body_tree = body_tree


@cache
def _mjx_parts(arm: Arm) -> tuple[Any, Any, int]:
    """MJX model and data in double precision, as NumPy arrays for any trace, and the index of the TCP."""
    model = arm.model
    with jax.ensure_compile_time_eval(), jax.enable_x64(True), _allow_mixing():
        parts = mjx.put_model(model, impl="jax"), mjx.make_data(model, impl="jax")
        return *jax.tree.map(np.asarray, parts), model.site("tcp").id


@contextlib.contextmanager
def _allow_mixing() -> Iterator[None]:
    """Let MJX mix dtypes and ranks, with precise matrix products, independent of the user's settings."""
    with (
        jax.numpy_dtype_promotion("standard"),
        jax.numpy_rank_promotion("allow"),
        jax.default_matmul_precision("highest"),
    ):
        yield


def arm_motion(joints: jax.Array, velocity: jax.Array, arm: Arm = PANDA) -> Motion:
    """Compute the kinematics and the dynamics of the arm in one state.

    Args:
        joints: (7,) rad.
        velocity: (7,) rad/s.
        arm: the robot.
    """
    dtype = joints.dtype

    def cast(leaf: Any) -> jax.Array:
        return jnp.asarray(leaf, dtype=dtype if np.issubdtype(leaf.dtype, np.floating) else None)

    *parts, tcp = _mjx_parts(arm)
    model, data = jax.tree.map(cast, parts)
    data = data.replace(qpos=joints, qvel=velocity)
    with _allow_mixing():
        with fence_levels():
            data = mjx.kinematics(model, data)
        for stage in (mjx.com_pos, mjx.crb, mjx.com_vel, mjx.rne):
            data = stage(model, data)
        mass = mjx.full_m(model, data)
        linear = jnp.cross(data.xaxis, data.site_xpos[tcp] - data.xanchor)
    motion = Motion(
        joints=joints,
        velocity=velocity,
        rotation=data.site_xmat[tcp],
        position=data.site_xpos[tcp],
        jacobian=jnp.concatenate([data.xaxis.T, linear.T]),
        mass=mass,
        bias=data.qfrc_bias,
    )
    # constants inside MJX have the default precision, not the precision of the input
    return jax.tree.map(lambda leaf: leaf.astype(dtype), motion)

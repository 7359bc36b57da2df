"""Models of the Franka Panda and FR3 arms, which MJCF files describe, their kinematics and dynamics.

Frames: {g} is the robot's base, x forward, z up; {b} is the tool centre point (TCP) between the
fingertips, z out of the hand. Metres, kilograms, radians.

MJX computes the kinematics, the mass matrix, and the Coriolis and centrifugal torques, as in a step of
:func:`mujoco.mjx.step` before its solver. This package adds the forces of constraints, hands and controllers,
and solves the constraint of a demonstration exactly (see ``rollout``). Gravity and the gravity compensation
of the robot cancel, so neither is computed.
"""

import contextlib
import io
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.typing import DTypeLike
from numpy.typing import ArrayLike

with contextlib.redirect_stdout(io.StringIO()):  # MJX prints the names of missing optional packages
    from mujoco import mjx

    try:
        from mujoco.mjx._src import scan as mjx_scan  # private, see fence_levels
    except ImportError:
        mjx_scan = None

from reframe_jax.geometry.numpy_rotations import quaternions_to_matrices
from reframe_jax.geometry.small import times


@dataclass(frozen=True)
class Arm:
    """A robot arm of seven revolute joints with a tool fixed to its last link.

    An arm is hashable, so it can be a static argument. Change a field with ``dataclasses.replace``.

    Attributes:
        name: name of the robot.
        xml: MJCF document. The bodies are link1 to link7 and hand; the joints are joint1 to joint7, about the
            z axes of the links; the sites are flange and tcp.
        home: (7,) rad, a configuration far from joint limits: the tool points down, and the TCP can move by
            0.15 m and turn by 0.5 rad with a margin of 0.29 rad to every joint limit.
        speed: (7,) rad/s, highest joint velocities.
    """

    name: str
    xml: str
    home: tuple[float, ...] = (0.0, -0.55, 0.0, -2.15, 0.0, 1.6, 0.785)
    speed: tuple[float, ...] = (2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61)

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The MuJoCo model that ``xml`` describes, without gravity; it is shared, so do not change it."""
        model = mujoco.MjModel.from_xml_string(self.xml)
        model.opt.gravity[:] = 0
        return model

    @property
    def limits(self) -> np.ndarray:
        """(2, 7) rad, lower and upper joint limits."""
        return self.model.jnt_range.T

    @property
    def damping(self) -> np.ndarray:
        """(7,) N m s/rad, viscous friction of the joints in guiding mode."""
        return self.model.dof_damping

    def start(self, joints: "ArrayLike | None", dtype: DTypeLike) -> jax.Array:
        """Convert joint positions (..., 7), rad, to an array; None gives the home configuration."""
        return jnp.asarray(self.home if joints is None else joints, dtype=dtype)


def _load_arm(name: str) -> Arm:
    return Arm(name, (Path(__file__).parent / f"{name}.xml").read_text(encoding="utf-8"))


PANDA = _load_arm("panda")
"""The Franka Panda, with the low armature and damping of guiding mode."""

FR3 = _load_arm("fr3")
"""The Franka Research 3, the robot of the paper."""

ROBOTS: dict[str, Arm] = {arm.name: arm for arm in (PANDA, FR3)}


def find_arm(arm: str | Arm) -> Arm:
    """Return the arm with a given name, or an :class:`Arm` unchanged; raise a ValueError for other names."""
    if isinstance(arm, Arm):
        return arm
    if arm not in ROBOTS:
        raise ValueError(f"Unknown robot {arm!r}; choose from {', '.join(ROBOTS)}.")
    return ROBOTS[arm]


@cache
def _link_transforms(arm: Arm) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (8, 3, 3) and positions (8, 3), m, of the links and of {b} in their parents."""
    rotations = quaternions_to_matrices(np.roll(arm.model.body_quat[1:], -1, axis=1))
    positions = arm.model.body_pos[1:].copy()
    positions[-1] += rotations[-1] @ arm.model.site("tcp").pos
    return rotations, positions


@partial(jax.jit, static_argnames="arm", inline=True)
def forward_kinematics(joints: jax.Array, arm: Arm = PANDA) -> tuple[jax.Array, jax.Array]:
    """Compute rotation (..., 3, 3) and position (..., 3), m, of {b} in {g} from joints (..., 7), rad."""
    fixed, offset = (jnp.asarray(part, dtype=joints.dtype) for part in _link_transforms(arm))
    fixed, offset = (jnp.broadcast_to(part, (*joints.shape[:-1], *part.shape)) for part in (fixed, offset))
    rotation, position = fixed[..., 0, :, :], offset[..., 0, :]
    for i in range(7):
        # a rotation about z combines the first two columns
        c, s = jnp.cos(joints[..., i, None]), jnp.sin(joints[..., i, None])
        x, y, z = rotation[..., :, 0], rotation[..., :, 1], rotation[..., :, 2]
        rotation = jnp.stack([c * x + s * y, c * y - s * x, z], axis=-1)
        # elementwise, because a library call per matrix of a batch costs more than the product
        position = position + jnp.sum(rotation * offset[..., i + 1, None, :], axis=-1)
        rotation = jnp.sum(rotation[..., :, :, None] * fixed[..., i + 1, None, :, :], axis=-2)
    return rotation, position


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Motion:
    """The state of the arm at an instant, in the axes of its base.

    Attributes:
        velocity: (7,) rad/s, of the joints.
        rotation, position: (3, 3) and (3,) m, orientation and origin of {b} in {g}.
        jacobian: (6, 7) from joint velocities to the twist of {b}: its angular velocity (rad/s), then the
            velocity of its origin (m/s), both in the axes of {g}.
        mass: (7, 7) kg m^2, the mass matrix, including the armature.
        bias: (7,) N m, Coriolis and centrifugal torques.
    """

    velocity: jax.Array
    rotation: jax.Array
    position: jax.Array
    jacobian: jax.Array
    mass: jax.Array
    bias: jax.Array

    @property
    def twist(self) -> jax.Array:
        """(6,) rad/s and m/s: angular velocity of {b}, velocity of its origin, in the axes of {g}."""
        return times(self.jacobian, self.velocity)


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
    """Compute kinematics and dynamics of the arm at joint positions (7,), rad, and velocities (7,), rad/s."""
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
        velocity=velocity,
        rotation=data.site_xmat[tcp],
        position=data.site_xpos[tcp],
        jacobian=jnp.concatenate([data.xaxis.T, linear.T]),
        mass=mass,
        bias=data.qfrc_bias,
    )
    # constants inside MJX have the default precision, not the precision of the input
    return jax.tree.map(lambda leaf: leaf.astype(dtype), motion)

"""Models of the Franka Panda and FR3 arms, which MJCF files describe, and their forward kinematics.

Frames: {g} is the robot's base, x forward, z up; {b} is the tool centre point (TCP) between the
fingertips, z out of the hand. Metres, kilograms, radians.
"""

from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.typing import DTypeLike
from numpy.typing import ArrayLike

from reframe_jax.geometry.numpy_rotations import quaternions_to_matrices


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

    def start(self, joints: ArrayLike | None, dtype: DTypeLike) -> jax.Array:
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


def forward_kinematics(joints: jax.Array, arm: Arm = PANDA) -> tuple[jax.Array, jax.Array]:
    """Compute rotation (..., 3, 3) and position (..., 3), m, of {b} in {g} from joints (..., 7), rad."""
    fixed, offset = (jnp.asarray(part, dtype=joints.dtype) for part in _link_transforms(arm))
    batch = joints.shape[:-1]
    fixed, offset = (jnp.broadcast_to(part, (*batch, *part.shape)) for part in (fixed, offset))
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

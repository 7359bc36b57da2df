"""Models of the Franka Panda and FR3 arms: parameters, MJCF and forward kinematics.

Both robots have the same link frames. The inertial parameters of the Panda are from Gaz et al. (2019),
"Dynamic Identification of the Franka Emika Panda Robot With Retrieval of Feasible Parameters Using
Penalty-Based Optimization"; the parameters of the FR3 are from the manufacturer. The shapes are primitives
without collisions, because only hands and mechanisms move the arm.

Frames: {g} is the robot's base, x forward, z up; {b} is the tool centre point (TCP) between the
fingertips, z out of the hand. Metres, kilograms, radians.
"""

from dataclasses import dataclass
from functools import cache

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

    @property
    def model(self) -> mujoco.MjModel:
        """The MuJoCo model that ``xml`` describes, without gravity; it is shared, so do not change it."""
        return _compile_model(self)

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


@cache
def _compile_model(arm: Arm) -> mujoco.MjModel:
    model = mujoco.MjModel.from_xml_string(arm.xml)
    model.opt.gravity[:] = 0
    return model


# rows: origin of a link in the previous one, quaternion (w, x, y, z), ends and radius of the drawn capsule
_FRAMES = """
0       0      0.333  1  0 0 0  0 0 -0.19  0       0    0     0.06
0       0      0      1 -1 0 0  0 0  0     0      -0.2  0     0.06
0      -0.316  0      1  1 0 0  0 0 -0.1   0.0825  0    0     0.055
0.0825  0      0      1  1 0 0  0 0  0    -0.0825  0.1  0     0.055
-0.0825 0.384  0      1 -1 0 0  0 0 -0.26  0       0.05 0     0.05
0       0      0      1  1 0 0  0 0  0     0.088   0    0     0.045
0.088   0      0      1  1 0 0  0 0  0.03  0       0    0.107 0.04
"""
# rows: mass, centre of mass, joint limits; and Ixx Iyy Izz Ixy Ixz Iyz about the centre of mass
_PANDA_BODIES = """
4.970684 0.003875 0.002081 -0.04762 -2.8973 2.8973
0.646926 -0.003141 -0.02872 0.003495 -1.7628 1.7628
3.228604 0.027518 0.039252 -0.066502 -2.8973 2.8973
3.587895 -0.05317 0.104419 0.027454 -3.0718 -0.0698
1.225946 -0.011953 0.041065 -0.038437 -2.8973 2.8973
1.666555 0.060149 -0.014117 -0.010517 -0.0175 3.7525
0.735522 0.010517 -0.004252 0.061597 -2.8973 2.8973
"""
_PANDA_INERTIAS = """
0.70337 0.70661 0.009117 -0.000139 0.006772 0.019169
0.007962 0.02811 0.025995 -0.003925 0.010254 0.000704
0.037242 0.036155 0.01083 -0.004761 -0.011396 -0.012805
0.025853 0.019552 0.028323 0.007796 -0.001332 0.008641
0.035549 0.029474 0.008627 -0.002117 -0.004037 0.000229
0.001964 0.004354 0.005433 0.000109 -0.001158 0.000341
0.012516 0.010027 0.004815 -0.000428 -0.001196 -0.000741
"""

# rows: mass, centre of mass, joint limits; and principal moments, their axes as a quaternion (w, x, y, z)
_FR3_BODIES = """
2.92747 4.128e-7 -0.0181251 -0.0386036 -2.9007 2.9007
2.93554 0.00318289 -0.0743222 0.00881461 -1.8361 1.8361
2.2449 0.0407016 -0.00482006 -0.0289731 -2.9007 2.9007
2.6156 -0.0459101 0.0630493 -0.00851879 -3.077 -0.1169
2.32712 -0.00160396 0.0292536 -0.0972966 -2.8763 2.8763
1.81704 0.0597131 -0.0410295 -0.0101693 0.4398 4.6216
0.627143 0.00452258 0.00862619 -0.0161633 -3.0508 3.0508
"""
_FR3_INERTIAS = """
0.0239286 0.0227246 0.00610634 0.998098 -0.0605364 0.00380499 0.0110109
0.0629567 0.0411924 0.0246371 0.502599 0.584437 -0.465998 0.434366
0.0267409 0.0189869 0.0171587 0.921025 -0.244161 0.155272 0.260745
0.05139 0.0372717 0.0160047 0.438018 0.803311 0.00937812 0.403414
0.0579335 0.0449144 0.0130634 0.919031 0.125604 0.0751531 -0.366003
0.0175039 0.0161123 0.00193529 0.621301 0.552665 0.510011 0.220081
0.000223836 0.000223642 5.64132e-7 0.727579 0.0978688 -0.24906 0.63168
"""


_GHOST = 'contype="0" conaffinity="0" mass="0"'


def _make_xml(name: str, bodies: str, inertias: str, armature: list[float], damping: float) -> str:
    """Write the MJCF document of an arm from tables with one row per link."""
    opening = ""
    tables = (table.strip().splitlines() for table in (_FRAMES, bodies, inertias))
    for number, (*rows, rotor) in enumerate(zip(*tables, armature, strict=True), start=1):
        frame, body, inertia = (row.split() for row in rows)
        texts = (frame[:3], frame[3:7], frame[7:13], body[1:4], body[4:])
        origin, turn, ends, centre, limits = map(" ".join, texts)
        moments = f'fullinertia="{" ".join(inertia)}"'
        if len(inertia) == 7:  # principal moments and their axes
            moments = f'diaginertia="{" ".join(inertia[:3])}" quat="{" ".join(inertia[3:])}"'
        opening += (
            f'<body name="link{number}" pos="{origin}" quat="{turn}">'
            f'<inertial mass="{body[0]}" pos="{centre}" {moments}/>'
            f'<joint name="joint{number}" axis="0 0 1" range="{limits}" damping="{damping}" '
            f'armature="{rotor}"/>'
            f'<geom type="capsule" fromto="{ends}" size="{frame[13]}" rgba=".9 .9 .9 1" {_GHOST}/>'
        )
    return (
        f'<mujoco model="{name}"><compiler angle="radian" autolimits="true"/>'
        f'<option timestep="0.01" integrator="Euler"><flag contact="disable" limit="disable"/></option>'
        f'<worldbody><light pos="1 -1 2" dir="-1 1 -2"/>'
        f'<geom type="cylinder" size=".07 .07" pos="0 0 .07" rgba=".9 .9 .9 1" {_GHOST}/>{opening}'
        f'<body name="hand" pos="0 0 0.107" euler="0 0 {-np.pi / 4}">'
        f'<inertial mass="0.73" pos="-0.01 0 0.03" diaginertia="0.001 0.0025 0.0017"/>'
        f'<geom type="box" size=".02 .1 .03" pos="0 0 .03" rgba=".3 .3 .3 1" {_GHOST}/>'
        f'<site name="flange"/><site name="tcp" pos="0 0 0.1034"/></body>'
        f"{'</body>' * 7}</worldbody></mujoco>"
    )


PANDA = Arm("panda", _make_xml("panda", _PANDA_BODIES, _PANDA_INERTIAS, [0.1] * 7, 0.5))
"""The Franka Panda, with the low armature and damping of guiding mode."""

FR3 = Arm("fr3", _make_xml("fr3", _FR3_BODIES, _FR3_INERTIAS, [0.195] * 4 + [0.074] * 3, 0.21))
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


def link_poses(joints: jax.Array, arm: Arm) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Compute the origins (..., 7, 3), m, of the links, and the result of :func:`forward_kinematics`."""
    fixed, offset = (jnp.asarray(part, dtype=joints.dtype) for part in _link_transforms(arm))
    batch = joints.shape[:-1]
    fixed, offset = (jnp.broadcast_to(part, (*batch, *part.shape)) for part in (fixed, offset))
    rotation, position = fixed[..., 0, :, :], offset[..., 0, :]
    origins = []
    for i in range(7):
        # a rotation about z combines the first two columns
        c, s = jnp.cos(joints[..., i, None]), jnp.sin(joints[..., i, None])
        x, y, z = rotation[..., :, 0], rotation[..., :, 1], rotation[..., :, 2]
        rotation = jnp.stack([c * x + s * y, c * y - s * x, z], axis=-1)
        origins.append(position)
        # elementwise, because a library call per matrix of a batch costs more than the product
        position = position + jnp.sum(rotation * offset[..., i + 1, None, :], axis=-1)
        rotation = jnp.sum(rotation[..., :, :, None] * fixed[..., i + 1, None, :, :], axis=-2)
    return jnp.stack(origins, axis=-2), rotation, position


def forward_kinematics(joints: jax.Array, arm: Arm = PANDA) -> tuple[jax.Array, jax.Array]:
    """Compute rotation (..., 3, 3) and position (..., 3), m, of {b} in {g} from joints (..., 7), rad."""
    return link_poses(joints, arm)[1:]

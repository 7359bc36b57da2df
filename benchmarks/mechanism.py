"""Constraints as mechanisms in C MuJoCo: a second body with joints, welded to the tool.

A reference for the exact constraints of the simulated arm, with MuJoCo's soft solver. It exists for
constraints that are chains of slides and hinges: A to D and I to L of the catalogue.
"""

from functools import cache

import jax
import mujoco
import numpy as np

from reframe_jax.constraints.frame import ConstraintFrame, frame_arrays, locate
from reframe_jax.constraints.types import Dof, LinearType
from reframe_jax.geometry.numpy_rotations import matrices_to_quaternions
from reframe_jax.simulation.arm.model import Arm, forward_kinematics

__all__ = ["Joints", "mechanism_joints", "mechanism_model", "weld"]

Joints = tuple[tuple[str, int], ...]
"""Joints of a mechanism in order from the ground: "slide", "hinge" or "ball", and the axis, 0-2."""

_MASS = 0.2  # kg, mass of the moving part of the mechanism
_INERTIA = 1e-3  # kg m^2
_WELD = 'solref="0.004 1" solimp="0.999 0.9999 0.001"'  # stiff: 15 um and 0.3 mrad at steps of 5 ms


def mechanism_joints(frame: ConstraintFrame) -> Joints:
    """Return the chain of joints that reproduces a constraint, along the axes of its frame.

    Raises:
        ValueError: for a constraint that no chain of slides and hinges reproduces.
    """
    turns = [i for i, free in enumerate(frame.angular_dof) if free]
    slides: Joints = tuple(("slide", i) for i, free in enumerate(frame.linear_dof) if free)
    hinges: Joints = (("ball", 0),) if len(turns) == 3 else tuple(("hinge", i) for i in turns)
    if len(turns) != 2:
        if frame.linear_type == LinearType.GB or _slides_ignore_rotation(frame.angular_dof, frame.linear_dof):
            return slides + hinges
        if frame.linear_type == LinearType.BG:
            return hinges + slides
    raise ValueError(
        f"No mechanism makes {frame.linear_type} with rotations {frame.angular_dof} and translations "
        f"{frame.linear_dof}: it cannot be integrated to a constraint on poses."
    )


def _slides_ignore_rotation(angular: Dof, linear: Dof) -> bool:
    """Whether rotations do not change the slides, so that all four linear types are equivalent."""
    along = [i for i in range(3) if linear[i]]
    about = [i for i in range(3) if angular[i]]
    if not along or not about or len(along) == 3:
        return True
    plane = len(along) == 2 and about == [i for i in range(3) if not linear[i]]
    return len(about) == 1 and (along == about or plane)


@cache
def mechanism_model(arm: Arm, joints: Joints, timestep: float) -> mujoco.MjModel:
    """Model of the arm without gravity, welded to a mechanism; :func:`weld` places the mechanism."""
    parts = ""
    for number, (kind, axis) in enumerate(joints):
        direction = "" if kind == "ball" else f'axis="{" ".join(str(float(i == axis)) for i in range(3))}"'
        parts += f'<joint name="mechanism{number}" type="{kind}" {direction}/>'
    # weld() overwrites these positions; C MuJoCo replaces zero positions by the body's frame
    body = (
        f'<body name="mechanism"><inertial pos=".1 .1 .1" mass="{_MASS}" '
        f'diaginertia="{_INERTIA} {_INERTIA} {_INERTIA}"/>{parts}'
        '<site name="grip" pos=".1 .1 .1" quat="1 .1 .1 .1"/></body></worldbody>'
        f'<equality><weld site1="tcp" site2="grip" {_WELD}/></equality>'
    )
    options = 'gravity="0 0 0" jacobian="dense" solver="Newton" iterations="1" ls_iterations="4" '
    text = arm.xml.replace("</worldbody>", body).replace('timestep="0.01" ', options)
    model = mujoco.MjModel.from_xml_string(text.replace("<flag ", '<flag eulerdamp="disable" '))
    model.opt.timestep = timestep
    return model


def weld(model: mujoco.MjModel, frame: ConstraintFrame, joints: jax.Array, arm: Arm) -> mujoco.MjData:
    """Place the mechanism and its grip so that they fit the tool at joint positions (7,), rad, at rest."""
    rotation, position = forward_kinematics(joints, arm)
    located = locate(frame_arrays(frame), rotation, position)
    axes, lever = np.asarray(located.angular_axes), np.asarray(located.lever)
    body, grip = model.body("mechanism").id, model.site("grip").id
    model.body_pos[body], model.body_quat[body] = position + lever, _quaternion(axes)
    model.site_pos[grip] = model.body_ipos[body] = -axes.T @ lever
    model.site_quat[grip] = _quaternion(axes.T @ rotation)
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    mujoco.mj_resetData(model, data)
    data.qpos[:7] = joints
    mujoco.mj_forward(model, data)
    return data


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """Quaternion in MuJoCo's order (w, x, y, z)."""
    return np.roll(matrices_to_quaternions(np.asarray(rotation)), 1)

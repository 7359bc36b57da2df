"""Constraints as mechanisms: a second body with joints, welded to the tool.

This form of a constraint is independent of the exact form and serves to verify the exact form. It uses
MuJoCo's soft constraint solver, as a simulator does for a robot that is bolted to a hinge or a slide. It
exists for constraints that are chains of slides and hinges: A to D and I to L of the catalogue. It is slower
than the exact form, and its model also runs in C MuJoCo.
"""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.located import Frame, ground_twist, locate, slip
from reframe_jax.constraints.types import Dof, LinearType
from reframe_jax.geometry import rotations
from reframe_jax.geometry.products import apply, matmul
from reframe_jax.simulation.arm.dynamics import (
    full_step,
    in_dtype,
    mjx_parts,
    motion_of,
    smooth_terms,
    solve_positive,
)
from reframe_jax.simulation.arm.model import Arm, arm_xml, forward_kinematics
from reframe_jax.simulation.arm.rollout import Drive, Steps, Track, run_samples

__all__ = ["Joints", "integrate_welded", "mechanism_joints", "mechanism_model"]

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
    """Model of the arm welded to a mechanism, for MJX and C MuJoCo; see :func:`placement` for its pose."""
    parts = ""
    for number, (kind, axis) in enumerate(joints):
        direction = "" if kind == "ball" else f'axis="{" ".join(str(float(i == axis)) for i in range(3))}"'
        parts += f'<joint name="mechanism{number}" type="{kind}" {direction}/>'
    # placement overwrites these positions; C MuJoCo replaces zero positions by the body's frame
    body = (
        f'<body name="mechanism"><inertial pos=".1 .1 .1" mass="{_MASS}" '
        f'diaginertia="{_INERTIA} {_INERTIA} {_INERTIA}"/>{parts}'
        '<site name="grip" pos=".1 .1 .1" quat="1 .1 .1 .1"/></body>'
    )
    text = arm_xml(
        arm,
        timestep=timestep,
        gravity=False,
        bodies=body,
        equality=f'<weld site1="tcp" site2="grip" {_WELD}/>',
        options='solver="Newton" iterations="1" ls_iterations="4"',
        flags='eulerdamp="disable"',
    )
    return mujoco.MjModel.from_xml_string(text)


def _quaternion(rotation: jax.Array) -> jax.Array:
    """Quaternion in MuJoCo's order (w, x, y, z)."""
    return jnp.roll(rotations.rotation_to_quaternion(rotation), 1)


def placement(frame: Frame, rotation: jax.Array, position: jax.Array) -> dict[str, jax.Array]:
    """Compute the pose of the mechanism and its grip on the tool from the tool's initial pose.

    Args:
        frame: the constraint of one rollout.
        rotation: (3, 3), orientation of {b} in {g}.
        position: (3,) m.

    Returns:
        ``body_pos`` (3,) and ``body_quat`` (4,) of the mechanism; ``site_pos`` and ``site_quat`` of the grip
        in the mechanism. The axes of the mechanism are the axes of the angular frame.
    """
    located = locate(frame, rotation, position)
    axes = located.angular_axes
    return {
        "body_pos": position + located.lever,
        "body_quat": _quaternion(axes),
        "site_pos": -apply(axes.T, located.lever),
        "site_quat": _quaternion(matmul(axes.T, rotation)),
    }


def integrate_welded(
    arm: Arm,
    joints: Joints,
    frame: Frame,
    start: jax.Array,
    drive: Drive,
    state: Any,
    steps: Steps,
) -> Track:
    """Integrate the motion of the arm welded to a mechanism.

    The result has the format of :func:`reframe_jax.simulation.arm.rollout.integrate`.

    Args:
        arm: the robot.
        joints: joints of the mechanism.
        frame: the constraint of one rollout, with aligned angular and linear axes at the start.
        start: (7,) rad, initial joint positions.
        drive: the drive that moves the arm.
        state: initial state of the drive.
        steps: samples, and steps between samples; steps up to 0.005 s keep the weld stiff.
    """
    dtype, step = start.dtype, steps.length
    host = mechanism_model(arm, joints, step)
    model, data = in_dtype(mjx_parts(host), dtype)
    pose = forward_kinematics(start, arm)
    place = placement(frame, *pose)
    body, grip, tcp = host.body("mechanism").id, host.site("grip").id, host.site("tcp").id
    model = model.replace(
        body_pos=model.body_pos.at[body].set(place["body_pos"]),
        body_quat=model.body_quat.at[body].set(place["body_quat"]),
        body_ipos=model.body_ipos.at[body].set(place["site_pos"]),
        site_pos=model.site_pos.at[grip].set(place["site_pos"]),
        site_quat=model.site_quat.at[grip].set(place["site_quat"]),
    )
    data = data.replace(qpos=data.qpos.at[:7].set(start))

    def advance(carry: Any, count: jax.Array) -> tuple[Any, None]:
        data, slipped, before, state, _ = carry
        motion = motion_of(model, smooth_terms(model, data), tcp)
        now = locate(frame, motion.rotation, motion.position)
        slipped = slipped + slip(before, now)
        state, torque = drive(state, (count.astype(dtype) + 0.5) * step, motion, now)
        data = full_step(model, data.replace(qfrc_applied=data.qfrc_applied.at[:7].set(torque)))
        # the wrench W that gives the joint torques of the solver: J J^T W = J J^T_weld f
        jacobian, found = motion.jacobian, data.qfrc_constraint[:7]
        wrench = solve_positive(matmul(jacobian, jacobian.T), apply(jacobian, found)[:, None])[:, 0]
        back = jax.vmap(lambda axis: ground_twist(now, axis))(jnp.eye(6, dtype=dtype))
        return (data, slipped, now, state, apply(back, wrench)), None

    def observe(carry: Any) -> Track:
        data, slipped, _, _, force = carry
        return Track(data.qpos[:7], data.qvel[:7], slipped, force)

    zero = jnp.zeros(6, dtype=dtype)
    return run_samples(advance, (data, zero, locate(frame, *pose), state, zero), observe, steps)

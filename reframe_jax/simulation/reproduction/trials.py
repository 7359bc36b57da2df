"""Reproduce tasks from end-stop to end-stop."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.compilation import index_leaves
from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.located import Frame, assemble_frame, frame_arrays, locate
from reframe_jax.geometry import transforms
from reframe_jax.geometry.products import apply
from reframe_jax.identification.results import Identification
from reframe_jax.simulation.arm.demonstration import sampling
from reframe_jax.simulation.arm.dynamics import arm_motion
from reframe_jax.simulation.arm.imperfections import as_numbers
from reframe_jax.simulation.arm.model import PANDA, Arm, find_arm, forward_kinematics
from reframe_jax.simulation.arm.rollout import (
    AxisLaw,
    RolloutStatus,
    Steps,
    hold,
    integrate,
    rollout_status,
)
from reframe_jax.simulation.reproduction.controllers import (
    Controller,
    by_axis,
    constant_wrench,
    control_drive,
)

ROOMY = (0.0, -0.7, 0.0, -2.35, 0.0, 1.65, 0.785)
"""rad, initial joint positions of tasks: closer to the base than home, so that no task stretches the arm."""


_ARRIVED = 2e-3  # rad or m, largest distance from the end-stop of an axis that has arrived
_SINGULAR = 0.01  # smallest singular value of the Jacobian, in rad and m, below which the arm is singular
_REBOUND = 1e-4  # rad or m, distance behind the start at which the first end-stop acts


@dataclass(frozen=True)
class Task:
    """A task: move every free axis from its first end-stop to its second end-stop.

    Attributes:
        start: (7,) rad, joint positions of the arm at the first end-stops.
        travel: rad and m, distance between the end-stops.
        friction: N m s/rad and N s/m, friction of the mechanism along its free axes.
        stop_compliance: rad/(N m) and m/N, compliance of the second end-stop, a damped spring.
        duration: s.
        dt: s, time between samples.
        step: s, time step of the simulation.
    """

    start: tuple[float, ...] = ROOMY
    travel: tuple[float, float] = (0.4, 0.1)
    friction: tuple[float, float] = (5.0, 40.0)
    stop_compliance: tuple[float, float] = (5e-3, 5e-4)
    duration: float = 5.0
    dt: float = 0.05
    step: float = 0.01


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Trials:
    """A batch of reproductions.

    Attributes:
        times: (K+1,) s.
        poses: (N, K+1, 4, 4) m, poses of {b} in {g}.
        joint_positions: (N, K+1, 7) rad.
        travelled: (N, K+1, 6) rad and m, displacement along the axes of the true frame since the start.
        reaction: (N, K+1, 6) N m and N, reaction of the constraint on the tool along the constrained axes.
        completed: (N,) bool, whether every free axis reached its end-stop.
        completion_time: (N,) s, time at which the last axis reached its end-stop; infinite if an axis did
            not.
        peak_moment: (N,) N m, largest norm of the reaction moment in a trial (paper, section 6.2).
        peak_force: (N,) N, largest norm of the reaction force in a trial.
        status_code: (N,) int, a ``RolloutStatus``; SINGULAR if the end-stop was out of reach.
    """

    times: jax.Array
    poses: jax.Array
    joint_positions: jax.Array
    travelled: jax.Array
    reaction: jax.Array
    completed: jax.Array
    completion_time: jax.Array
    peak_moment: jax.Array
    peak_force: jax.Array
    status_code: jax.Array

    def __getitem__(self, index: int | slice | np.ndarray | jax.Array) -> "Trials":
        """Select trials; a single index removes the batch axis."""
        parts = {name: value for name, value in vars(self).items() if name != "times"}
        return Trials(self.times, **index_leaves(parts, index))


def control_frames(found: Identification | ConstraintFrame | Frame) -> Frame:
    """Return control frames with the batch axes of ``found``; types may vary in a batch of results."""
    if isinstance(found, Frame):
        return found
    if isinstance(found, ConstraintFrame):
        return frame_arrays(found)
    return assemble_frame(
        found.angular.type_code,
        found.linear.type_code,
        angular_axes=found.angular.axes,
        linear_axes=found.linear.axes,
        position=found.linear.position,
        angular_dof=found.angular.dof,
        linear_dof=found.linear.dof,
    )


def reproduce(
    truth: ConstraintFrame,
    frames: Identification | ConstraintFrame | Frame,
    *,
    controller: Controller = constant_wrench(),  # noqa: B008
    task: Task = Task(),
    arm: str | Arm = PANDA,
    compliance: tuple[float, float] = (0.0, 0.0),
) -> Trials:
    """Move the arm from end-stop to end-stop with a controller in given frames, with gravity compensation.

    The torques are tau = J^T W. The wrench W contains the controller's moments and forces along the axes of
    the control frame, with forces at its origin. The type of the control frame determines its motion with the
    robot. The goal is a direction in the ground at the start, the sum of the true free axes; the control
    frame determines the free part of this direction and its later motion.

    Args:
        truth: the true constraint, with geometry (N, 3).
        frames: N control frames.
        controller: the controller, which computes the wrenches.
        task: the end-stops and the duration.
        arm: the robot.
        compliance: rad/(N m) and m/N, compliance of the tool and its mount.

    Raises:
        ValueError: for an unknown robot, or batches of different sizes.
    """
    arm = find_arm(arm)
    control = control_frames(frames)
    if truth.position.ndim != 2 or control.position.shape != truth.position.shape:
        raise ValueError(
            f"Expected one control frame per constraint, with geometry (N, 3); found "
            f"{control.position.shape} and {truth.position.shape}."
        )
    steps = sampling(task.duration, task.dt, task.step)
    dtype = truth.position.dtype
    pairs = as_numbers((task.travel, task.friction, task.stop_compliance, compliance), dtype)
    return _reproduce(
        frame_arrays(truth),
        jax.tree.map(lambda leaf: leaf.astype(dtype) if leaf.dtype != bool else leaf, control),
        as_numbers(controller, dtype),
        *(by_axis(pair) for pair in pairs),
        arm.start(task.start, dtype),
        steps=steps,
        dt=task.dt,
        arm=arm,
    )


@partial(jax.jit, static_argnames=("steps", "dt", "arm"))
def _reproduce(
    truth: Frame,
    control: Frame,
    controller: Controller,
    travel: jax.Array,
    friction: jax.Array,
    stop_compliance: jax.Array,
    compliance: jax.Array,
    start: jax.Array,
    *,
    steps: Steps,
    dt: float,
    arm: Arm,
) -> Trials:
    dtype, step = travel.dtype, steps.length
    pose = forward_kinematics(start, arm)

    def trial(truth: Frame, control: Frame) -> Any:
        here, there = locate(truth, *pose), locate(control, *pose)
        # the goal in the ground, and its projection on the axes of the control frame
        turn = apply(there.angular_axes.T, apply(here.angular_axes, truth.free[:3]))
        shift = apply(there.linear_axes.T, apply(here.linear_axes, truth.free[3:]))
        goal = control.free * jnp.concatenate([turn, shift])
        drive = control_drive(controller, control, goal)

        def law(slipped: jax.Array) -> AxisLaw:
            held = hold(truth.free, slipped, step, compliance)
            stopped = (slipped > travel) | (slipped < -_REBOUND)
            beyond = jnp.where(slipped > travel, slipped - travel, slipped)
            stop = hold(1 - truth.free, beyond, step, stop_compliance)
            offset = jnp.where(stopped, stop.offset, 0)
            softness = jnp.where(stopped, stop.softness, 1 / friction)
            return AxisLaw(
                acts=jnp.ones_like(travel),
                offset=jnp.where(truth.free > 0, offset, held.offset),
                softness=jnp.where(truth.free > 0, softness, held.softness),
            )

        state = there, jnp.zeros_like(travel)
        return integrate(arm, truth, start, drive, state, law, steps)

    track = jax.vmap(trial)(truth, control)
    free = truth.free[:, None]
    reaction = track.force * (1 - free)
    arrived = jnp.all((track.slip > (travel - _ARRIVED)[None, None]) | (free == 0), axis=-1)
    times = dt * jnp.arange(steps.samples + 1, dtype=dtype)
    completed = jnp.any(arrived, axis=-1)
    first = times[jnp.argmax(arrived, axis=-1)]
    _, status = rollout_status(track, truth.free, compliance, arm)
    stuck = ~completed & (jax.vmap(partial(_least_gain, arm=arm))(track.joints[:, -1]) < _SINGULAR)
    return Trials(
        times=times,
        poses=transforms.make_pose(*forward_kinematics(track.joints, arm)),
        joint_positions=track.joints,
        travelled=track.slip,
        reaction=reaction,
        completed=completed,
        completion_time=jnp.where(completed, first, jnp.inf),
        peak_moment=jnp.max(jnp.linalg.norm(reaction[..., :3], axis=-1), axis=-1),
        peak_force=jnp.max(jnp.linalg.norm(reaction[..., 3:], axis=-1), axis=-1),
        status_code=jnp.where(stuck, jnp.maximum(status, jnp.int32(RolloutStatus.SINGULAR)), status),
    )


def _least_gain(joints: jax.Array, arm: Arm) -> jax.Array:
    """Smallest singular value of the Jacobian from joint velocities to the twist of {b}."""
    jacobian = arm_motion(joints, jnp.zeros_like(joints), arm).jacobian
    return jnp.linalg.svd(jacobian, compute_uv=False)[-1]

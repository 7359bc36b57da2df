"""Tasks from end-stop to end-stop, and their trials."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.compilation import index_leaves
from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.located import Frame, frame_arrays, locate
from reframe_jax.geometry import rotations, transforms
from reframe_jax.geometry.products import apply, matmul
from reframe_jax.identification.results import Identification
from reframe_jax.simulation.arm.compiled import as_numbers, jit_simulation
from reframe_jax.simulation.arm.demonstration import sampling
from reframe_jax.simulation.arm.model import PANDA, Arm, find_arm, forward_kinematics
from reframe_jax.simulation.arm.rollout import AxisLaw, Steps, hold, integrate
from reframe_jax.simulation.arm.status import RolloutStatus, judge
from reframe_jax.simulation.reproduction.controllers import (
    Controller,
    by_axis,
    constant_wrench,
    control_drive,
)
from reframe_jax.simulation.reproduction.frames import ROOMY, control_frames

__all__ = ["Task", "Trials", "reproduce"]

_ARRIVED = 2e-3  # rad or m from the stop, or beyond
_SINGULAR = 0.01  # least singular value of the Jacobian, in rad and m, of an arm that cannot go on
_REBOUND = 1e-4  # rad or m behind the start at which the first stop holds


@dataclass(frozen=True)
class Task:
    """From one end-stop of every free axis to the other.

    Attributes:
        start: (7,) rad, configuration of the arm at the first stops.
        travel: rad and m between the stops.
        friction: N m s/rad and N s/m, of the mechanism along its free axes.
        stop_compliance: rad/(N m) and m/N, of the second stop, a damped spring.
        duration: s.
        dt: s, between samples.
        step: s, of the simulation.
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
        poses: (N, K+1, 4, 4) m, of {b} in {g}.
        joint_positions: (N, K+1, 7) rad.
        travelled: (N, K+1, 6) rad and m, motion along the axes of the true frame since the start.
        reaction: (N, K+1, 6) N m and N, of the constraint on the tool along its constrained axes.
        completed: (N,) bool, whether every free axis arrived at its stop.
        completion_time: (N,) s, when the last axis arrived; infinite if one did not.
        peak_moment: (N,) N m, largest norm of the reaction moment over a trial (paper, section 6.2).
        peak_force: (N,) N, largest norm of the reaction force.
        status_code: (N,) int, a ``RolloutStatus``; SINGULAR if the stop was out of the arm's reach.
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
        """Some of the trials; a single index leaves no batch axis."""
        parts = {name: value for name, value in vars(self).items() if name != "times"}
        return Trials(self.times, **index_leaves(parts, index))


def reproduce(
    truth: ConstraintFrame,
    frames: Identification | ConstraintFrame | Frame,
    *,
    controller: Controller = constant_wrench(),  # noqa: B008
    task: Task = Task(),
    arm: str | Arm = PANDA,
    compliance: tuple[float, float] = (0.0, 0.0),
) -> Trials:
    """Move the arm from end-stop to end-stop by control in given frames, gravity compensated.

    The torques are tau = J^T W, where W holds the controller's moments and forces along the axes of the
    control frame, the forces at its origin, and the frame moves with the robot as its type says. The
    goal is given as a direction in the world at the start, the sum of the true free axes; the control
    frame decides what part of it is free and how it moves on.

    Args:
        truth: the true constraint, with geometry (N, 3) each.
        frames: the frames to control in, N of them.
        controller: the wrenches.
        task: the end-stops and the duration.
        arm: the robot.
        compliance: rad/(N m) and m/N, of tool and mount.

    Raises:
        ValueError: for an unknown robot, or batches that differ.
    """
    arm = find_arm(arm)
    control = control_frames(frames)
    if truth.position.ndim != 2 or control.position.shape != truth.position.shape:
        raise ValueError(
            f"Expected as many control frames as constraints, geometry (N, 3) each; found "
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


@jit_simulation(("steps", "dt", "arm"))
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
        # the goal in the world, and what the control frame makes of it
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
    _, status = judge(track, truth.free, compliance, arm)
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
    rotation, _ = forward_kinematics(joints, arm)
    turning, moving = jax.jacfwd(partial(forward_kinematics, arm=arm))(joints)
    turning = matmul(jnp.moveaxis(turning, -1, 0), rotation.T)
    spin = rotations.vee(turning).T
    return jnp.linalg.svd(jnp.concatenate([spin, moving]), compute_uv=False)[-1]

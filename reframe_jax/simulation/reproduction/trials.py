"""Reproduce tasks from end-stop to end-stop: one constraint, or consecutive stages with several."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.compilation import index_leaves
from reframe_jax.constraints.frame import ConstraintFrame, Frame, assemble_frame, frame_arrays, locate
from reframe_jax.geometry import transforms
from reframe_jax.geometry.products import apply
from reframe_jax.identification.results import Identification
from reframe_jax.segmentation.results import Segmentation
from reframe_jax.simulation.arm.demonstration import sampling
from reframe_jax.simulation.arm.imperfections import by_axis
from reframe_jax.simulation.arm.model import PANDA, Arm, arm_motion, find_arm, forward_kinematics
from reframe_jax.simulation.arm.rollout import AxisLaw, RolloutStatus, hold, integrate, rollout_status
from reframe_jax.simulation.reproduction.controllers import Controller, constant_wrench, control_drive

ROOMY = (0.0, -0.7, 0.0, -2.35, 0.0, 1.65, 0.785)
"""rad, initial joint positions of tasks: closer to the base than home, so that no task stretches the arm."""

_TRAVEL = (0.4, 0.1)  # rad and m, distance between the end-stops
_FRICTION = (5.0, 40.0)  # N m s/rad and N s/m, friction of the mechanism along its free axes
_STOP_COMPLIANCE = (5e-3, 5e-4)  # rad/(N m) and m/N, compliance of the second end-stop, a damped spring
_DURATION, _DT = 5.0, 0.05  # s, duration of a trial, and time between samples
_ARRIVED = 2e-3  # rad or m, largest distance from the end-stop of an axis that has arrived
_SINGULAR = 0.01  # smallest singular value of the Jacobian, in rad and m, below which the arm is singular
_REBOUND = 1e-4  # rad or m, distance behind the start at which the first end-stop acts


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
        peak_moment, peak_force: (N,) N m and N, largest norms of the reaction (paper, section 6.2).
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


@dataclass(frozen=True)
class SequenceTrial:
    """A reproduced task with several constraints.

    Attributes:
        stages: the trial of each stage, without batch axis, up to the first stage that did not reach its
            end-stop.
        completed: whether all stages reached their end-stops.
        hand_overs: (S-1,) N, largest reaction force in the first tenth of each stage after the first.
    """

    stages: tuple[Trials, ...]
    completed: bool
    hand_overs: np.ndarray


def control_frames(found: Identification | ConstraintFrame | Frame) -> Frame:
    """Return the frames in whose axes a controller commands velocities and forces.

    They have the leading dimensions of ``found``; in a batch of identifications, each has its own types.
    """
    if isinstance(found, Frame):
        return found
    if isinstance(found, ConstraintFrame):
        return frame_arrays(found)
    angular, linear = found.angular, found.linear
    types, dof = (angular.type_code, linear.type_code), (angular.dof, linear.dof)
    return assemble_frame(types, (angular.axes, linear.axes), linear.position, dof)


def reproduce(
    truth: ConstraintFrame,
    frames: Identification | ConstraintFrame | Frame,
    *,
    controller: Controller = constant_wrench(),  # noqa: B008
    arm: str | Arm = PANDA,
    start: "ArrayLike" = ROOMY,
    compliance: tuple[float, float] = (0.0, 0.0),
) -> Trials:
    """Move the arm from end-stop to end-stop with a controller in given frames, with gravity compensation.

    The torques are tau = J^T W. The wrench W contains the controller's moments and forces along the axes of
    the control frame, with forces at its origin. The type of the control frame determines its motion with the
    robot. The goal is a direction in the ground at the start, the sum of the true free axes; the control
    frame determines the free part of this direction and its later motion. The end-stops are 0.4 rad and 0.1 m
    apart; a trial takes 5 s.

    The true constraint has a geometry (N, 3), for N control frames. ``start`` (7,), rad, are the joint
    positions at the first end-stops; ``compliance``, rad/(N m) and m/N, is that of the tool and its mount. A
    ValueError is raised for an unknown robot, or batches of different sizes.
    """
    arm = find_arm(arm)
    control = control_frames(frames)
    if truth.position.ndim != 2 or control.position.shape != truth.position.shape:
        raise ValueError(
            f"Expected one control frame per constraint, with geometry (N, 3); found "
            f"{control.position.shape} and {truth.position.shape}."
        )
    dtype = truth.position.dtype
    return _reproduce(
        frame_arrays(truth),
        jax.tree.map(lambda leaf: leaf.astype(dtype) if leaf.dtype != bool else leaf, control),
        jax.tree.map(lambda number: jnp.asarray(number, dtype=dtype), controller),
        by_axis(compliance, dtype),
        arm.start(start, dtype),
        arm=arm,
    )


@partial(jax.jit, static_argnames="arm")
def _reproduce(
    truth: Frame, control: Frame, controller: Controller, compliance: jax.Array, start: jax.Array, *, arm: Arm
) -> Trials:
    dtype, steps = start.dtype, sampling(_DURATION, _DT)
    pairs, step, pose = (_TRAVEL, _FRICTION, _STOP_COMPLIANCE), steps.length, forward_kinematics(start, arm)
    travel, friction, stop_compliance = (by_axis(pair, dtype) for pair in pairs)

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

        return integrate(arm, truth, start, drive, (there, jnp.zeros_like(travel)), law, steps)

    track = jax.vmap(trial)(truth, control)
    free = truth.free[:, None]
    reaction = track.force * (1 - free)
    arrived = jnp.all((track.slip > (travel - _ARRIVED)[None, None]) | (free == 0), axis=-1)
    times = _DT * jnp.arange(steps.samples + 1, dtype=dtype)
    completed = jnp.any(arrived, axis=-1)
    status = rollout_status(track, truth.free, compliance, arm)
    ends = jax.vmap(partial(arm_motion, arm=arm))(track.joints[:, -1], jnp.zeros_like(track.joints[:, -1]))
    stuck = ~completed & (jnp.linalg.svd(ends.jacobian, compute_uv=False)[:, -1] < _SINGULAR)
    return Trials(
        times=times,
        poses=transforms.make_pose(*forward_kinematics(track.joints, arm)),
        joint_positions=track.joints,
        travelled=track.slip,
        reaction=reaction,
        completed=completed,
        completion_time=jnp.where(completed, times[jnp.argmax(arrived, axis=-1)], jnp.inf),
        peak_moment=jnp.max(jnp.linalg.norm(reaction[..., :3], axis=-1), axis=-1),
        peak_force=jnp.max(jnp.linalg.norm(reaction[..., 3:], axis=-1), axis=-1),
        status_code=jnp.where(stuck, jnp.maximum(status, jnp.int32(RolloutStatus.SINGULAR)), status),
    )


def reproduce_sequence(
    truths: Sequence[ConstraintFrame],
    frames: Segmentation | Sequence[Identification | ConstraintFrame],
    *,
    arm: str | Arm = PANDA,
) -> SequenceTrial:
    """Reproduce a task with several constraints; each stage starts at the end of the previous stage.

    A stage moves from end-stop to end-stop, see :func:`reproduce`. Each stage starts at rest: the next true
    constraint, with geometry (3,), becomes active at the current pose of the tool, and the control frame is
    located at this pose. A stage that does not reach its end-stop ends the task. ``frames`` is a
    segmentation, whose moving segments are the stages, or one identification or constraint frame per stage,
    with geometry (3,). A ValueError is raised for an unknown robot, no stages, different numbers of stages,
    or a segment without identification.
    """
    every = [each.identification for each in frames.moving] if isinstance(frames, Segmentation) else frames
    control = [frame for frame in every if frame is not None]
    if len(control) < len(every):
        raise ValueError("A segment is too short to identify, so it has no control frame.")
    if not truths or len(truths) != len(control):
        raise ValueError(
            f"reproduce_sequence needs a frame for each constraint; got {len(truths)} constraints and "
            f"{len(control)} frames."
        )
    stages: list[Trials] = []
    for truth, frame in zip(truths, control, strict=True):
        start = stages[-1].joint_positions[-1] if stages else ROOMY
        pair = jax.tree.map(lambda leaf: leaf[None], (truth, frame))
        stages.append(reproduce(*pair, arm=arm, start=start)[0])
        if not bool(stages[-1].completed):
            break
    forces = [np.linalg.norm(np.asarray(s.reaction)[:, 3:], axis=1) for s in stages[1:]]
    return SequenceTrial(
        stages=tuple(stages),
        completed=len(stages) == len(truths) and bool(stages[-1].completed),
        hand_overs=np.array([f[: max(1, len(f) // 10)].max() for f in forces]),
    )

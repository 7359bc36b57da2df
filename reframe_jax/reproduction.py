"""Tasks reproduced with control in constraint frames (paper, section 6).

The arm starts at one end-stop of a constraint and is to reach the other, moved by wrenches along the
axes of a control frame: the true one, one with errors, or one that was identified. What an inexact
frame costs is the reaction along the true constrained axes; an exact one has some too, from the arm's
own inertia and friction, and is the baseline beside every figure.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax import metrics, rotations, transforms
from reframe_jax.frames import AngularType, ConstraintFrame, LinearType
from reframe_jax.identify import identify
from reframe_jax.panda.constraint import Frame, Located, frame_arrays, locate, moved, slip, twist_map
from reframe_jax.panda.demonstration import (
    SPREAD,
    Demonstration,
    RolloutStatus,
    demonstrations,
    sampling,
)
from reframe_jax.panda.dynamics import Motion
from reframe_jax.panda.imperfections import REALISTIC, Imperfections
from reframe_jax.panda.model import PANDA, Arm, arm_named, forward_kinematics
from reframe_jax.panda.rollout import AxisLaw, hold, integrate
from reframe_jax.results import Identification

__all__ = [
    "LITERATURE_ERRORS",
    "Comparison",
    "Controller",
    "Task",
    "Trials",
    "axis_impedance",
    "compare",
    "constant_wrench",
    "control_frames",
    "erroneous_frames",
    "hybrid",
    "reproduce",
]

LITERATURE_ERRORS = ((0.5, 5.0), (1.0, 7.5))
"""Ranges of the errors that methods with prior knowledge report, in degrees and mm (paper, section 7.2)."""

_ARRIVED = 2e-3  # rad or m from the stop, or beyond
_REBOUND = 1e-4  # rad or m behind the start at which the first stop holds

Pair = tuple[float | jax.Array, float | jax.Array]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Controller:
    """Wrenches along the axes of a control frame; every field is (rotations, translations).

    Along free axes a constant push, and a spring and a damper to a point that travels at ``speed`` as
    far as ``reach``; along constrained axes a spring and a damper to the start. Special cases:
    :func:`constant_wrench`, :func:`hybrid`, :func:`axis_impedance`.

    Attributes:
        push: N m, N, along free axes, towards the goal.
        speed: rad/s, m/s, of the travelling point.
        reach: rad, m, how far it travels.
        stiffness: N m/rad, N/m, along free axes.
        damping: N m s/rad, N s/m, along free axes.
        held_stiffness: N m/rad, N/m, along constrained axes.
        held_damping: N m s/rad, N s/m, along constrained axes.
    """

    push: Pair = (0.0, 0.0)
    speed: Pair = (0.0, 0.0)
    reach: Pair = (math.inf, math.inf)
    stiffness: Pair = (0.0, 0.0)
    damping: Pair = (0.0, 0.0)
    held_stiffness: Pair = (0.0, 0.0)
    held_damping: Pair = (0.0, 0.0)


def constant_wrench(moment: float = 3.5, force: float = 7.0) -> Controller:
    """The paper's control: constant moments (N m) and forces (N) along free axes, nothing else."""
    return Controller(push=(moment, force))


def hybrid(speed: Pair = (0.3, 0.08)) -> Controller:
    """Hybrid force/velocity control: velocities along free axes, zero force along constrained ones.

    Args:
        speed: rad/s and m/s.
    """
    return Controller(speed=speed, damping=(5.0, 120.0))


def axis_impedance(speed: Pair = (0.3, 0.08), reach: Pair = (0.5, 0.15)) -> Controller:
    """Impedance by axis: stiff along free axes towards a travelling point, soft along constrained ones.

    Args:
        speed: rad/s and m/s.
        reach: rad and m; beyond the end-stop, so that it is pressed.
    """
    return Controller(
        speed=speed,
        reach=reach,
        stiffness=(40.0, 600.0),
        damping=(4.0, 60.0),
        held_stiffness=(2.0, 40.0),
        held_damping=(0.4, 8.0),
    )


@dataclass(frozen=True)
class Task:
    """From one end-stop of every free axis to the other.

    Attributes:
        travel: rad and m between the stops.
        friction: N m s/rad and N s/m, of the mechanism along its free axes.
        stop_compliance: rad/(N m) and m/N, of the second stop, a damped spring.
        duration: s.
        dt: s, between samples.
        step: s, of the simulation.
    """

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
        completion_time: (N,) s, when the last one did; infinite where it did not.
        peak_moment: (N,) N m, largest norm of the reaction moment over a trial (paper, section 6.2).
        peak_force: (N,) N, largest norm of the reaction force.
        status_code: (N,) int, a ``RolloutStatus``.
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


def control_frames(found: Identification | ConstraintFrame | Frame) -> Frame:
    """Frames to control in, with the batch axes of what they come from.

    Args:
        found: identifications, whose types may differ from one to the next, or constraint frames.
    """
    if isinstance(found, Frame):
        return found
    if isinstance(found, ConstraintFrame):
        return frame_arrays(found)
    dtype = found.linear.position.dtype
    in_body = np.array(
        [(t.orientation_body == AngularType.B, t.position_body == AngularType.B) for t in LinearType]
    )
    angular = found.angular.type_code == int(AngularType.B)
    linear = jnp.asarray(in_body)[found.linear.type_code]
    return Frame(
        angular_axes=found.angular.axes,
        linear_axes=found.linear.axes,
        position=found.linear.position,
        free=jnp.concatenate([found.angular.dof, found.linear.dof], axis=-1).astype(dtype),
        on_body=jnp.concatenate([jnp.asarray(angular)[..., None], linear], axis=-1),
    )


def erroneous_frames(
    truth: ConstraintFrame,
    key: jax.Array,
    *,
    angles: tuple[float, float] = LITERATURE_ERRORS[0],
    distances: tuple[float, float] = LITERATURE_ERRORS[1],
    arm: str | Arm = PANDA,
) -> Frame:
    """Frames turned and shifted by errors of random direction and uniform size.

    Args:
        truth: geometry (N, 3) each.
        key: of the errors.
        angles: degrees, smallest and largest turn.
        distances: mm, smallest and largest shift.
        arm: the robot, at home.
    """
    dtype, count = truth.position.dtype, truth.position.shape[0]
    pose = forward_kinematics(jnp.asarray(arm_named(arm).home, dtype=dtype), arm_named(arm))

    def draw(key: jax.Array, low: float, high: float) -> jax.Array:
        way, size = jax.random.split(key)
        direction = jax.random.normal(way, (count, 3), dtype)
        length = jax.random.uniform(size, (count, 1), dtype, low, high)
        return length * direction / jnp.linalg.norm(direction, axis=-1, keepdims=True)

    turn_key, shift_key = jax.random.split(key)
    turns = rotations.rotation_exp(draw(turn_key, *(math.radians(angle) for angle in angles)))
    shifts = draw(shift_key, *(distance / 1e3 for distance in distances))
    return jax.vmap(lambda frame, turn, shift: moved(frame, turn, shift, *pose))(
        frame_arrays(truth), turns, shifts
    )


def reproduce(
    truth: ConstraintFrame,
    frames: Identification | ConstraintFrame | Frame,
    *,
    controller: Controller = constant_wrench(),  # noqa: B008
    task: Task = Task(),  # noqa: B008
    arm: str | Arm = PANDA,
    compliance: tuple[float, float] = (0.0, 0.0),
) -> Trials:
    """Move the arm from end-stop to end-stop by control in given frames, gravity compensated.

    The torques are tau = J^T W, where W holds the controller's moments and forces along the axes of the
    control frame, the forces at its origin, and the frame moves with the robot as its type says. The
    goal is given as a direction in the world at the start, the sum of the true free axes; the control
    frame decides what part of it is free and how it moves on.

    Args:
        truth: the constraint that is there, geometry (N, 3) each.
        frames: the frames to control in, N of them.
        controller: the wrenches.
        task: the end-stops, and for how long.
        arm: the robot, which starts at home.
        compliance: rad/(N m) and m/N, of tool and mount.

    Raises:
        ValueError: for an unknown robot, or batches that differ.
    """
    arm = arm_named(arm)
    control = control_frames(frames)
    if truth.position.ndim != 2 or control.position.shape != truth.position.shape:
        raise ValueError(
            f"Expected as many control frames as constraints, geometry (N, 3) each; found "
            f"{control.position.shape} and {truth.position.shape}."
        )
    samples, substeps = sampling(task.duration, task.dt, task.step)
    dtype = truth.position.dtype
    numbers = jax.tree.map(
        lambda x: jnp.asarray(x, dtype=dtype), (task.travel, task.friction, task.stop_compliance, compliance)
    )
    return _reproduce(
        frame_arrays(truth),
        jax.tree.map(lambda leaf: leaf.astype(dtype) if leaf.dtype != bool else leaf, control),
        jax.tree.map(lambda x: jnp.asarray(x, dtype=dtype), controller),
        *(_by_axis(pair) for pair in numbers),
        samples=samples,
        substeps=substeps,
        dt=task.dt,
        arm=arm,
    )


def _by_axis(pair: tuple[jax.Array, jax.Array]) -> jax.Array:
    """(6,) from a value for rotations and one for translations."""
    return jnp.stack([pair[0]] * 3 + [pair[1]] * 3)


@partial(jax.jit, static_argnames=("samples", "substeps", "dt", "arm"))
def _reproduce(
    truth: Frame,
    control: Frame,
    controller: Controller,
    travel: jax.Array,
    friction: jax.Array,
    stop_compliance: jax.Array,
    compliance: jax.Array,
    *,
    samples: int,
    substeps: int,
    dt: float,
    arm: Arm,
) -> Trials:
    dtype, step = travel.dtype, dt / substeps
    start = jnp.asarray(arm.home, dtype=dtype)
    pose = forward_kinematics(start, arm)

    def trial(truth: Frame, control: Frame) -> Any:
        here, there = locate(truth, *pose), locate(control, *pose)
        # the goal in the world, and what the control frame makes of it
        turn = there.angular_axes.T @ here.angular_axes @ truth.free[:3]
        shift = there.linear_axes.T @ here.linear_axes @ truth.free[3:]
        goal = control.free * jnp.concatenate([turn, shift])
        drive = _drive(controller, control, goal)

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
        return integrate(arm, truth, start, drive, state, law, samples=samples, substeps=substeps, step=step)

    track = jax.vmap(trial)(truth, control)
    free = truth.free[:, None]
    reaction = track.force * (1 - free)
    arrived = jnp.all((track.slip > (travel - _ARRIVED)[None, None]) | (free == 0), axis=-1)
    times = dt * jnp.arange(samples + 1, dtype=dtype)
    completed = jnp.any(arrived, axis=-1)
    first = times[jnp.argmax(arrived, axis=-1)]
    lower, upper = jnp.asarray(arm.limits, dtype=dtype)[:, None, None]
    beyond = jnp.any((track.joints < lower) | (track.joints > upper), axis=(1, 2))
    finite = jnp.all(jnp.isfinite(track.joints), axis=(1, 2))
    status = jnp.where(beyond, jnp.int32(RolloutStatus.JOINT_LIMIT), jnp.int32(RolloutStatus.OK))
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
        status_code=jnp.where(finite, status, jnp.int32(RolloutStatus.DIVERGED)),
    )


def _drive(
    controller: Controller, frame: Frame, goal: jax.Array
) -> Callable[[Any, jax.Array, Motion, Located], tuple[Any, jax.Array]]:
    """The drive of a controller; its state is the control frame's place and how far its axes have moved."""
    wanted = {name: _by_axis(pair) for name, pair in vars(controller).items()}

    def drive(
        state: tuple[Located, jax.Array], t: jax.Array, motion: Motion, _: Located
    ) -> tuple[tuple[Located, jax.Array], jax.Array]:
        before, made = state
        now = locate(frame, motion.rotation, motion.position)
        made = made + slip(before, now)
        rows = twist_map(now)
        velocity = rows @ motion.twist
        point = jnp.minimum(wanted["speed"] * t, wanted["reach"]) * goal
        pace = jnp.where(wanted["speed"] * t < wanted["reach"], wanted["speed"], 0) * goal
        free = (
            wanted["push"] * goal
            + wanted["stiffness"] * (point - made)
            + wanted["damping"] * (pace - velocity)
        )
        held = -wanted["held_stiffness"] * made - wanted["held_damping"] * velocity
        along = jnp.where(frame.free > 0, free, held)
        return (now, made), motion.jacobian.T @ (rows.T @ along)

    return drive


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Comparison:
    """A task reproduced in three kinds of frames: the rows of the paper's Figure 5.

    Attributes:
        demonstrations: that the frames were identified from.
        found: the identifications.
        exact: trials in the true frames, the baseline.
        literature: trials in frames with the errors of methods that have prior knowledge.
        identified: trials in the identified frames.
        errors: (N, 3) of the identified frames: deg of the angular and of the linear axis, and mm; NaN
            where the constraint leaves them free.
    """

    demonstrations: Demonstration
    found: Identification
    exact: Trials
    literature: Trials
    identified: Trials
    errors: jax.Array

    def excess(self, name: str) -> tuple[jax.Array, jax.Array]:
        """Peak reaction moments (N m) and forces (N) over those in the exact frame, (N,) each."""
        trials = self.rows[name]
        return (
            trials.peak_moment - self.exact.peak_moment,
            trials.peak_force - self.exact.peak_force,
        )

    @property
    def rows(self) -> dict[str, Trials]:
        """The trials by name."""
        return {"exact": self.exact, "literature": self.literature, "identified": self.identified}


def compare(
    constraint: str | ConstraintFrame,
    key: jax.Array,
    trials: int = 30,
    *,
    controller: Controller = constant_wrench(),  # noqa: B008
    task: Task = Task(),  # noqa: B008
    imperfections: Imperfections = REALISTIC,
    spread: tuple[float, float] = SPREAD,
    arm: str | Arm = PANDA,
    progress: Callable[[int, int], None] | None = None,
) -> Comparison:
    """From demonstration to reproduction: demonstrate, identify, and reproduce in three kinds of frames.

    Args:
        constraint: label or name of one of the twelve, or a frame.
        key: of everything random.
        trials: number of demonstrations, each with a geometry of its own, and of reproductions.
        controller: the wrenches.
        task: the end-stops.
        imperfections: of the demonstrations; their compliance is that of the reproductions too.
        spread: rad and m, of the geometry; see :func:`reframe_jax.panda.demonstrate`.
        arm: the robot.
        progress: see :func:`reframe_jax.panda.demonstrations`.
    """
    demonstrate_key, error_key = jax.random.split(key)
    parts = list(
        demonstrations(
            constraint,
            demonstrate_key,
            trials,
            chunk=min(trials, 64),
            imperfections=imperfections,
            spread=spread,
            arm=arm,
            progress=progress,
        )
    )
    made = jax.tree.map(lambda *leaves: jnp.asarray(np.concatenate(leaves)), *parts)
    made = replace(made, times=jnp.asarray(parts[0].times))
    found = identify(made.poses, times=made.times)
    errors = metrics.geometry_errors(found, made.truth, start=made.exact_poses[:, 0])
    run = partial(
        reproduce,
        made.truth,
        controller=controller,
        task=task,
        arm=arm,
        compliance=(float(imperfections.angular_compliance), float(imperfections.compliance)),
    )
    return Comparison(
        demonstrations=made,
        found=found,
        exact=run(made.truth),
        literature=run(erroneous_frames(made.truth, error_key, arm=arm)),
        identified=run(found),
        errors=jnp.stack(
            [jnp.degrees(errors.angular), jnp.degrees(errors.linear), 1e3 * errors.position], axis=-1
        ),
    )

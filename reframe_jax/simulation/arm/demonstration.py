"""Simulate batches of demonstrations: a hand guides the arm under one or several constraints."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, TypedDict

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.compilation import index_leaves
from reframe_jax.constraints.frame import ConstraintFrame, frame_arrays, move_frame, place_frame
from reframe_jax.geometry import rotations
from reframe_jax.simulation.arm import guide
from reframe_jax.simulation.arm.imperfections import Imperfections, check_imperfections, compliance_of
from reframe_jax.simulation.arm.model import PANDA, Arm, find_arm, forward_kinematics
from reframe_jax.simulation.arm.rollout import Steps, rollout_status
from reframe_jax.simulation.sequences import each_duration
from reframe_jax.simulation.synthetic import Excitation, pitch_of

SPREAD = (0.4, 0.02)
"""rad and m, standard deviations per component of a random geometry."""

_ORIGIN = (0.05, 0.02, -0.12)  # m, from the TCP to the origin of a named constraint, in the axes of the base
_LONGEST = 0.01  # s, longest step at which the simulation keeps the constraint; its error is a few um
_SETTLE = 0.4  # s, time that the tool needs to come to rest after the hand


class DemonstrateOptions(TypedDict, total=False):
    """Keyword arguments of :func:`demonstrate`, for functions that pass them on."""

    duration: float
    dt: float
    excitation: str | Excitation
    spread: tuple[float, float]
    imperfections: Imperfections
    arm: str | Arm
    start: ArrayLike | None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Demonstration:
    """A batch of demonstrations; slice it like an array.

    Attributes:
        times: (K+1,) s.
        poses: (N, K+1, 4, 4) m, recorded poses of {b} in {g}, with the errors of the robot.
        exact_poses: (N, K+1, 4, 4) m, the true poses.
        joint_positions, joint_velocities: (N, K+1, 7) rad and rad/s.
        truth: the true constraint, with one geometry (N, 3) per demonstration.
        reaction: (N, K+1, 6) N m and N, moments of the constraint on the tool along the angular axes, and
            forces along the linear axes at the frame's origin; zero along free axes.
        slip: (N, K+1, 6) rad and m, displacement along the axes of the frame, the integral of the velocity.
            Along constrained axes, the slip is the violation of the constraint; see ``violation``.
        status_code: (N,) int, a :class:`RolloutStatus`.
    """

    times: jax.Array
    poses: jax.Array
    exact_poses: jax.Array
    joint_positions: jax.Array
    joint_velocities: jax.Array
    truth: ConstraintFrame
    reaction: jax.Array
    slip: jax.Array
    status_code: jax.Array

    def __getitem__(self, index: int | slice | np.ndarray | jax.Array) -> "Demonstration":
        """Select demonstrations; a single index removes the batch axis."""
        parts = {name: value for name, value in vars(self).items() if name != "times"}
        return Demonstration(self.times, **index_leaves(parts, index))

    @property
    def violation(self) -> jax.Array:
        """(..., 2) rad and m, largest slip along constrained rotations and translations."""
        free = jnp.asarray((*self.truth.angular_dof, *self.truth.linear_dof), dtype=bool)
        held = jnp.max(jnp.abs(self.slip), axis=-2)
        held = jnp.where(jnp.broadcast_to(free, held.shape), 0, held)
        return jnp.stack([jnp.max(held[..., :3], axis=-1), jnp.max(held[..., 3:], axis=-1)], axis=-1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SequenceDemonstration:
    """A batch of demonstrations of a task with several constraints; slice it like an array.

    Attributes:
        times, poses, exact_poses, joint_positions: as in :class:`Demonstration`, of the whole task.
        stages: one demonstration per constraint. The first pose of a stage equals the last pose of the
            previous stage. The ``times`` of each stage start at 0.
    """

    times: jax.Array
    poses: jax.Array
    exact_poses: jax.Array
    joint_positions: jax.Array
    stages: tuple[Demonstration, ...]

    def __getitem__(self, index: int | slice | np.ndarray | jax.Array) -> "SequenceDemonstration":
        """Select demonstrations; a single index removes the batch axis."""
        arrays = self.poses[index], self.exact_poses[index], self.joint_positions[index]
        return SequenceDemonstration(self.times, *arrays, tuple(stage[index] for stage in self.stages))

    @property
    def boundaries(self) -> tuple[int, ...]:
        """Index of the first pose of each stage after the first; this pose obeys both constraints."""
        return tuple(np.cumsum([len(stage.times) - 1 for stage in self.stages])[:-1].tolist())

    @property
    def status_code(self) -> jax.Array:
        """(N,) int, the worst :class:`RolloutStatus` of all stages."""
        return jnp.max(jnp.stack([stage.status_code for stage in self.stages]), axis=0)


def frame_on_arm(
    constraint: str | ConstraintFrame, arm: str | Arm = PANDA, *, start: "ArrayLike | None" = None
) -> ConstraintFrame:
    """Place a named constraint so that the arm can move under the constraint; return a frame unchanged.

    The axes of the frame are parallel to the robot's base at the start. The origin is 0.13 m below and in
    front of the TCP, like the tip of a tool or the axis of a joint at this distance. ``start`` is (..., 7)
    rad, the arm's home by default. A KeyError is raised for an unknown constraint, a ValueError for an
    unknown robot, or if ``constraint`` is not a constraint.
    """
    if isinstance(constraint, ConstraintFrame):
        return constraint
    if not isinstance(constraint, str):
        raise ValueError(f"A constraint must be a label, a name or a ConstraintFrame, not {constraint!r}.")
    if pitch_of(constraint) is not None:
        raise ValueError("A constraint of the arm has no pitch; choose another one than the screw joint.")
    arm = find_arm(arm)
    joints = arm.start(start, float)
    rotation, position = forward_kinematics(joints, arm)
    axes, offset = (jnp.asarray(part, dtype=joints.dtype) for part in (np.eye(3), _ORIGIN))
    axes, offset = jnp.broadcast_to(axes, rotation.shape), jnp.broadcast_to(offset, position.shape)
    return place_frame(ConstraintFrame.named(constraint), axes, position + offset, rotation, position)


def demonstrate(
    constraint: str | ConstraintFrame,
    key: jax.Array,
    *,
    batch: int = 1,
    first: int = 0,
    duration: float = 5.0,
    dt: float = 0.05,
    excitation: str | Excitation = "exciting",
    spread: tuple[float, float] = (0.0, 0.0),
    imperfections: Imperfections = Imperfections(),  # noqa: B008
    arm: str | Arm = PANDA,
    start: "ArrayLike | None" = None,
) -> Demonstration:
    """Simulate a hand that guides the arm under a constraint.

    The function works under ``jit`` (with static shapes and names). It also works under ``grad`` with respect
    to the geometry of the constraint. One compiled program serves all constraints. For a given key,
    demonstration i is the same in every batch, up to rounding errors. Check ``status_code``, because the
    simulation does not enforce joint limits.

    Args:
        constraint: label or name of one of the twelve constraints of the paper, placed by
            :func:`frame_on_arm`, or any frame, with its geometry in the robot's base and the TCP frame. A
            geometry (N, 3) gives each demonstration a separate geometry.
        key: JAX random key.
        batch: number N of demonstrations.
        first: number of the first demonstration, to continue an earlier batch.
        duration: s.
        dt: s, time between recorded samples. The steps of the simulation divide it, and are at most 0.01 s.
        excitation: motion along the free axes: ``"exciting"``, ``"brisk"``, or a function of time
            that returns angular and linear velocities (3,), in rad/s and m/s.
        spread: rad and m, standard deviations of a random rotation and shift of the geometry of each
            demonstration, for example :data:`SPREAD`.
        imperfections: errors of the robot and its sensors.
        arm: ``"panda"``, ``"fr3"``, or an arm.
        start: (7,) or (N, 7) rad, initial joint positions, at rest; the arm's home by default.

    Raises:
        KeyError: for an unknown constraint.
        ValueError: for an unknown name, or unusable numbers or shapes.
    """
    options: dict[str, Any] = {"batch": batch, "first": first, "dt": dt, "excitation": excitation}
    options |= {"spread": spread, "imperfections": imperfections, "arm": arm, "start": start}
    return demonstrate_sequence([constraint], key, durations=duration, pause=False, **options).stages[0]


def demonstrate_sequence(
    constraints: Sequence[str | ConstraintFrame],
    key: jax.Array,
    *,
    durations: float | Sequence[float] = 5.0,
    pause: bool = True,
    batch: int = 1,
    first: int = 0,
    dt: float = 0.05,
    excitation: str | Excitation = "exciting",
    spread: tuple[float, float] = (0.0, 0.0),
    imperfections: Imperfections = Imperfections(),  # noqa: B008
    arm: str | Arm = PANDA,
    start: "ArrayLike | None" = None,
) -> SequenceDemonstration:
    """Simulate a hand that guides the arm under several constraints, one after the other.

    Constraints are labels or names of the catalogue, placed near the TCP as in :func:`frame_on_arm`, with
    "unconstrained" for an approach or a release; or frames, which are used without change. Each constraint
    becomes active at the last pose of the previous stage. Velocities along its constrained axes then stop, as
    in an impact with a surface. With ``pause``, the hand comes to rest before each change, and at the end.

    All stages use the program of :func:`demonstrate`, with the number of samples of the longest stage. Its
    options apply to every stage, with another grip and other phases. ``durations`` (s) is one number, or one
    per stage. A KeyError is raised for an unknown constraint, a ValueError for an unknown name, unusable
    numbers or shapes, no constraints, or a wrong number of durations.
    """
    arm = find_arm(arm)
    each = each_duration(constraints, durations)
    if not callable(excitation) and excitation not in guide.EXCITATIONS:
        raise ValueError(f"Unknown excitation {excitation!r}; choose from {', '.join(guide.EXCITATIONS)}.")
    if batch < 1:
        raise ValueError(f"batch must be at least 1, not {batch}.")
    if first < 0:
        raise ValueError(f"first must be at least 0, not {first}.")
    if np.shape(spread) != (2,):
        raise ValueError(f"spread must be two numbers, rad and m, not {spread!r}.")
    check_imperfections(imperfections)
    if start is not None and np.shape(start) not in ((7,), (batch, 7)):
        raise ValueError(f"start must have shape (7,) or ({batch}, 7), not {np.shape(start)}.")
    counts = [sampling(duration, dt).samples for duration in each]
    options: Any = {"steps": sampling(max(each), dt), "excitation": excitation, "arm": arm}
    numbers = jnp.asarray(first + np.arange(batch), dtype=jnp.uint32)
    dtype = constraints[0].position.dtype if isinstance(constraints[0], ConstraintFrame) else float
    joints = jnp.broadcast_to(arm.start(start, dtype), (batch, 7))
    velocity, stages = jnp.zeros_like(joints), []
    for stage, (constraint, count) in enumerate(zip(constraints, counts, strict=True)):
        own = jax.random.fold_in(key, stage) if stage else key
        truth = scatter(frame_on_arm(constraint, arm, start=joints), own, numbers, joints, spread, arm)
        frame = frame_arrays(truth)
        velocity = guide.impact_velocity(frame, joints, velocity, arm=arm) if stage else velocity
        end = jnp.asarray(count * dt - _SETTLE if pause else jnp.inf, dtype=dtype)
        track = guide.run_guided(frame, own, numbers, joints, velocity, end, imperfections, **options)
        track = jax.tree.map(lambda leaf, stop=count + 1: leaf[:, :stop], track)
        joints, velocity = track.joints[:, -1], track.velocity[:, -1]
        stages.append((track, truth))
    # the common pose of two stages appears once
    path = jnp.concatenate([track.joints[:, i > 0 :] for i, (track, _) in enumerate(stages)], axis=1)
    poses, exact = guide.record(path, key, numbers, imperfections, arm=arm)
    times, compliance = dt * jnp.arange(path.shape[1], dtype=dtype), compliance_of(imperfections, dtype)
    done = tuple(
        Demonstration(
            times=times[: b - a + 1],
            poses=poses[:, a : b + 1],
            exact_poses=exact[:, a : b + 1],
            joint_positions=track.joints,
            joint_velocities=track.velocity,
            truth=truth,
            reaction=track.force,
            slip=track.slip,
            status_code=rollout_status(track, frame_arrays(truth).free, compliance, arm),
        )
        for (track, truth), (a, b) in zip(stages, pairwise(np.cumsum([0, *counts]).tolist()), strict=True)
    )
    return SequenceDemonstration(times, poses, exact, path, done)


def sampling(duration: float, dt: float) -> Steps:
    """Divide a duration, s, into samples, and the sample time, s, into steps of at most 0.01 s."""
    if not (0 < dt <= duration < math.inf):
        raise ValueError(f"Expected 0 < dt <= duration; found a dt of {dt:g} s in {duration:g} s.")
    substeps = math.ceil(dt / _LONGEST - 1e-6)
    return Steps(round(duration / dt), substeps, dt / substeps)


def scatter(
    frame: ConstraintFrame, key: jax.Array, numbers: jax.Array, joints: jax.Array, spread: ArrayLike, arm: Arm
) -> ConstraintFrame:
    """Give each demonstration a geometry (N, 3), with randomly turned axes and a randomly shifted origin."""
    batch = len(numbers)
    for name in ("angular_rotvec", "linear_rotvec", "position"):
        shape = getattr(frame, name).shape
        if shape not in ((3,), (batch, 3)):
            raise ValueError(f"{name} of the constraint must have shape (3,) or ({batch}, 3), not {shape}.")
    frame = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (batch, 3)), frame)
    if not any(np.ravel(spread)):
        return frame
    keys, dtype = guide.demonstration_keys(key, numbers)[:, 0], joints.dtype
    random = jax.vmap(lambda key: jax.random.normal(key, (2, 3), dtype))(keys)
    turn, shift = jnp.moveaxis(jnp.asarray(spread, dtype=dtype)[None, :, None] * random, 1, 0)
    return move_frame(frame, rotations.rotation_exp(turn), shift, forward_kinematics(joints, arm)[0])

"""Simulate demonstrations of tasks with several constraints: approach, contact, motion, release."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.located import frame_arrays
from reframe_jax.simulation.arm.demonstration import (
    Demonstration,
    assemble,
    check_demonstration,
    frame_on_arm,
    sampling,
    scatter,
)
from reframe_jax.simulation.arm.guide import Guide
from reframe_jax.simulation.arm.guided import Plan, impact_velocity, record, run_guided
from reframe_jax.simulation.arm.imperfections import Imperfections
from reframe_jax.simulation.arm.model import PANDA, Arm, find_arm
from reframe_jax.simulation.sequences import each_duration
from reframe_jax.simulation.synthetic import Excitation

_SETTLE = 0.4  # s, time that the tool needs to come to rest after the hand


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SequenceDemonstration:
    """A batch of demonstrations of a task with several constraints; slice it like an array.

    Attributes:
        times: (K+1,) s, times of the whole task.
        poses: (N, K+1, 4, 4) m, recorded poses of {b} in {g}, with the errors of the robot.
        exact_poses: (N, K+1, 4, 4) m, the true poses.
        joint_positions: (N, K+1, 7) rad.
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
        stages = tuple(stage[index] for stage in self.stages)
        arrays = self.poses[index], self.exact_poses[index], self.joint_positions[index]
        return SequenceDemonstration(self.times, *arrays, stages)

    @property
    def boundaries(self) -> tuple[int, ...]:
        """Index of the first pose of each stage after the first; this pose obeys both constraints."""
        ends = np.cumsum([len(stage.times) - 1 for stage in self.stages])
        return tuple(int(end) for end in ends[:-1])

    @property
    def truths(self) -> tuple[ConstraintFrame, ...]:
        """The true constraint of each stage."""
        return tuple(stage.truth for stage in self.stages)

    @property
    def status_code(self) -> jax.Array:
        """(N,) int, the worst :class:`RolloutStatus` of all stages."""
        return jnp.max(jnp.stack([stage.status_code for stage in self.stages]), axis=0)


def demonstrate_sequence(
    constraints: Sequence[str | ConstraintFrame],
    key: jax.Array,
    *,
    batch: int = 1,
    first: int = 0,
    durations: float | Sequence[float] = 5.0,
    dt: float = 0.05,
    step: float | None = None,
    excitation: str | Excitation = "exciting",
    pause: bool = True,
    spread: tuple[float, float] = (0.0, 0.0),
    guide: Guide = Guide(),  # noqa: B008
    imperfections: Imperfections = Imperfections(),  # noqa: B008
    arm: str | Arm = PANDA,
    start: ArrayLike | None = None,
) -> SequenceDemonstration:
    """Simulate a hand that guides the arm under several constraints, one after the other.

    Constraints are labels or names of the catalogue, placed near the TCP as in :func:`frame_on_arm`, with
    "unconstrained" for an approach or a release; or frames, which are used without change. Each constraint
    becomes active at the last pose of the previous stage. Velocities along its constrained axes then stop, as
    in an impact with a surface. With ``pause``, the hand comes to rest before each change, and at the end.

    All stages use the program of :func:`reframe_jax.simulation.arm.demonstrate`, with the number of samples
    of the longest stage. Its options apply to every stage, with another grip and other phases. ``durations``
    (s) is one number, or one per stage.

    Raises:
        KeyError: for an unknown constraint.
        ValueError: for an unknown name, unusable numbers or shapes, no constraints, or a wrong number of
            durations.
    """
    arm = find_arm(arm)
    each = each_duration(constraints, durations)
    check_demonstration(batch, first, excitation, spread, guide, imperfections, start)
    counts = [sampling(duration, dt, step).samples for duration in each]
    plan = Plan(sampling(max(each), dt, step), excitation, arm)
    joints = jnp.broadcast_to(arm.start(start, float), (batch, 7))
    velocity = jnp.zeros_like(joints)
    numbers = jnp.asarray(first + np.arange(batch), dtype=jnp.uint32)
    options = guide, imperfections
    stages = []
    for stage, (constraint, count) in enumerate(zip(constraints, counts, strict=True)):
        own = jax.random.fold_in(key, stage)
        truth = scatter(frame_on_arm(constraint, arm, start=joints), own, numbers, joints, spread, arm)
        frame = frame_arrays(truth)
        velocity = impact_velocity(frame, joints, velocity, arm=arm)
        end = jnp.asarray(count * dt - _SETTLE if pause else jnp.inf, dtype=joints.dtype)
        track = run_guided(frame, own, numbers, joints, velocity, end, *options, plan=plan)
        track = jax.tree.map(lambda leaf, stop=count + 1: leaf[:, :stop], track)
        joints, velocity = track.joints[:, -1], track.velocity[:, -1]
        stages.append((track, truth))
    # the common pose of two stages appears once
    parts = [track.joints[:, index > 0 :] for index, (track, _) in enumerate(stages)]
    path = jnp.concatenate(parts, axis=1)
    poses, exact = record(path, key, numbers, imperfections, arm=arm)
    times = dt * jnp.arange(path.shape[1], dtype=path.dtype)
    done = tuple(
        assemble(*stage, times[: b - a + 1], poses[:, a : b + 1], exact[:, a : b + 1], imperfections, arm)
        for stage, (a, b) in zip(stages, pairwise(np.cumsum([0, *counts]).tolist()), strict=True)
    )
    return SequenceDemonstration(times, poses, exact, path, done)

"""Simulate demonstrations of tasks with several constraints: approach, contact, motion, release."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.located import frame_arrays, place_frame
from reframe_jax.simulation.arm.demonstration import (
    ORIGIN,
    Demonstration,
    check_demonstration,
    sampling,
    scatter,
)
from reframe_jax.simulation.arm.guide import Guide
from reframe_jax.simulation.arm.guided import (
    Onset,
    Plan,
    compliance_of,
    demonstration_keys,
    impact_velocity,
    run_guided,
)
from reframe_jax.simulation.arm.imperfections import Imperfections, measure
from reframe_jax.simulation.arm.model import PANDA, Arm, find_arm, forward_kinematics
from reframe_jax.simulation.arm.rollout import Track
from reframe_jax.simulation.arm.status import rollout_status
from reframe_jax.simulation.synthetic import Excitation

__all__ = ["SequenceDemonstration", "demonstrate_sequence"]

_SETTLE = 0.4  # s, time that the tool needs to come to rest after the hand


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SequenceDemonstration:
    """A batch of demonstrations of a task with several constraints; slice it like an array.

    Attributes:
        times: (K+1,) s, times of the whole task.
        poses: (N, K+1, 4, 4) m, recorded poses of {b} in {g}, with the errors of the robot.
        stages: one demonstration per constraint. The first pose of a stage equals the last pose of the
            previous stage. The ``times`` of each stage start at 0.
    """

    times: jax.Array
    poses: jax.Array
    stages: tuple[Demonstration, ...]

    def __getitem__(self, index: int | slice | np.ndarray | jax.Array) -> "SequenceDemonstration":
        """Select demonstrations; a single index removes the batch axis."""
        return SequenceDemonstration(
            self.times, self.poses[index], tuple(stage[index] for stage in self.stages)
        )

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
    def exact_poses(self) -> jax.Array:
        """(N, K+1, 4, 4) m, the true poses of the whole task."""
        return _join_stages([stage.exact_poses for stage in self.stages], axis=-3)

    @property
    def joint_positions(self) -> jax.Array:
        """(N, K+1, 7) rad, joint positions of the whole task."""
        return _join_stages([stage.joint_positions for stage in self.stages], axis=-2)

    @property
    def status_code(self) -> jax.Array:
        """(N,) int, the worst :class:`RolloutStatus` of all stages."""
        return jnp.max(jnp.stack([stage.status_code for stage in self.stages]), axis=0)


def _join_stages(parts: Sequence[jax.Array], axis: int) -> jax.Array:
    """Concatenate the stages; the common pose of two stages appears once."""
    later = [jax.lax.slice_in_dim(part, 1, part.shape[axis], axis=axis) for part in parts[1:]]
    return jnp.concatenate([parts[0], *later], axis=axis)


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
    each = [durations] * len(constraints) if isinstance(durations, int | float) else list(durations)
    if not constraints or len(each) != len(constraints):
        raise ValueError(
            "demonstrate_sequence needs constraints, and one duration or one per constraint; got "
            f"{len(constraints)} constraints and {len(each)} durations."
        )
    check_demonstration(batch, first, excitation, spread, guide, imperfections, start)
    counts = [sampling(duration, dt, step).samples for duration in each]
    plan = Plan(sampling(max(each), dt, step), dt, excitation, arm)
    joints = jnp.broadcast_to(arm.start(start, float), (batch, 7))
    velocity = jnp.zeros_like(joints)
    numbers = jnp.asarray(first + np.arange(batch), dtype=jnp.uint32)
    stages: list[Demonstration] = []
    for stage, (constraint, count) in enumerate(zip(constraints, counts, strict=True)):
        own = jax.random.fold_in(key, stage)
        frame = _placed(constraint, joints, arm)
        arrays = frame_arrays(frame)
        if any(spread):
            frame, arrays = scatter(frame, own, numbers, joints, spread, arm)
        end = jnp.asarray(count * dt - _SETTLE if pause else jnp.inf, dtype=joints.dtype)
        onset = Onset(joints, impact_velocity(arrays, joints, velocity, arm=arm), end)
        made = run_guided(arrays, own, numbers, onset, guide, imperfections, plan=plan)
        stages.append(_truncate_stage(made, frame, count, imperfections, arm))
        joints, velocity = stages[-1].joint_positions[:, -1], stages[-1].joint_velocities[:, -1]
    joints = _join_stages([stage.joint_positions for stage in stages], axis=1)
    poses = _record(joints, demonstration_keys(key, numbers)[:, 3], imperfections, arm=arm)
    edges = np.cumsum([0, *counts])
    stages = [
        replace(stage, poses=poses[:, a : b + 1])
        for stage, a, b in zip(stages, edges[:-1], edges[1:], strict=True)
    ]
    return SequenceDemonstration(dt * jnp.arange(edges[-1] + 1, dtype=poses.dtype), poses, tuple(stages))


def _placed(constraint: str | ConstraintFrame, joints: jax.Array, arm: Arm) -> ConstraintFrame:
    """A constraint with geometry (N, 3); a named constraint is placed near the TCP of each arm."""
    if isinstance(constraint, ConstraintFrame):
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(joints), 3)), constraint)
    if not isinstance(constraint, str):
        raise ValueError(f"A constraint must be a label, a name or a ConstraintFrame, not {constraint!r}.")
    frame = ConstraintFrame.named(constraint)
    rotation, position = forward_kinematics(joints, arm)
    place = partial(place_frame, frame, jnp.eye(3, dtype=joints.dtype))
    return jax.vmap(place)(position + jnp.asarray(ORIGIN, dtype=joints.dtype)[None], rotation, position)


def _truncate_stage(
    made: dict[str, jax.Array], truth: ConstraintFrame, count: int, imperfections: Imperfections, arm: Arm
) -> Demonstration:
    """Truncate a stage to its first samples, and compute its status from these samples."""
    kept = {
        name: made[name][:, : count + 1]
        for name in ("poses", "exact_poses", "joint_positions", "joint_velocities", "reaction", "slip")
    }
    track = Track(kept["joint_positions"], kept["joint_velocities"], kept["slip"], kept["reaction"])
    compliance = compliance_of(imperfections, track.joints.dtype)
    margin, status = rollout_status(track, frame_arrays(truth).free, compliance, arm)
    return Demonstration(
        times=made["times"][: count + 1], truth=truth, limit_margin=margin, status_code=status, **kept
    )


@partial(jax.jit, static_argnames="arm")
def _record(joints: jax.Array, keys: jax.Array, what: Imperfections, *, arm: Arm) -> jax.Array:
    """Simulate the recorded poses (N, K+1, 4, 4) of the whole task."""
    return jax.vmap(lambda q, key: measure(q, what, key, arm))(joints, keys)

"""Reproduce tasks with several constraints: consecutive stages, each in a separate control frame."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np

from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.identification.results import Identification
from reframe_jax.segmentation.results import Segmentation
from reframe_jax.simulation.arm.model import PANDA, Arm
from reframe_jax.simulation.reproduction.controllers import Controller, constant_wrench
from reframe_jax.simulation.reproduction.trials import Task, Trials, reproduce

_TASK = Task()


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

    @property
    def times(self) -> np.ndarray:
        """(N,) s, times of all stages; the common pose of two stages appears once."""
        ends = np.cumsum([0.0, *(float(stage.times[-1]) for stage in self.stages)])
        each = [np.asarray(s.times)[i > 0 :] + ends[i] for i, s in enumerate(self.stages)]
        return np.concatenate(each)

    @property
    def poses(self) -> np.ndarray:
        """(N, 4, 4) m, poses of all stages; the common pose of two stages appears once."""
        return np.concatenate([np.asarray(s.poses)[i > 0 :] for i, s in enumerate(self.stages)])


def reproduce_sequence(
    truths: Sequence[ConstraintFrame],
    frames: Segmentation | Sequence[Identification | ConstraintFrame],
    *,
    controller: Controller = constant_wrench(),  # noqa: B008
    task: Task = _TASK,
    arm: str | Arm = PANDA,
    compliance: tuple[float, float] = (0.0, 0.0),
) -> SequenceTrial:
    """Reproduce a task with several constraints; each stage starts at the end of the previous stage.

    A stage moves from end-stop to end-stop, see :func:`reframe_jax.simulation.reproduction.reproduce`, whose
    options apply. Each stage starts at rest: the next true constraint, with geometry (3,), becomes active at
    the current pose of the tool, and the control frame is located at this pose. A stage that does not reach
    its end-stop ends the task. ``frames`` is a segmentation, whose moving segments are the stages, or one
    identification or constraint frame per stage, with geometry (3,).

    Raises:
        ValueError: for an unknown robot, no stages, different numbers of stages, or a segment without
            identification.
    """
    control = _identified(frames) if isinstance(frames, Segmentation) else list(frames)
    if not truths or len(truths) != len(control):
        raise ValueError(
            f"reproduce_sequence needs a frame for each constraint; got {len(truths)} constraints and "
            f"{len(control)} frames."
        )
    stages: list[Trials] = []
    for truth, frame in zip(truths, control, strict=True):
        if stages:
            task = replace(task, start=tuple(float(q) for q in stages[-1].joint_positions[-1]))
        pair = jax.tree.map(lambda leaf: leaf[None], (truth, frame))
        one = reproduce(*pair, controller=controller, task=task, arm=arm, compliance=compliance)
        stages.append(one[0])
        if not bool(stages[-1].completed):
            break
    forces = [np.linalg.norm(np.asarray(s.reaction)[:, 3:], axis=1) for s in stages[1:]]
    return SequenceTrial(
        stages=tuple(stages),
        completed=len(stages) == len(truths) and bool(stages[-1].completed),
        hand_overs=np.array([f[: max(1, len(f) // 10)].max() for f in forces]),
    )


def _identified(found: Segmentation) -> list[Identification]:
    """Identifications of the moving segments."""
    each = [segment.identification for segment in found.moving]
    if any(one is None for one in each):
        raise ValueError("A segment is too short to identify, so it has no control frame.")
    return [one for one in each if one is not None]

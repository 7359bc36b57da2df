"""Tasks of several constraints: one stage after the other, each in its own frame."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import jax
import numpy as np

from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.identification.results import Identification
from reframe_jax.segmentation.results import Segmentation
from reframe_jax.simulation.arm.model import PANDA, Arm
from reframe_jax.simulation.reproduction.controllers import Controller, constant_wrench
from reframe_jax.simulation.reproduction.trials import Task, Trials, reproduce

__all__ = ["SequenceTrial", "reproduce_sequence"]

_Frame = TypeVar("_Frame", bound=Identification | ConstraintFrame)
_TASK = Task()


@dataclass(frozen=True)
class SequenceTrial:
    """A task of several constraints, reproduced.

    Attributes:
        stages: the trial of each constraint, without batch axis. They end with the first that did not arrive.
        completed: whether all stages arrived.
        hand_overs: (S-1,) N, the largest reaction force in the first tenth of each stage but the first.
    """

    stages: tuple[Trials, ...]
    completed: bool
    hand_overs: np.ndarray

    @property
    def times(self) -> np.ndarray:
        """(N,) s, of all stages in a row; the pose of each hand-over comes once."""
        ends = np.cumsum([0.0, *(float(stage.times[-1]) for stage in self.stages)])
        each = [np.asarray(s.times)[i > 0 :] + ends[i] for i, s in enumerate(self.stages)]
        return np.concatenate(each)

    @property
    def poses(self) -> np.ndarray:
        """(N, 4, 4) m, of all stages in a row."""
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
    """Play a task of several constraints: each stage in its frame, from where the one before ended.

    A stage moves from end-stop to end-stop, see
    :func:`reframe_jax.simulation.reproduction.reproduce`. The hand-over is at rest: the next constraint takes
    hold of the tool where it is, and the control frame is located at that pose. A stage that does not arrive
    ends the task.

    Args:
        truths: the true constraint of each stage, with geometry (3,).
        frames: the frames to control in: a segmentation, whose moving segments are the stages, or as many
            identifications or constraint frames, with geometry (3,).
        controller: the wrenches of all stages.
        task: the end-stops and the duration of each stage; its start is that of the first.
        arm: the robot.
        compliance: rad/(N m) and m/N, of tool and mount.

    Raises:
        ValueError: for an unknown robot, no stages, numbers of stages that differ, or a segment without
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
        one = reproduce(
            _batch_of_one(truth),
            _batch_of_one(frame),
            controller=controller,
            task=task,
            arm=arm,
            compliance=compliance,
        )
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
        raise ValueError("A segment is too short to identify: there is no frame to control in.")
    return [one for one in each if one is not None]


def _batch_of_one(frame: _Frame) -> _Frame:
    batch: _Frame = jax.tree.map(lambda leaf: leaf[None], frame)
    return batch

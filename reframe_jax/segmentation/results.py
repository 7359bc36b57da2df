"""What segmentation returns."""

from dataclasses import dataclass

import jax
import numpy as np

from reframe_jax.identification.results import Identification

__all__ = ["Boundary", "Segment", "Segmentation"]


@dataclass(frozen=True)
class Boundary:
    """Where one segment ends and the next begins.

    Attributes:
        index: of the first pose of the next segment.
        time: s, of that pose.
        probability: that the two segments do not belong together.
        earliest, latest: between the poses of these indices the constraint changes with a probability of
            95 %.
    """

    index: int
    time: float
    probability: float
    earliest: int
    latest: int


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Segment:
    """Part of a recording in which one constraint holds, or the body is still.

    Attributes:
        start: index of its first pose.
        stop: index behind its last pose.
        label: number of its constraint, counted in order of appearance from 0; the same number where the same
            constraint comes back. -1 where the body is still.
        identification: of its poses; None where the body is still, and for parts too short to identify.
    """

    start: int
    stop: int
    label: int
    identification: Identification | None

    @property
    def resting(self) -> bool:
        """Whether the body is still."""
        return self.label < 0

    @property
    def name(self) -> str:
        """Name of the constraint; "Still", or "Too short to identify"."""
        if self.identification is None:
            return "Still" if self.resting else "Too short to identify"
        return str(self.identification.name)


@dataclass(frozen=True)
class Segmentation:
    """The sequence of constraints in a recording.

    Attributes:
        segments: in order of time; together they hold every pose of the recording once.
        boundaries: between each segment and the next.
        times: (N,) s, of the poses.
        motion_time: s, in which the motion gives one independent value. A held axis needs six of them to be
            distinguished from free motion, a spherical joint two.
    """

    segments: tuple[Segment, ...]
    boundaries: tuple[Boundary, ...]
    times: np.ndarray
    motion_time: float

    def __len__(self) -> int:
        """Number of segments."""
        return len(self.segments)

    @property
    def moving(self) -> tuple[Segment, ...]:
        """Segments in which the body is not still."""
        return tuple(segment for segment in self.segments if not segment.resting)

    @property
    def labels(self) -> np.ndarray:
        """(N,) label of each pose, -1 where the body is still."""
        return np.repeat([s.label for s in self.segments], [s.stop - s.start for s in self.segments])

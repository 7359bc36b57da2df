"""Result types of segmentation."""

from dataclasses import dataclass

import jax
import numpy as np

from reframe_jax.identification.results import Identification

__all__ = ["Boundary", "Segment", "Segmentation"]


@dataclass(frozen=True)
class Boundary:
    """The boundary between two segments.

    Attributes:
        index: index of the first pose of the next segment.
        time: s, time of this pose.
        probability: probability that the two segments have different constraints.
        earliest, latest: indices of poses, bounds of the 95 % interval of the boundary.
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
        start: index of the first pose.
        stop: index after the last pose.
        label: number of the constraint, from 0 in order of appearance. Segments with the same constraint have
            the same number; -1 where the body is still.
        identification: identification of the poses of the segment; None where the body is still, and for a
            segment that is too short.
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
        """Name of the constraint, or "Still", or "Too short to identify"."""
        if self.identification is None:
            return "Still" if self.resting else "Too short to identify"
        return str(self.identification.name)


@dataclass(frozen=True)
class Segmentation:
    """The sequence of constraints in a recording.

    Attributes:
        segments: segments in order of time; every pose of the recording is in exactly one segment.
        boundaries: boundaries between each segment and the next.
        times: (N,) s, times of the poses.
        motion_time: s, time after which values of the motion are decorrelated. A segment must last six motion
            times to distinguish a constrained axis from free motion, two for a spherical joint.
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

"""Results of a segmentation."""

from dataclasses import dataclass

import numpy as np

from reframe_jax.identification.results import Identification


@dataclass(frozen=True)
class Boundary:
    """Boundary between a segment and the next segment.

    Attributes:
        index: index of the first pose of the second segment.
        time: sample time of this pose, s.
        probability: probability that the two segments have different constraints.
        earliest, latest: indices of the first and the last pose of the 95 % interval of the change.
    """

    index: int
    time: float
    probability: float
    earliest: int
    latest: int


@dataclass(frozen=True)
class Segment:
    """Part of a recording with one constraint, or with a still body.

    Attributes:
        start: index of the first pose.
        stop: index after the last pose.
        label: number of the constraint, from 0 in order of appearance. Segments with the same constraint have
            the same label; a still body has the label -1.
        identification: identification of the poses; None for a still body, for segments that are too
            short, and for those without a result.
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
        """Name of the constraint; "Still", or "Not identified" if there is no identification."""
        if self.identification is None:
            return "Still" if self.resting else "Not identified"
        return str(self.identification.name)


@dataclass(frozen=True)
class Segmentation:
    """The sequence of constraints in a recording.

    Attributes:
        segments: segments in order of time; each pose belongs to one segment.
        boundaries: boundaries between consecutive segments.
        times: (N,) sample times of the poses, s.
        motion_time: time after which displacements are decorrelated, s. To distinguish one constrained axis
            from free motion, a segment must last about six motion times; a spherical joint needs about two.
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
        """(N,) label of each pose; -1 for a still body."""
        return np.repeat([s.label for s in self.segments], [s.stop - s.start for s in self.segments])

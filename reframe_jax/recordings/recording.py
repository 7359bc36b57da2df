"""The recording, and the error of an unusable file."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

__all__ = ["Recording", "RecordingError"]


class RecordingError(ValueError):
    """A file that cannot be used as a recording."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Poses of a body {b} in the ground {g} over time.

    Attributes:
        times: (K+1,) s, increasing, not necessarily evenly.
        poses: (K+1, 4, 4), m.
        path: file that it was read from.
        notes: sentences about what was dropped, repaired or looks odd.
        origin: time at which ``times`` are 0, in s, as the file writes it; None if the file says 0. Times
            that start late, such as those since 1970, count from their first sample.
        wrenches: (K+1, 6) force in N, then torque in Nm, if the file has them, else None. They are the
            numbers of the file, in the frame of the sensor and about its origin: nothing is transformed.
            NaN where a number is missing.
    """

    times: np.ndarray
    poses: np.ndarray
    path: Path
    notes: tuple[str, ...] = ()
    origin: str | None = None
    wrenches: np.ndarray | None = None

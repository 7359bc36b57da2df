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
    """

    times: np.ndarray
    poses: np.ndarray
    path: Path
    notes: tuple[str, ...] = ()

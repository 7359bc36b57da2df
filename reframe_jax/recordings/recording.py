"""Recordings, the rows that readers left out, and the error for unusable files."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

_OUTLIER = "the pose jumps away from its neighbours and back"


class RecordingError(ValueError):
    """A file cannot be used as a recording."""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Rows of a file that are not in the recording.

    Attributes:
        rows: (N,) int, numbers of the rows, counted as in :attr:`Recording.rows`.
        reason: one word: "missing" (a number is missing), "untracked" (the system reports it, or writes
            zeros), "origin", "identity", "constant", "frozen" or "end" (tracking was lost, see
            :func:`reframe_jax.recordings.lost.find_lost_poses`), "repeated" (equals the previous row),
            "equal_time" (another pose at the same time), "far" (too distant from the other positions),
            "relative" (the other body was not tracked), "outlier" (read, but left out of an identification).
        why: the reason in words.
    """

    rows: np.ndarray
    reason: str
    why: str


@dataclass(frozen=True, eq=False)
class Recording:
    """Poses of a body {b} in the ground {g} over time.

    Attributes:
        times: (K+1,) s, increasing; steps may differ.
        poses: (K+1, 4, 4), m.
        path: the file.
        notes: sentences about rows that were left out, repairs and doubts.
        origin: clock time in s at which ``times`` are 0, as written in the file; None if it is 0. Times since
            1970 and other late times count from the first sample.
        wrenches: (K+1, 6) force in N, then torque in Nm, in the frame of the sensor and about its origin, as
            in the file. NaN where a number is missing. None if the file has no wrenches.
        rows: (K+1,) int, row of each pose in the file: lines count from 1, samples and messages from 0. None
            if the poses are from no file.
        row_word: name of a row: line, sample, message or frame.
        left_out: rows of the file that were left out, with the reasons.
    """

    times: np.ndarray
    poses: np.ndarray
    path: Path
    notes: tuple[str, ...] = ()
    origin: str | None = None
    wrenches: np.ndarray | None = None
    rows: np.ndarray | None = None
    row_word: str = "sample"
    left_out: tuple[LeftOut, ...] = ()

    def unused(self, counted: ArrayLike) -> tuple[LeftOut, ...]:
        """List all rows of the file that an identification did not use, with the reasons.

        Args:
            counted: (K+1,) bool, ``counted`` of the identification of these poses.

        Returns:
            ``left_out`` and the outliers. Rows count from 0 if the poses are from no file.

        Raises:
            ValueError: if the shape of ``counted`` differs from the shape of ``times``.
        """
        used = np.asarray(counted, dtype=bool)
        if used.shape != self.times.shape:
            raise ValueError(f"Expected counted of shape {self.times.shape}, not {used.shape}.")
        if used.all():
            return self.left_out
        numbers = np.arange(len(used)) if self.rows is None else self.rows
        return (*self.left_out, LeftOut(np.sort(numbers[~used]), "outlier", _OUTLIER))

    @property
    def left_out_times(self) -> np.ndarray:
        """(M,) s, times of the rows in ``left_out``, interpolated between the rows that were read."""
        if self.rows is None or not self.left_out:
            return np.empty(0)
        gone = np.sort(np.concatenate([each.rows for each in self.left_out])).astype(float)
        order = np.argsort(self.rows)
        rows, times = self.rows[order].astype(float), self.times[order]
        step = (times[-1] - times[0]) / max(rows[-1] - rows[0], 1)
        beyond = np.minimum(gone - rows[0], 0) + np.maximum(gone - rows[-1], 0)
        return np.interp(gone, rows, times) + step * beyond

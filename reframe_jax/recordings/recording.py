"""The recording, and the error of an unusable file."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["LeftOut", "Recording", "RecordingError"]

_OUTLIER = "the pose jumps away from its neighbours and back"


class RecordingError(ValueError):
    """A file that cannot be used as a recording."""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Rows of a file that are not in the recording.

    Attributes:
        rows: (N,) int, their numbers, as :attr:`Recording.rows` counts them.
        reason: one word: "missing" (a number is missing), "untracked" (the system says so, or writes zeros),
            "origin", "identity", "constant", "frozen" or "end" (tracking was lost, see
            :class:`reframe_jax.recordings.lost.LostRun`), "repeated" (the row before again), "equal_time"
            (another pose at the same time), "far" (farther away than a body can go), "relative" (the other
            body was not tracked), "outlier" (read, but left out of an identification).
        why: the reason in words.
    """

    rows: np.ndarray
    reason: str
    why: str


@dataclass(frozen=True, eq=False)
class Recording:
    """Poses of a body {b} in the ground {g} over time.

    Attributes:
        times: (K+1,) s, increasing, not necessarily evenly.
        poses: (K+1, 4, 4), m.
        path: file that it was read from.
        notes: sentences about what was left out, repaired or looks odd.
        origin: time at which ``times`` are 0, in s, as the file writes it; None if the file says 0. Times
            that start late, such as those since 1970, count from their first sample.
        wrenches: (K+1, 6) force in N, then torque in Nm, if the file has them, else None. They are the
            numbers of the file, in the frame of the sensor and about its origin: nothing is transformed.
            NaN where a number is missing.
        rows: (K+1,) int, where the poses are in the file: numbers of lines from 1, of samples and messages
            from 0; None if they are from no file.
        row_word: what the rows are called: line, sample, message or frame.
        left_out: rows of the file that were left out, and why.
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
        """All rows of the file that play no part in an identification, and why; the others were used.

        Args:
            counted: (K+1,) bool, ``counted`` of the identification of these poses.

        Returns:
            ``left_out``, and the outliers. Rows are counted from 0 if the poses are from no file.

        Raises:
            ValueError: if there are not as many as poses.
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
        """(M,) s, about when the rows in ``left_out`` were: between the rows that were read."""
        if self.rows is None or not self.left_out:
            return np.empty(0)
        gone = np.sort(np.concatenate([each.rows for each in self.left_out])).astype(float)
        order = np.argsort(self.rows)
        rows, times = self.rows[order].astype(float), self.times[order]
        step = (times[-1] - times[0]) / max(rows[-1] - rows[0], 1)
        beyond = np.minimum(gone - rows[0], 0) + np.maximum(gone - rows[-1], 0)
        found: np.ndarray = np.interp(gone, rows, times) + step * beyond
        return found

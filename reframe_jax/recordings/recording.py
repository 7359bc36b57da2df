"""Recordings, the rows of numbers from which they are made (the result of every reader), and their errors."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.geometry.numpy_rotations import euler_matrices, rotation_matrices

HEADER = "t,x,y,z,qx,qy,qz,qw"
MOST_ROWS = 2**23  # 8,388,608: the poses take 1 GiB
EPOCH = 1e6  # s: times that start later count from the first sample
_PATH = 0.1  # median step of a path, as a fraction of the spread of its positions
_RANGES = 4  # ranges of rows in a sentence
_OUTLIER = "the pose jumps away from its neighbours and back"


class RecordingError(ValueError):
    """A file cannot be used as a recording."""


@contextmanager
def writing(out: Path) -> Iterator[None]:
    """Raise a RecordingError that names the file ``out`` if a block raises an OSError."""
    try:
        yield
    except OSError as error:
        raise RecordingError(f"{out}: cannot be written: {error.strerror}.") from error


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Rows of a file that are not in the recording.

    The reason is one word: "missing" (a number is missing), "untracked" (the system reports it, or writes
    zeros), "origin", "identity", "constant", "frozen" or "end" (tracking was lost, see
    :func:`reframe_jax.recordings.lost.find_lost_poses`), "repeated" (equals the previous row), "equal_time"
    (another pose at the same time), "far" (too distant from the other positions), "relative" (the other body
    was not tracked), "outlier" (read, but left out of an identification).
    """

    rows: np.ndarray  # (N,) int, numbers of the rows, counted as in :attr:`Recording.rows`
    reason: str
    why: str  # the reason in words


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
        """List all rows that an identification did not use, with the reasons: ``left_out`` and the outliers.

        The argument (K+1,) bool is ``counted`` of the identification of these poses; another shape raises a
        ValueError. Rows count from 0 if the poses are from no file.
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


@dataclass(frozen=True)
class AngleTriples:
    """Orientations as three numbers."""

    numbers: np.ndarray  # (N, 3), in the unit of the file
    unit: float  # this unit in rad, as it was read
    convention: str  # "vector", or the order of the axes, as the option ``angles``
    by_axis: bool  # whether the numbers are those of x, y, z, and not in the order of the convention
    stated: bool  # whether the file states the unit

    def __getitem__(self, rows: np.ndarray) -> "AngleTriples":
        return replace(self, numbers=self.numbers[rows])

    def matrices(self, convention: str | None = None, unit: float | None = None) -> np.ndarray:
        """Convert to rotation matrices (N, 3, 3), perhaps by another convention or with another unit."""
        convention, numbers = convention or self.convention, (unit or self.unit) * self.numbers
        if convention == "vector":
            return rotation_matrices(numbers)
        if self.by_axis:
            numbers = numbers[:, ["xyz".index(axis) for axis in convention.lower()]]
        return euler_matrices(convention, numbers)


@dataclass
class Rows:
    """Rows of a file before the checks.

    The values are (N, 7) positions and quaternions x y z w, or (N, 12) or (N, 16) matrices, row by row, with
    lengths in the unit of the file; NaN where a number or a time is missing.
    """

    path: Path
    word: str  # name of a row: line, sample, message or frame
    where: np.ndarray  # (N,) int, numbers of the rows
    values: np.ndarray
    times: np.ndarray | None  # (N,); None if the file has no times
    origin: str | None = None  # time at which ``times`` are 0, as written in the file; None if it is 0
    notes: list[str] = field(default_factory=list)  # sentences about rows left out, repairs and doubts
    wrenches: np.ndarray | None = None  # (N, 6) as in :class:`Recording`
    metres: float | None = None  # unit of the positions in m if the file states it
    seconds: float | None = None  # unit of the times in s if the file states it
    order: Literal["xyzw", "wxyz"] = "xyzw"  # of the quaternions in the file
    angles: AngleTriples | None = None  # the orientations, if the file contains angles
    no_times: str = "give the sample time, dt (--dt)"  # remedy if the file has no times, for a message
    missing: str = "a number is missing or not finite"  # reason why numbers are missing, for a note
    frames: np.ndarray | None = None  # (N,) int, which count sample times; None if every row is one
    left_out: list[LeftOut] = field(default_factory=list)

    @property
    def positions(self) -> np.ndarray:
        """(N, 3) positions of {b} in {g}, in the unit of the file."""
        return self.values[:, :3] if self.values.shape[1] == 7 else self.values[:, [3, 7, 11]]

    def error(self, row: int, problem: str) -> RecordingError:
        """Make an error that names the file and a row (an index of ``where``)."""
        return RecordingError(f"{self.path}: {self.word} {self.where[row]}: {problem}")

    def keep(self, mask: np.ndarray, why: str, reason: str, note: str | None = None) -> None:
        """Leave out the rows outside the mask (N,), for a reason in words and in one word (:class:`LeftOut`).

        By default, the note gives the numbers of the rows and the reason.
        """
        if len(dropped := self.where[~mask]):
            self.notes.append(note or f"{name_rows(self.word, dropped)} left out: {why}.")
            self.left_out.append(LeftOut(np.sort(dropped), reason, why))
            self.take(mask)

    def count_frames(self) -> None:
        """Convert times to frame numbers, if they are whole and increase; else remove them."""
        numbers = np.empty(0) if self.times is None else self.times
        if np.isfinite(numbers).all() and (numbers % 1 == 0).all() and (np.diff(numbers) > 0).all():
            self.frames = numbers.astype(np.int64)
        self.times = self.origin = None

    def take(self, rows: np.ndarray) -> None:
        """Select rows by a mask or by indices."""
        for name in ("where", "values", "times", "wrenches", "frames", "angles"):
            numbers = getattr(self, name)
            setattr(self, name, None if numbers is None else numbers[rows])


def is_path(positions: np.ndarray) -> bool:
    """Return whether positions (N, 3) follow each other in short steps, unlike separate touches."""
    positions = positions[np.isfinite(positions).all(axis=1)]
    if len(positions) < 10:
        return False
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    steps = steps[steps > 0]
    return len(steps) > 0 and bool(np.median(steps) < _PATH * np.linalg.norm(positions.std(axis=0)))


def check_size(path: Path, count: int) -> None:
    """Refuse more rows than a recording may have, 8,388,608."""
    if count > MOST_ROWS:
        raise RecordingError(f"{path}: has more than {MOST_ROWS} rows; divide the recording into files.")


def name_rows(word: str, numbers: np.ndarray) -> str:
    """Name rows in words: "line 4", "lines 4-9, 12 (7 rows)"."""
    numbers = np.unique(numbers)
    if len(numbers) == 1:
        return f"{word} {numbers[0]}"
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    parts = [str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs]
    more = f" and {len(parts) - _RANGES} more" if len(parts) > _RANGES else ""
    count = f" ({len(numbers)} rows)" if len(numbers) > 2 else ""
    return f"{word}s {', '.join(parts[:_RANGES])}{more}{count}"


def shown(text: str, length: int = 200) -> str:
    """Quote text of a file in a message: of bounded length, without control characters."""
    cut = text if len(text) <= length else text[:length] + "..."
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in cut)


def listed(names: Sequence[str] | Iterable[str], most: int = 20) -> str:
    """List names of a file in a message, with commas; "none" if there are none."""
    first = list(islice(names, most + 1))
    return ", ".join(shown(name, 80) for name in first[:most]) + (", ..." if first[most:] else "") or "none"

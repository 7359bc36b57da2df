"""Rows of numbers on their way from a file to poses: what every reader returns."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from reframe_jax.recordings.recording import LeftOut, RecordingError

__all__ = ["EPOCH", "HEADER", "MOST_ROWS", "WRENCH_HEADER", "Rows", "is_path", "name_rows", "shown"]

HEADER = "t,x,y,z,qx,qy,qz,qw"
WRENCH_HEADER = "fx,fy,fz,tx,ty,tz"
MOST_ROWS = 2**23  # 8,388,608: their poses take 1 GiB
EPOCH = 1e6  # s: times that start later than this count from the first sample
_PATH = 0.1  # median step over the spread of the positions, below which they are a path
_LISTED = 4  # ranges of rows in a sentence


@dataclass
class Rows:
    """Rows of a file, not yet checked.

    Attributes:
        path: the file.
        word: what its rows are called: line or sample.
        where: (N,) int, the numbers of the rows.
        values: (N, 7) positions and quaternions, or (N, 12) or (N, 16) matrices, row by row; in the unit of
            the file. NaN where a number is missing.
        times: (N,), or None if the file has none. NaN where one is missing.
        origin: the time that ``times`` count from, as the file writes it; None if that is 0.
        notes: sentences about what was left out, repaired or looks odd.
        wrenches: (N, 6) force in N and torque in Nm, as :class:`Recording` has them, or None.
        metres: length of the unit of the positions if the file states it, else None.
        seconds: length of the unit of the times if the file states it, else None.
        order: order in which the file holds quaternions, which ``values`` has as x y z w.
        angles: (N, 3) angles of the orientations, if the file does not state their unit, else None.
        no_times: what gives the times where the file has none, for a message.
        missing: why numbers of a row are missing, for a note.
        frames: (N,) int, numbers of the frames, which count sample times; None if every row is one.
        left_out: rows that were left out.
    """

    path: Path
    word: str
    where: np.ndarray
    values: np.ndarray
    times: np.ndarray | None
    origin: str | None = None
    notes: list[str] = field(default_factory=list)
    wrenches: np.ndarray | None = None
    metres: float | None = None
    seconds: float | None = None
    order: Literal["xyzw", "wxyz"] = "xyzw"
    angles: np.ndarray | None = None
    no_times: str = "give the sample time, dt (--dt)"
    missing: str = "a number is missing or not finite"
    frames: np.ndarray | None = None
    left_out: list[LeftOut] = field(default_factory=list)

    @property
    def positions(self) -> np.ndarray:
        """(N, 3), in the unit of the file."""
        return self.values[:, :3] if self.values.shape[1] == 7 else self.values[:, [3, 7, 11]]

    def error(self, row: int, problem: str) -> RecordingError:
        """What is wrong with a row."""
        return RecordingError(f"{self.path}: {self.word} {self.where[row]}: {problem}")

    def keep(self, mask: np.ndarray, why: str, reason: str, note: str | None = None) -> None:
        """Leave out the rows outside the mask (N,).

        Args:
            mask: rows that stay.
            why: the reason in words, which the note gives after the rows.
            reason: the same in one word, of those of :class:`LeftOut`.
            note: another sentence for it.
        """
        dropped = self.where[~mask]
        if not len(dropped):
            return
        self.notes.append(note or f"{name_rows(self.word, dropped)} left out: {why}.")
        self.left_out.append(LeftOut(np.sort(dropped), reason, why))
        self.take(mask)

    def count_frames(self) -> None:
        """Take the times as numbers of frames, which count sample times if they are whole and increase."""
        numbers = np.empty(0) if self.times is None else self.times
        if np.isfinite(numbers).all() and (numbers % 1 == 0).all() and (np.diff(numbers) > 0).all():
            self.frames = numbers.astype(np.int64)
        self.times = self.origin = None

    def take(self, rows: np.ndarray) -> None:
        """Keep some rows, of a mask or of indices, and their order."""
        for name in ("where", "values", "times", "wrenches", "frames", "angles"):
            numbers = getattr(self, name)
            setattr(self, name, None if numbers is None else numbers[rows])


def is_path(places: np.ndarray) -> bool:
    """Whether positions (N, 3) follow each other in short steps, as separate touches do not."""
    places = places[np.isfinite(places).all(axis=1)]
    if len(places) < 10:
        return False
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    steps = steps[steps > 0]
    return len(steps) > 0 and bool(np.median(steps) < _PATH * np.linalg.norm(places.std(axis=0)))


def name_rows(word: str, numbers: np.ndarray) -> str:
    """Rows in words: "line 4", "lines 4-9, 12 (7 rows)"."""
    numbers = np.unique(numbers)
    if len(numbers) == 1:
        return f"{word} {numbers[0]}"
    edges = np.flatnonzero(np.diff(numbers) > 1)
    first, last = numbers[np.append(0, edges + 1)], numbers[np.append(edges, len(numbers) - 1)]
    parts = [str(a) if a == b else f"{a}-{b}" for a, b in zip(first, last, strict=True)]
    more = f" and {len(parts) - _LISTED} more" if len(parts) > _LISTED else ""
    count = f" ({len(numbers)} rows)" if len(numbers) > 2 else ""
    return f"{word}s {', '.join(parts[:_LISTED])}{more}{count}"


def shown(text: str, length: int = 200) -> str:
    """Text of a file as a message may quote it: of bounded length, without control characters."""
    cut = text if len(text) <= length else text[:length] + "..."
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in cut)

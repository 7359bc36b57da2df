"""Rows of numbers on their way from a file to poses: what every reader returns."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from reframe_jax.recordings.recording import RecordingError

__all__ = ["EPOCH", "HEADER", "MOST_ROWS", "WRENCH_HEADER", "Rows", "shown"]

HEADER = "t,x,y,z,qx,qy,qz,qw"
WRENCH_HEADER = "fx,fy,fz,tx,ty,tz"
MOST_ROWS = 2**23  # 8,388,608: their poses take 1 GiB
EPOCH = 1e6  # s: times that start later than this count from the first sample


@dataclass
class Rows:
    """Rows of a file, not yet checked.

    Attributes:
        path: the file.
        word: what its rows are called: line or sample.
        where: (N,) int, the numbers of the rows.
        values: (N, 7) positions and quaternions, or (N, 12) or (N, 16) matrices, row by row; in the unit of
            the file. NaN where a number is missing.
        times: (N,) s, or None if the file has none. NaN where one is missing.
        origin: the time that ``times`` count from, as the file writes it; None if that is 0.
        notes: sentences about what was dropped, repaired or looks odd.
        wrenches: (N, 6) force in N and torque in Nm, as :class:`Recording` has them, or None.
        metres: length of the unit of the positions if the file states it, else None.
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

    def error(self, row: int, problem: str) -> RecordingError:
        """What is wrong with a row."""
        return RecordingError(f"{self.path}: {self.word} {self.where[row]}: {problem}")

    def keep(self, mask: np.ndarray, why: str) -> None:
        """Drop the rows outside the mask (N,), with a note."""
        dropped = self.where[~mask]
        if not len(dropped):
            return
        more = f" and {len(dropped) - 1} more" if len(dropped) > 1 else ""
        self.notes.append(f"{self.word} {dropped[0]}{more} dropped: {why}.")
        self.where, self.values = self.where[mask], self.values[mask]
        self.times = None if self.times is None else self.times[mask]
        self.wrenches = None if self.wrenches is None else self.wrenches[mask]


def shown(text: str, length: int = 200) -> str:
    """Text of a file as a message may quote it: of bounded length, without control characters."""
    cut = text if len(text) <= length else text[:length] + "..."
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in cut)

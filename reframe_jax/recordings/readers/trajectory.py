"""TUM trajectories: 8 numbers to a line, without a header, between blanks, commas or semicolons."""

import re
from pathlib import Path

from reframe_jax.recordings.readers.exports import find_delimiter, first_numbers, split, trim
from reframe_jax.recordings.readers.lines import Collector, read_lines
from reframe_jax.recordings.readers.reader import Reader
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import Rows
from reframe_jax.recordings.selection import Selection

__all__ = ["TRAJECTORY", "names_columns", "read_trajectory"]

_NO_TIMES = "of 7 numbers to a line none is a time: give the sample time, dt (--dt)"
_WITH_TIMES, _WITHOUT = 8, 7


def read_trajectory(path: Path, wanted: Selection) -> Rows:
    """Read lines of ``t x y z qx qy qz qw``, or without ``t``; ``#`` starts a comment.

    Args:
        path: the file.
        wanted: nothing of it is used here.

    Raises:
        RecordingError: if a line does not hold as many numbers as the first.
    """
    rows: Collector | None = None
    width = 0
    for number, line in read_lines(path):
        text = re.split("[#%]", line)[0].strip()
        if not text:
            continue
        cells = trim(split(text, find_delimiter(text)), max(width, _WITHOUT))
        if rows is None:
            width = len(cells)
            timed = width == _WITH_TIMES
            rows = Collector(path, width, 0 if timed else None, range(timed, width))
        rows.add(number, cells)
    if rows is None:
        raise RecordingError(f"{path}: is empty; expected lines of t x y z qx qy qz qw.")
    found = rows.rows()
    found.no_times = _NO_TIMES
    return found


def names_columns(comment: list[str], width: int) -> bool:
    """Whether the cells of a comment name so many columns of a pose."""
    return len(comment) == width and any(re.match(r"(?i)q|.*(quat|orient|rot)", cell) for cell in comment)


def _recognises(path: Path, head: bytes) -> bool:
    width, comment = first_numbers(head)
    return width in (_WITH_TIMES, _WITHOUT) and not names_columns(comment, width)


TRAJECTORY = Reader(
    name="a TUM trajectory",
    suffixes=(".txt", ".tum", ".csv", ".tsv"),
    recognises=_recognises,
    read=read_trajectory,
    options=frozenset({"unit", "time_unit", "quaternion"}),
)

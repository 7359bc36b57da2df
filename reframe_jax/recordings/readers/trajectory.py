"""TUM trajectories: 8 numbers in each line, without a header, separated by blanks, commas or semicolons."""

import re
from pathlib import Path

from reframe_jax.recordings.readers.collecting import collect_plain
from reframe_jax.recordings.readers.lines import first_numbers
from reframe_jax.recordings.readers.reader import Reader
from reframe_jax.recordings.rows import Rows
from reframe_jax.recordings.selection import Selection

__all__ = ["TRAJECTORY", "read_trajectory"]

_STARTS = {8: 1, 7: 0}  # column of x, by the count of numbers in a line
_NO_TIMES = "a line of 7 numbers contains none: give the sample time, dt (--dt)"


def read_trajectory(path: Path, wanted: Selection) -> Rows:
    """Read lines of ``t x y z qx qy qz qw``, or without ``t``; ``#`` starts a comment."""
    rows = collect_plain(path, _STARTS)
    rows.no_times = _NO_TIMES
    return rows


def _recognises(path: Path, head: bytes) -> bool:
    width, comment = first_numbers(head)
    named = len(comment) == width and any(re.match(r"(?i)q|.*(quat|orient|rot)", cell) for cell in comment)
    return width in _STARTS and not named


TRAJECTORY = Reader(
    name="a TUM trajectory",
    suffixes=(".txt", ".tum", ".csv", ".tsv"),
    recognises=_recognises,
    read=read_trajectory,
    options=frozenset({"unit", "time_unit", "quaternion"}),
)

"""KITTI trajectories: the 12 numbers of a pose matrix in each line, row by row, without times or a header.

KITTI-360 writes the frame number first; other programs write all 16 numbers, or a time first.
"""

from pathlib import Path

from reframe_jax.recordings.readers.collecting import collect_plain
from reframe_jax.recordings.readers.lines import first_numbers
from reframe_jax.recordings.readers.reader import Reader
from reframe_jax.recordings.rows import Rows
from reframe_jax.recordings.selection import Selection

__all__ = ["KITTI", "read_kitti"]

_STARTS = {12: 0, 13: 1, 16: 0, 17: 1}  # column of the matrix, by the count of numbers in a line
_NO_TIMES = "KITTI trajectories contain none: give the sample time, dt (--dt), 0.1 s for KITTI itself"


def read_kitti(path: Path, wanted: Selection) -> Rows:
    """Read lines of 12 or 16 numbers, with an optional frame number or time first; see :class:`Reader`."""
    rows = collect_plain(path, _STARTS)
    rows.no_times = _NO_TIMES
    if rows.times is not None and (rows.times % 1 == 0).all() and rows.origin is None:
        rows.count_frames()
    return rows


KITTI = Reader(
    name="a KITTI trajectory",
    suffixes=(".txt", ".csv", ".tsv", ".tum", ".kitti"),
    recognises=lambda path, head: first_numbers(head)[0] in _STARTS and not first_numbers(head)[1][12:],
    read=read_kitti,
    options=frozenset({"unit", "time_unit"}),
)

"""Trajectories: numbers in each line, without a header, separated by blanks, commas or semicolons.

TUM trajectories have 8 numbers in a line. KITTI trajectories have the 12 numbers of a pose matrix, row by row
and without times. KITTI-360 writes the frame number first. Other programs write all 16 numbers, or a time
first.

``ros2 topic echo --csv`` writes the fields of a message: seconds and nanoseconds of the stamp, the names of
one or two frames, the 7 numbers of a pose, and perhaps covariances and velocities. PoseStamped,
PoseWithCovarianceStamped and Odometry have this layout.
"""

import re
from itertools import chain
from pathlib import Path

from reframe_jax.recordings.readers.lines import (
    collect,
    find_delimiter,
    first_numbers,
    is_number,
    read_cells,
    read_lines,
    split,
    trim,
)
from reframe_jax.recordings.readers.reader import Reader
from reframe_jax.recordings.recording import RecordingError, Rows
from reframe_jax.recordings.selection import Selection

# column of the first number of a pose, by the count of numbers in a line; 1 if the time is before the pose
_TUM = {8: 1, 7: 0}
_KITTI = {12: 0, 13: 1, 16: 0, 17: 1}


def read_trajectory(path: Path, wanted: Selection) -> Rows:
    """Read lines of ``t x y z qx qy qz qw``, or without ``t``; ``#`` and ``%`` start a comment."""
    rows = _collect(path, _TUM)
    rows.no_times = "a line of 7 numbers contains none: give the sample time, dt (--dt)"
    return rows


def read_kitti(path: Path, wanted: Selection) -> Rows:
    """Read lines of 12 or 16 numbers, with an optional frame number or time first; see :class:`Reader`."""
    rows = _collect(path, _KITTI)
    rows.no_times = "KITTI trajectories contain none: give the sample time, dt (--dt), 0.1 s for KITTI itself"
    whole = rows.times is not None and (rows.times % 1 == 0).all() and rows.origin is None
    if whole and wanted.time_unit is None:
        rows.count_frames()
    return rows


def _collect(path: Path, starts: dict[int, int]) -> Rows:
    texts = ((number, re.split("[#%]", line)[0].strip()) for number, line in read_lines(path))
    rows = ((number, split(text, find_delimiter(text))) for number, text in texts if text)
    number, cells = next(rows, (0, []))
    width = len(trim(cells))
    if width not in starts:
        expected = " or ".join(map(str, starts))
        raise RecordingError(f"{path}: line {number}: expected {expected} numbers, found {width}.")
    first = starts[width]
    return collect(path, chain([(number, cells)], rows), width, range(first, width), 0 if first else None)


def read_echo(path: Path, wanted: Selection) -> Rows:
    """Read rows of ``sec,nanosec,frame_id,x,y,z,qx,qy,qz,qw``, with an optional child frame before ``x``."""
    lines = read_cells(path, ",")
    number, cells = next(lines, (0, [""]))
    if not (start := _first_of_pose(cells)):
        raise RecordingError(f"{path}: line {number}: expected a stamp, a frame and the 7 numbers of a pose.")
    return collect(path, chain([(number, cells)], lines), len(cells), range(start, start + 7), (0, 1))


def _first_of_pose(cells: list[str]) -> int:
    """Column of the first number after the frames; 0 if the row contains no pose."""
    if len(cells) < 10 or not (cells[0].isdecimal() and cells[1].isdecimal()) or is_number(cells[2]):
        return 0
    first = 3 if is_number(cells[3]) else 4
    return first if len(cells) >= first + 7 and all(map(is_number, cells[first:])) else 0


def _is_tum(path: Path, head: bytes) -> bool:
    width, comment = first_numbers(head)
    named = len(comment) == width and any(re.match(r"(?i)q|.*(quat|orient|rot)", cell) for cell in comment)
    return width in _TUM and not named


TRAJECTORY = Reader(
    name="a TUM trajectory",
    suffixes=(".txt", ".tum", ".csv", ".tsv"),
    recognises=_is_tum,
    read=read_trajectory,
    options=frozenset({"unit", "time_unit", "quaternion"}),
)
KITTI = Reader(
    name="a KITTI trajectory",
    suffixes=(".txt", ".csv", ".tsv", ".tum", ".kitti"),
    recognises=lambda path, head: (start := first_numbers(head))[0] in _KITTI and not start[1][12:],
    read=read_kitti,
    options=frozenset({"unit", "time_unit"}),
)
ECHO = Reader(
    name="an output of ros2 topic echo --csv",
    suffixes=(".csv", ".txt"),
    recognises=lambda path, head: (
        _first_of_pose(split(head.decode(errors="replace").split("\n")[0], ",")) > 0
    ),
    read=read_echo,
    options=frozenset({"unit", "quaternion"}),
)

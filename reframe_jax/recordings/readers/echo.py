"""Output of ``ros2 topic echo --csv``: the fields of a message in each row, without a header.

The fields are seconds and nanoseconds of the stamp, the names of one or two frames, the 7 numbers of a pose,
and perhaps covariances and velocities. PoseStamped, PoseWithCovarianceStamped and Odometry have this layout.
"""

from itertools import chain
from pathlib import Path

from reframe_jax.recordings.readers.collecting import collect
from reframe_jax.recordings.readers.lines import is_number, read_cells, split
from reframe_jax.recordings.readers.reader import Reader
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import Rows
from reframe_jax.recordings.selection import Selection


def read_echo(path: Path, wanted: Selection) -> Rows:
    """Read rows of ``sec,nanosec,frame_id,x,y,z,qx,qy,qz,qw``, with an optional child frame before ``x``."""
    lines = read_cells(path, ",")
    number, cells = next(lines, (0, [""]))
    start = _first_number(cells)
    if not start:
        raise RecordingError(f"{path}: line {number}: expected a stamp, a frame and the 7 numbers of a pose.")
    rows = chain([(number, cells)], lines)
    return collect(path, rows, len(cells), range(start, start + 7), (0, 1))


def _first_number(cells: list[str]) -> int:
    """Column of the first number after the frames; 0 if the row contains no pose."""
    if len(cells) < 10 or not (cells[0].isdecimal() and cells[1].isdecimal()) or is_number(cells[2]):
        return 0
    first = 3 if is_number(cells[3]) else 4
    return first if len(cells) >= first + 7 and all(map(is_number, cells[first:])) else 0


ECHO = Reader(
    name="an output of ros2 topic echo --csv",
    suffixes=(".csv", ".txt"),
    recognises=lambda path, head: _first_number(split(head.decode(errors="replace").split("\n")[0], ",")) > 0,
    read=read_echo,
    options=frozenset({"unit", "quaternion"}),
)

"""KITTI trajectories: the 12 numbers of a pose matrix to a line, row by row, without times or a header.

KITTI-360 puts the number of the frame before them; others write all 16 numbers, or a time first.
"""

from pathlib import Path

from reframe_jax.recordings.readers.exports import find_delimiter, first_numbers, split, trim
from reframe_jax.recordings.readers.lines import Collector, read_lines
from reframe_jax.recordings.readers.reader import Reader
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import Rows
from reframe_jax.recordings.selection import Selection

__all__ = ["KITTI", "read_kitti"]

_WIDTHS = (12, 13, 16, 17)
_NO_TIMES = "KITTI trajectories are written without: give the sample time, dt (--dt), 0.1 s for KITTI itself"


def read_kitti(path: Path, wanted: Selection) -> Rows:
    """Read lines of 12 or 16 numbers, perhaps with the number of the frame or the time before them.

    Args:
        path: the file.
        wanted: nothing of it is used here.

    Raises:
        RecordingError: if a line does not hold as many numbers as the first.
    """
    rows: Collector | None = None
    width, whole = 0, True
    for number, line in read_lines(path):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        cells = trim(split(text, find_delimiter(text)), width)
        if rows is None:
            width = len(cells)
            timed = width % 4
            rows = Collector(path, width, 0 if timed else None, range(timed, width))
        rows.add(number, cells)
        whole = whole and cells[0].isdecimal()
    if rows is None:
        raise RecordingError(f"{path}: is empty; expected lines of 12 numbers.")
    found = rows.rows()
    found.no_times = _NO_TIMES
    if found.times is not None and whole and found.origin is None:
        found.count_frames()
    return found


KITTI = Reader(
    name="a KITTI trajectory",
    suffixes=(".txt", ".csv", ".tsv", ".tum", ".kitti"),
    recognises=lambda path, head: first_numbers(head)[0] in _WIDTHS and not first_numbers(head)[1][12:],
    read=read_kitti,
    options=frozenset({"unit", "time_unit"}),
)

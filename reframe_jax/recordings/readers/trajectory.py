"""TUM trajectories: 8 numbers to a line, without a header."""

from pathlib import Path

from reframe_jax.recordings.readers.lines import Collector, read_lines
from reframe_jax.recordings.readers.reader import Reader
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import Rows
from reframe_jax.recordings.selection import Selection

__all__ = ["TRAJECTORY", "read_trajectory"]


def read_trajectory(path: Path, wanted: Selection) -> Rows:
    """Read lines of ``t x y z qx qy qz qw``, separated by blanks; ``#`` starts a comment.

    Args:
        path: the file.
        wanted: nothing of it is used here.

    Raises:
        RecordingError: if a line does not hold 8 numbers.
    """
    rows = Collector(path, width=8, time=0, columns=range(1, 8))
    first = True
    for number, line in read_lines(path):
        cells = line.split("#")[0].split()
        if not cells:
            continue
        if first and len(cells) != 8:
            break
        first = False
        rows.add(number, cells)
    if first:
        raise RecordingError(
            f"{path}: expected a TUM trajectory, lines of t x y z qx qy qz qw separated by blanks; save a "
            "table that has a header as .csv."
        )
    return rows.rows()


TRAJECTORY = Reader(
    name="a TUM trajectory",
    suffixes=(".txt", ".tum"),
    recognises=lambda path, head: True,
    read=read_trajectory,
    options=frozenset({"unit"}),
)

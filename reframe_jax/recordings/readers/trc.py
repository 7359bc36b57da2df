"""Rigid bodies from the markers of a TRC file of OpenSim and other programs.

The first line starts with ``PathFileType``. Two rows contain the names and values of rate, unit and so on. In
the row ``Frame#, Time, ...``, the name of each marker is above its three columns ``X1, Y1, Z1``. Cells are
empty, NaN or all 0 where a marker was not seen.
"""

from itertools import islice
from pathlib import Path

import numpy as np

from reframe_jax.recordings.readers.lines import Lines, collect, find_delimiter, is_number, read_lines, split
from reframe_jax.recordings.readers.markers import marker_entries, set_marker_poses
from reframe_jax.recordings.readers.reader import Reader
from reframe_jax.recordings.recording import RecordingError, Rows
from reframe_jax.recordings.selection import Selection


def read_trc(path: Path, wanted: Selection) -> Rows:
    """Read the markers of a rigid body, and compute its poses; see :class:`Reader`."""
    labels, unit, lines = _read_header(path)
    width = 2 + 3 * len(labels)
    numbers = (row for row in lines if is_number(row[1][0]))  # without the row X1, Y1, Z1
    rows = collect(path, numbers, width, range(2, width), 1, short=True)
    points = rows.values.reshape(-1, len(labels), 3)
    points[(points == 0).all(axis=2)] = np.nan
    set_marker_poses(rows, points, labels, wanted, unit)
    return rows


def _read_header(path: Path) -> tuple[list[str], str, Lines]:
    """Return the names of the markers, the unit, and the rows after the names."""
    lines = ((number, split(line, find_delimiter(line))) for number, line in read_lines(path, "\r\n"))
    head = [cells for _, cells in islice(lines, 3)]
    number, titles = next(lines, (0, [""]))
    about = dict(zip(*(filter(None, cells) for cells in head[1:]), strict=False)) if len(head) == 3 else {}
    if "Units" not in about or not titles[0].startswith("Frame"):
        raise RecordingError(
            f"{path}: line {number}: expected the header of a TRC file: rows of DataRate, ..., Units and "
            "their values, then Frame#, Time and the names of the markers."
        )
    labels = [cell for cell in titles[2:] if cell]
    if len(labels) > 3 and all(label[-2:] in ("_x", "_y", "_z") for label in labels):
        labels = [label[:-2] for label in labels[::3]]  # some programs name every column
    if len(set(labels)) != len(labels):
        raise RecordingError(f"{path}: line {number}: two markers have the same name; rename one.")
    unit = about["Units"]
    return labels, "" if is_number(unit) else unit, lines  # of an empty cell, the next cell is found


TRC = Reader(
    name="a TRC file of markers",
    suffixes=(".trc",),
    recognises=lambda path, head: head.startswith(b"PathFileType"),
    read=read_trc,
    options=frozenset({"body", "in_body", "unit"}),
    contents=lambda path: marker_entries(_read_header(path)[0], "other markers"),
)

"""Rigid bodies from the markers of a TRC file, as OpenSim reads them and many systems write them.

The first line starts with ``PathFileType``. Two rows hold the names and values of rate, unit and the like; a
row ``Frame#, Time, ...`` has the names of the markers, each above its three columns ``X1, Y1, Z1``. Cells are
empty, NaN or all 0 where a marker was not seen.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from reframe_jax.recordings.markers import UNSEEN, choose_markers, fit_markers, marker_entries
from reframe_jax.recordings.readers.collecting import collect
from reframe_jax.recordings.readers.lines import find_delimiter, is_number, read_lines, split
from reframe_jax.recordings.readers.reader import Entry, Reader
from reframe_jax.recordings.readers.units import LENGTH_WORDS
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import Rows, shown
from reframe_jax.recordings.selection import UNITS, Selection, flag

__all__ = ["TRC", "read_trc"]

_HEADINGS = 3  # lines before the names of the markers


def read_trc(path: Path, wanted: Selection) -> Rows:
    """Fit a rigid body to markers."""
    labels, unit, delimiter, lines = _read_header(path)
    stated = LENGTH_WORDS.get(unit.lower())
    if stated is None and wanted.unit is None:
        raise RecordingError(f"{path}: states the unit {shown(unit, 20)!r}; give {flag('unit')}.")
    metres = stated or UNITS[str(wanted.unit)]
    markers = choose_markers(path, wanted.body, labels)
    width = 2 + 3 * len(labels)
    cells = ((number, split(line, delimiter)) for number, line in lines)
    numbers = (row for row in cells if is_number(row[1][0]))  # not the row X1, Y1, Z1
    rows = collect(path, numbers, width, range(2, width), 1, short=True)
    points = rows.values.reshape(len(rows.values), -1, 3)
    points[(points == 0).all(axis=2)] = np.nan
    poses, notes = fit_markers(path, points, labels, markers, metres)
    rows.values, rows.metres = poses.reshape(-1, 16), metres
    rows.notes += notes
    rows.missing = UNSEEN
    return rows


def _read_header(path: Path) -> tuple[list[str], str, str | None, Iterator[tuple[int, str]]]:
    """Names of the markers, the unit, the delimiter, and the lines after the names."""
    lines = read_lines(path, "\r\n")
    head = [line for _, line in zip(range(_HEADINGS), (line for _, line in lines), strict=False)]
    number, titles = next(lines, (0, ""))
    delimiter = find_delimiter(titles)
    about: dict[str, str] = {}
    if len(head) == _HEADINGS:
        names, values = ([cell for cell in split(row, find_delimiter(row)) if cell] for row in head[1:])
        about = dict(zip(names, values, strict=False))
    cells = split(titles, delimiter)
    if "Units" not in about or not cells or not cells[0].startswith("Frame"):
        raise RecordingError(
            f"{path}: line {number}: expected the header of a TRC file: rows of DataRate, ..., Units and "
            "their values, then Frame#, Time and the names of the markers."
        )
    labels = [cell for cell in cells[2:] if cell]
    if len(labels) > 3 and all(label[-2:] in ("_x", "_y", "_z") for label in labels):
        labels = [label[:-2] for label in labels[::3]]  # some writers name every column
    if len(set(labels)) != len(labels):
        raise RecordingError(f"{path}: line {number}: two markers have the same name; rename one.")
    return labels, about["Units"], delimiter, lines


def _contents(path: Path) -> list[Entry]:
    return marker_entries(_read_header(path)[0], "other markers")


TRC = Reader(
    name="a TRC file of markers",
    suffixes=(".trc",),
    recognises=lambda path, head: head.removeprefix(b"\xef\xbb\xbf").startswith(b"PathFileType"),
    read=read_trc,
    options=frozenset({"body", "in_body", "unit"}),
    contents=_contents,
)

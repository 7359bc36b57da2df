"""Rigid bodies in a CSV export of OptiTrack Motive, format version 1.2 and later.

The first line holds pairs of names and values: units, rotation type, coordinate space. Rows of types, names
and components of all columns follow, down to the row ``Frame, Time (Seconds), X, Y, Z, ...``. The names of
the axes distinguish the numbers of quaternions. Euler angles are in degrees, about the moving axes, in the
order of the header. Cells are empty where a body was not seen. Spreadsheets save the export with semicolons
and decimal commas. The ground frame is that of the export, y up unless changed.
"""

import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import cast

from reframe_jax.recordings.readers.collecting import collect
from reframe_jax.recordings.readers.columns import set_poses
from reframe_jax.recordings.readers.lines import find_delimiter, read_lines, split, trim
from reframe_jax.recordings.readers.reader import Entry, Reader, choose_name
from reframe_jax.recordings.readers.units import LENGTH_WORDS
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import Rows, shown
from reframe_jax.recordings.selection import ANGLE_UNITS, ANGLES, Angles, Selection

__all__ = ["MOTIVE", "read_motive"]

_FIRST = "Format Version"
_ORDERS = [order for order in ANGLES if order.isupper()]
_BODIES = ("Rigid Body", "Bone")
_TIME = 1  # column
_MOST_HEADINGS = 12  # rows between the first line and the row of axes

_Lines = Iterator[tuple[int, list[str]]]


def read_motive(path: Path, wanted: Selection) -> Rows:
    """Read a rigid body or bone."""
    lines = _lines(path)
    about, width, bodies = _read_header(path, lines)
    body = bodies[choose_name(path, "body", wanted.body, [*bodies], "rigid bodies")]
    rotation, metres = about.get("Rotation Type", ""), about.get("Length Units", "")
    if metres.lower() not in LENGTH_WORDS:
        raise RecordingError(
            f"{path}: line 1: expected Length Units of Meters, Centimeters or Millimeters, found "
            f"{shown(metres, 40)!r}."
        )
    quaternion = rotation.lower() == "quaternion"
    if not quaternion and rotation not in _ORDERS:
        raise RecordingError(
            f"{path}: line 1: expected a Rotation Type of Quaternion or {', '.join(_ORDERS)}, found "
            f"{shown(rotation, 40)!r}."
        )
    names = [f"Position {axis}" for axis in "XYZ"]
    names += [f"Rotation {axis}" for axis in ("XYZW" if quaternion else "XYZ")]
    if missing := [name for name in names if name not in body]:
        raise RecordingError(f"{path}: no column for {', '.join(missing)} of the body; export both.")
    rows = collect(path, lines, width, [body[name] for name in names], _TIME)
    rows.metres = LENGTH_WORDS[metres.lower()]
    meant = wanted if quaternion else replace(wanted, angles=cast(Angles, rotation))
    set_poses(rows, rows.values[:, :3], rows.values[:, 3:], meant, ANGLE_UNITS["deg"], named=False)
    return rows


def _lines(path: Path) -> _Lines:
    delimiter = ","
    for number, line in read_lines(path, "\r\n"):
        if line.lstrip('"').startswith(_FIRST):
            delimiter = find_delimiter(line.replace('"', "")[len(_FIRST) :][:1]) or ","
        cells = split(line, delimiter)
        if any(cells):  # spreadsheets fill blank lines with delimiters
            yield number, cells


def _read_header(path: Path, lines: _Lines) -> tuple[dict[str, str], int, dict[str, dict[str, int]]]:
    """Take the lines down to the row of axes.

    Returns:
        What the first line says, the width of the rows, and the columns of every body by their names, such as
        "Rotation X".
    """
    first = next(lines)[1]
    about = dict(pairwise(first))  # names of takes may hold commas
    headings: list[list[str]] = []
    for _, cells in lines:
        if cells[0] == "Frame" or len(headings) == _MOST_HEADINGS:
            break
        headings.append(cells)
    else:
        cells = [""]
    if cells[0] != "Frame" or len(headings) < 3 or not cells[1:2] or not cells[1].startswith("Time"):
        raise RecordingError(
            f"{path}: expected the header of a Motive export of version 1.2 or later: rows of types, names "
            f"and components, then Frame,Time (Seconds),X,...; the file says version "
            f"{shown(about.get('Format Version', ''), 20)!r}."
        )
    # the last column may have a title and no axis, such as the error of a body
    width = max(len(trim(row)) for row in (*headings, cells))
    types, names, parts = headings[0], headings[1], headings[-1]
    bodies: dict[str, dict[str, int]] = {}
    for column, axis in enumerate(cells):
        kind, name, part = (row[column] if column < len(row) else "" for row in (types, names, parts))
        if kind in _BODIES and part in ("Rotation", "Position"):
            if kind == "Bone" and about.get("Coordinate Space") == "Local":
                continue  # relative to its parent: no pose in the ground frame
            if bodies.setdefault(name, {}).setdefault(f"{part} {axis}", column) != column:
                raise RecordingError(f"{path}: two bodies are called {shown(name, 40)!r}; rename one.")
    return about, width, bodies


def _contents(path: Path) -> list[Entry]:
    return [Entry("body", name, "rigid body") for name in _read_header(path, _lines(path))[2]]


MOTIVE = Reader(
    name="an export of OptiTrack Motive",
    suffixes=(".csv",),
    recognises=lambda path, head: re.match(b'(\xef\xbb\xbf)?"?Format Version"?[,;\t]', head) is not None,
    read=read_motive,
    options=frozenset({"body", "in_body", "quaternion"}),
    contents=_contents,
)

"""Rigid bodies in a CSV export of OptiTrack Motive, format version 1.2 or later.

The first line contains names and values: units, rotation type, coordinate space. Rows of types, names and
components of the columns follow, down to the row ``Frame, Time (Seconds), X, Y, Z, ...``. Euler angles are in
degrees, about the moving axes, in the order of the header. Cells are empty where a body was not seen.
Spreadsheets save the export with semicolons and decimal commas. The ground frame is the frame of the export,
with y up by default.
"""

import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import cast

from reframe_jax.recordings.readers.columns import set_poses
from reframe_jax.recordings.readers.lines import collect, read_cells, trim
from reframe_jax.recordings.readers.reader import Entry, Reader, choose_name
from reframe_jax.recordings.readers.units import LENGTH_WORDS
from reframe_jax.recordings.recording import RecordingError, Rows, shown
from reframe_jax.recordings.selection import ANGLE_UNITS, ANGLES, Angles, Selection

_ORDERS = [order for order in ANGLES if order.isupper()]
_BODIES = ("Rigid Body", "Bone")
_TIME = 1  # column
_MOST_HEADINGS = 12  # rows between the first line and the row of axes


def read_motive(path: Path, wanted: Selection) -> Rows:
    """Read the poses of a rigid body or a bone; see :class:`Reader`."""
    lines = read_cells(path)
    # names of takes may contain commas, so that every cell may be a name
    about = dict(pairwise(next(lines)[1]))
    headings: list[list[str]] = []
    cells = [""]
    for _, cells in lines:
        if cells[0] == "Frame" or len(headings) == _MOST_HEADINGS:
            break
        headings.append(cells)
    if cells[0] != "Frame" or len(headings) < 3 or not "".join(cells[1:2]).startswith("Time"):
        raise RecordingError(
            f"{path}: expected the header of a Motive export of version 1.2 or later: rows of types, names "
            f"and components, then Frame,Time (Seconds),X,...; the file states version "
            f"{shown(about.get('Format Version', ''), 20)!r}."
        )
    # the last column may have a title but no axis, such as the error of a body
    width = max(len(trim(row)) for row in (*headings, cells))
    bodies: dict[str, dict[str, int]] = {}
    for column, axis in enumerate(cells):
        kind, name, part = ("".join(headings[row][column : column + 1]) for row in (0, 1, -1))
        local = kind == "Bone" and about.get("Coordinate Space") == "Local"  # relative to the parent
        if kind not in _BODIES or part not in ("Rotation", "Position") or local:
            continue
        if bodies.setdefault(name, {}).setdefault(f"{part} {axis}", column) != column:
            raise RecordingError(f"{path}: two bodies have the name {shown(name, 40)!r}; rename one.")
    body = bodies[choose_name(path, "body", wanted.body, [*bodies], "rigid bodies")]
    rotation, length = about.get("Rotation Type", ""), about.get("Length Units", "")
    if length.lower() not in LENGTH_WORDS:
        raise RecordingError(
            f"{path}: line 1: expected Length Units of Meters, Centimeters or Millimeters, found "
            f"{shown(length, 40)!r}."
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
    rows.metres = LENGTH_WORDS[length.lower()]
    meant = wanted if quaternion else replace(wanted, angles=cast(Angles, rotation))
    set_poses(rows, rows.values[:, :3], rows.values[:, 3:], meant, ANGLE_UNITS["deg"], named=False)
    return rows


def _contents(path: Path) -> list[Entry]:
    rows = pairwise(cells for _, cells in read_cells(path))
    types, names = next((pair for pair in rows if set(_BODIES) & {*pair[0]}), ([], []))
    found = dict.fromkeys(name for kind, name in zip(types, names, strict=False) if kind in _BODIES)
    return [Entry("body", name, "rigid body") for name in found]


MOTIVE = Reader(
    name="an export of OptiTrack Motive",
    suffixes=(".csv",),
    recognises=lambda path, head: re.match(b'"?Format Version"?[,;\t]', head) is not None,
    read=read_motive,
    options=frozenset({"body", "in_body", "quaternion"}),
    contents=_contents,
)

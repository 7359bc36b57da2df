"""Objects and segments in a CSV export of Vicon Tracker or Nexus.

A section contains its title, ``Objects`` or ``Segments``, the rate in Hz, a row of names, a row ``Frame, Sub
Frame, RX, RY, RZ, TX, TY, TZ, ...`` and a row of units. Four columns of rotation, with ``RW``, are a
quaternion. Three columns are a helical (rotation) vector or Euler angles; the file does not state which.
Cells are empty or all 0, or the row ends, where a body was not seen.
"""

import re
from itertools import takewhile
from pathlib import Path

import numpy as np

from reframe_jax.recordings.readers.columns import set_poses
from reframe_jax.recordings.readers.lines import Lines, collect, is_number, read_cells
from reframe_jax.recordings.readers.reader import Entry, Reader, choose_name, drop_zeros
from reframe_jax.recordings.recording import RecordingError, Rows, listed, shown
from reframe_jax.recordings.selection import ANGLE_UNITS, UNITS, Selection, flag

_WITH_POSES = ("objects", "segments")
_TITLES = (*_WITH_POSES, "trajectories", "devices", "joints", "model outputs", "events")
_START = re.compile(rf"\s*({'|'.join(_TITLES)})[,;\t ]*([\r\n]|$)", re.IGNORECASE)
_HEADING = re.compile(r"^Global Angle (\([A-Za-z ]+\) )?")  # before names: Global Angle (Quaternion) Rod:Rod

_Body = tuple[list[int], list[int], float, float]
"""Columns of the rotation and of the position, and their units in rad and m."""


def read_vicon(path: Path, wanted: Selection) -> Rows:
    """Read the poses of an object or a segment; see :class:`Reader`."""
    rate, width, bodies, lines = _read_header(path)
    name = choose_name(path, "body", wanted.body, [*bodies], "objects and segments")
    rotation, position, radians, metres = bodies[name]
    if len(rotation) == 3 and wanted.angles is None:
        raise RecordingError(
            f"{path}: does not state the meaning of RX, RY, RZ; give {flag('angles')}: vector for an export "
            "of helical angles, XYZ for Euler XYZ."
        )
    rows = collect(path, lines, width, [*position, *rotation, 0, 1], short=True)
    if np.any(rows.values[:, -1] != 0):
        raise RecordingError(f"{path}: has sub frames; export one row per frame, at the frame rate.")
    rows.times = (rows.values[:, -2] - rows.values[:1, -2]) / rate
    rows.values, rows.metres = rows.values[:, :-2], metres
    drop_zeros(rows, rows.values[:, :6])
    set_poses(rows, rows.values[:, :3], rows.values[:, 3:], wanted, radians, named=False)
    return rows


def _read_header(path: Path) -> tuple[float, int, dict[str, _Body], Lines]:
    """Return the rate, the width and the bodies of the first section with poses, and its rows of numbers."""
    lines, found = read_cells(path), []
    for _, cells in lines:
        title = cells[0].lower()
        if title in _WITH_POSES:
            break
        found += [cells[0]] if title in _TITLES else []
    else:
        only = listed(found, 8)
        raise RecordingError(f"{path}: expected a section Objects or Segments; found only {only}.")
    (number, rate), (_, names), (_, axes), (_, units) = (next(lines, (0, [""])) for _ in range(4))
    if not is_number(rate[0]) or not 0 < float(rate[0]) < np.inf or axes[:2] != ["Frame", "Sub Frame"]:
        raise RecordingError(
            f"{path}: line {number}: expected the rate in Hz, then rows of names, of Frame,Sub Frame,RX,... "
            "and of units."
        )
    bodies: dict[str, _Body] = {}
    for first in (i for i, axis in enumerate(axes) if axis == "RX"):
        width = 7 if axes[first + 3 : first + 4] == ["RW"] else 6
        if axes[first : first + width] != [*("RX", "RY", "RZ", "RW")[: width - 3], "TX", "TY", "TZ"]:
            raise RecordingError(f"{path}: expected the columns RX,RY,RZ,TX,TY,TZ of every body.")
        name = _HEADING.sub("", "".join(names[first : first + 1])).strip()
        subject, _, segment = name.partition(":")
        name = subject if subject == segment else name
        if name in bodies or not name:
            raise RecordingError(f"{path}: expected different names of all bodies, found {shown(name)!r}.")
        columns = [*range(first, first + width)]
        given = [units[i].lower() if i < len(units) else "" for i in columns]
        radians, metres = (
            known.get(stated[0]) if len(set(stated)) == 1 else None
            for stated, known in ((given[:-3], ANGLE_UNITS), (given[-3:], UNITS))
        )
        if metres is None or (radians is None and width == 6):
            raise RecordingError(
                f"{path}: expected the units rad or deg, and mm, cm or m, of {shown(name, 40)}; found "
                f"{shown(', '.join(given), 60)!r}."
            )
        bodies[name] = columns[:-3], columns[-3:], radians or 1.0, metres
    rows = takewhile(lambda line: line[1][0].lower() not in _TITLES, lines)  # down to the next section
    return float(rate[0]), len(axes), bodies, rows


def _contents(path: Path) -> list[Entry]:
    rate, _, bodies, _ = _read_header(path)
    return [Entry("body", name, f"object or segment, {rate:g} Hz") for name in bodies]


VICON = Reader(
    name="an export of Vicon Tracker or Nexus",
    suffixes=(".csv",),
    recognises=lambda path, head: _START.match(head.decode("latin-1")) is not None,
    read=read_vicon,
    options=frozenset({"body", "in_body", "angles", "quaternion"}),
    contents=_contents,
)

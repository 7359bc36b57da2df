"""Objects and segments in a CSV export of Vicon Tracker or Nexus.

A section starts with its title, ``Objects`` or ``Segments``, then the rate in Hz, a row of names, a row
``Frame, Sub Frame, RX, RY, RZ, TX, TY, TZ, ...`` and a row of units. Four columns of rotation, with ``RW``,
are a quaternion. Three are a helical (rotation) vector or Euler angles, which the file does not say: the
user does. Where a body was not seen, cells are empty or all 0, or the row ends.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np

from reframe_jax.recordings.readers.collecting import collect, drop_zeros
from reframe_jax.recordings.readers.columns import set_poses
from reframe_jax.recordings.readers.lines import is_number, read_lines, split
from reframe_jax.recordings.readers.reader import Entry, Reader, choose_name
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import Rows, shown
from reframe_jax.recordings.selection import UNITS, Selection, flag

__all__ = ["VICON", "read_vicon"]

_WITH_POSES = ("objects", "segments")
_TITLES = (*_WITH_POSES, "trajectories", "devices", "joints", "model outputs", "events")
_RADIANS = {"rad": 1.0, "deg": np.pi / 180}
_HEADING = re.compile(r"^Global Angle (\([A-Za-z ]+\) )?")  # before names: Global Angle (Quaternion) Rod:Rod
_PARTS = slice(0, -3), slice(-3, None)  # of the columns of a body: rotation, translation

_Lines = Iterator[tuple[int, list[str]]]


@dataclass(frozen=True)
class _Body:
    """Columns of a body, and the factors of their units."""

    rotation: list[int]
    position: list[int]
    radians: float
    metres: float


def read_vicon(path: Path, wanted: Selection) -> Rows:
    """Read an object or segment."""
    lines = _lines(path)
    rate, width, bodies, rest = _read_header(path, lines)
    body = bodies[choose_name(path, "body", wanted.body, [*bodies], "objects and segments")]
    if len(body.rotation) == 3 and wanted.angles is None:
        raise RecordingError(
            f"{path}: does not say what RX, RY, RZ mean; give {flag('angles')}: vector if they were exported "
            "as helical, XYZ if as Euler XYZ."
        )
    rows = collect(path, rest, width, [*body.position, *body.rotation, 0, 1], short=True)
    if np.any(rows.values[:, -1] != 0):
        raise RecordingError(
            f"{path}: has sub frames; expected one row a frame, export it at the frame rate."
        )
    rows.times = (rows.values[:, -2] - rows.values[:1, -2]) / rate
    rows.values, rows.metres = rows.values[:, :-2], body.metres
    drop_zeros(rows, rows.values[:, :6])
    set_poses(rows, rows.values[:, :3], rows.values[:, 3:], wanted, body.radians, named=False)
    return rows


def _lines(path: Path) -> _Lines:
    """Numbered rows of cells; their separator is that of the row of axes, as names may hold others."""
    delimiter = None
    for number, line in read_lines(path, "\r\n"):
        mark = delimiter or next((mark for mark in "\t;" if mark in line), ",")
        if line.startswith("Frame"):
            delimiter = mark
        yield number, split(line, mark)


def _read_header(path: Path, lines: _Lines) -> tuple[float, int, dict[str, _Body], _Lines]:
    """The rate, the width and the bodies of the first section with poses, and its rows of numbers."""
    found = []
    for _, cells in lines:
        title = cells[0].lower()
        if title in _WITH_POSES:
            break
        found += [cells[0]] if title in _TITLES else []
    else:
        raise RecordingError(
            f"{path}: expected a section Objects or Segments; found only {', '.join(found[:8]) or 'none'}."
        )
    head = [next(lines, (0, [""])) for _ in range(4)]
    (number, rate), (_, names), (_, axes), (_, units) = head
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
        name = names[first] if first < len(names) else ""
        name = _HEADING.sub("", name).strip()
        subject, _, segment = name.partition(":")
        name = subject if subject == segment else name
        if name in bodies or not name:
            raise RecordingError(f"{path}: expected a name of its own for every body, found {shown(name)!r}.")
        columns = [*range(first, first + width)]
        given = [[units[i].lower() if i < len(units) else "" for i in columns[part]] for part in _PARTS]
        radians, metres = (_factor(each, known) for each, known in zip(given, (_RADIANS, UNITS), strict=True))
        if metres is None or (radians is None and width == 6):
            raise RecordingError(
                f"{path}: expected the units rad or deg, and mm, cm or m, of {shown(name, 40)}; found "
                f"{shown(', '.join(chain(*given)), 60)!r}."
            )
        bodies[name] = _Body(columns[:-3], columns[-3:], radians or 1.0, metres)
    return float(rate[0]), len(axes), bodies, _numbers(lines)


def _factor(units: list[str], known: dict[str, float]) -> float | None:
    """Factor of the unit, if it is the same one and known."""
    return known.get(units[0]) if len(set(units)) == 1 else None


def _numbers(lines: _Lines) -> _Lines:
    """The rows down to the next section."""
    for number, cells in lines:
        if cells[0].lower() in _TITLES:
            return
        yield number, cells


def _contents(path: Path) -> list[Entry]:
    rate, _, bodies, _ = _read_header(path, _lines(path))
    return [Entry("body", name, f"object or segment, {rate:g} Hz") for name in bodies]


def _recognises(path: Path, head: bytes) -> bool:
    first = head.removeprefix(b"\xef\xbb\xbf").lstrip().split(b"\n")[0].split(b"\r")[0]
    return first.rstrip(b",;\t ").decode("latin-1").lower() in _TITLES


VICON = Reader(
    name="an export of Vicon Tracker or Nexus",
    suffixes=(".csv",),
    recognises=_recognises,
    read=read_vicon,
    options=frozenset({"body", "in_body", "angles", "quaternion"}),
    contents=_contents,
)

"""Rigid bodies in a 6DOF TSV export of Qualisys Track Manager.

The header has a name and its values in every line. A row with the names of the columns may follow. Of every
body there are X, Y, Z in mm, three angles in degrees, a residual, and the rotation matrix, Rot[0] to Rot[8],
column by column: ``p_global = R p_local + p``. The matrix is read. The angles, which have other conventions
at choice, serve to check the order of its elements. Numbers are 0 or missing where a body was not seen.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np

from reframe_jax.geometry.numpy_rotations import euler_matrices
from reframe_jax.recordings.readers.collecting import collect, drop_zeros, matrix_rows
from reframe_jax.recordings.readers.lines import is_number, read_lines, split
from reframe_jax.recordings.readers.reader import Entry, Reader, choose_name
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import Rows, shown
from reframe_jax.recordings.selection import Selection

__all__ = ["QUALISYS", "read_qualisys"]

_FULL, _ANGLES_ONLY = 16, 7  # columns of a body, with and without the matrix
_STANDARD, _ORDER = "qualisys standard", "XYZ"  # roll, pitch, yaw about the moving axes
_AGREES = 2e-2  # difference of matrices; angles and elements are printed with three digits or more
_MOST_HEADINGS = 1000  # lines; events take one each

_Lines = Iterator[tuple[int, list[str]]]


@dataclass(frozen=True)
class _Header:
    about: dict[str, list[str]]
    width: int
    start: dict[str, int]  # first column of every body
    size: int  # columns of a body
    time: int | None


def read_qualisys(path: Path, wanted: Selection) -> Rows:
    """Read a rigid body."""
    header, lines = _read_header(path)
    first = header.start[choose_name(path, "body", wanted.body, [*header.start], "rigid bodies")]
    rows = collect(path, lines, header.width, range(first, first + header.size), header.time)
    if header.time is None:
        rate = " ".join(header.about.get("FREQUENCY", []))
        if is_number(rate) and 0 < float(rate) < np.inf:
            rows.times = np.arange(len(rows.values)) / float(rate)
    rows.metres = 1e-3
    has_matrix = header.size == _FULL
    drop_zeros(rows, np.delete(rows.values, 6, axis=1))
    positions, angles = rows.values[:, :3], np.radians(rows.values[:, 3:6])
    turned = euler_matrices(_ORDER, angles)
    if not has_matrix:
        convention = " ".join(header.about.get("ROTATION_CONVENTION", [])).strip()
        if convention.lower() != _STANDARD:
            raise RecordingError(
                f"{path}: has no rotation matrices, and angles of the convention "
                f"{shown(convention, 40) or 'unknown'!r}; export the matrices too."
            )
    else:
        turned = _ordered(rows, rows.values[:, 7:].reshape(-1, 3, 3), turned)
    rows.values = matrix_rows(turned, positions)
    return rows


def _ordered(rows: Rows, elements: np.ndarray, turned: np.ndarray) -> np.ndarray:
    """Matrices (N, 3, 3) of their elements; ``turned`` are those that the angles mean."""
    by_column = elements.swapaxes(1, 2)
    whole = np.isfinite(elements).all(axis=(1, 2)) & np.isfinite(turned).all(axis=(1, 2))
    if not whole.any():
        return by_column
    errors = [np.median(np.abs(each - turned)[whole].max(axis=(1, 2))) for each in (by_column, elements)]
    if min(errors) > _AGREES:
        rows.notes.append(
            "the angles are of another convention than Qualisys standard; the matrices are read, column by "
            "column."
        )
    elif errors[1] < errors[0]:
        rows.notes.append("the matrices are stored row by row, as the angles show, and are read so.")
        return elements
    return by_column


def _read_header(path: Path) -> tuple[_Header, _Lines]:
    """The header, and the rows of numbers."""
    lines: _Lines = ((number, split(line, "\t")) for number, line in read_lines(path, "\r\n"))
    about: dict[str, list[str]] = {}
    for number, cells in lines:  # noqa: B007
        if len(about) > _MOST_HEADINGS or not re.fullmatch(r"[A-Z][A-Z0-9_]+", cells[0]):
            break
        about[cells[0]] = [cell for cell in cells[1:] if cell]
    else:
        number, cells = 0, []
    count = " ".join(about.get("NO_OF_BODIES", []))
    if not count.isdecimal() or not cells:
        kind = shown(" ".join(about.get("DATA_INCLUDED", [])), 40) or "no data"
        raise RecordingError(
            f"{path}: expected a 6DOF export with NO_OF_BODIES and rows of numbers, found {kind}; export 6D "
            "data as TSV."
        )
    names = about.get("BODY_NAMES", [])
    titled = not all(is_number(cell) for cell in cells if cell)
    if titled:
        header = _titled(cells, names, about)
    else:
        first = len(cells) - _FULL * int(count)
        starts = {name: first + i * _FULL for i, name in enumerate(names)} if first in (0, 2) else {}
        header = _Header(about, len(cells), starts, _FULL, 1 if first else None)
        lines = chain([(number, cells)], lines)
    if len(header.start) != int(count) or len(names) != int(count):
        raise RecordingError(
            f"{path}: expected {count} BODY_NAMES and {_FULL} columns of each body, X to Rot[8]; found "
            f"{len(names)} names and {len(cells)} columns."
        )
    return header, lines


def _titled(titles: list[str], names: list[str], about: dict[str, list[str]]) -> _Header:
    """The header of a file that names its columns; a name may start with that of the body."""
    last = [re.split("[ _.:]", title)[-1] for title in titles]
    starts = [i for i in range(len(last) - 6) if last[i : i + 3] == ["X", "Y", "Z"]]
    full = all(last[i + 7 : i + 16] == [f"Rot[{k}]" for k in range(9)] for i in starts)
    size = _FULL if full else _ANGLES_ONLY
    time = titles.index("Time") if "Time" in titles else None
    return _Header(about, len(titles), dict(zip(names, starts, strict=False)), size, time)


def _contents(path: Path) -> list[Entry]:
    header, _ = _read_header(path)
    rate = " ".join(header.about.get("FREQUENCY", ["?"]))
    return [Entry("body", name, f"rigid body, {shown(rate, 20)} Hz") for name in header.start]


QUALISYS = Reader(
    name="a TSV export of Qualisys Track Manager",
    suffixes=(".tsv",),
    recognises=lambda path, head: head.removeprefix(b"\xef\xbb\xbf").startswith(
        (b"FILE_VERSION\t", b"NO_OF_FRAMES\t")
    ),
    read=read_qualisys,
    options=frozenset({"body", "in_body"}),
    contents=_contents,
)

"""Rigid bodies in a 6DOF TSV export of Qualisys Track Manager.

The header has a name and its values in every line; a row with the names of the columns may follow. Each body
has X, Y, Z in mm, three angles in degrees, a residual, and the rotation matrix, Rot[0] to Rot[8], column by
column: ``p_global = R p_local + p``. The reader uses the matrix. The angles, whose convention can be chosen,
show whether the matrix is stored row by row. Numbers are 0 or missing where a body was not seen.
"""

import re
from itertools import chain
from pathlib import Path

import numpy as np

from reframe_jax.geometry.numpy_rotations import euler_matrices
from reframe_jax.recordings.readers.lines import Lines, collect, is_number, read_cells
from reframe_jax.recordings.readers.reader import Entry, Reader, choose_name, drop_zeros, matrix_rows
from reframe_jax.recordings.recording import RecordingError, Rows, shown
from reframe_jax.recordings.selection import Selection

_FULL, _ANGLES_ONLY = 16, 7  # columns of a body, with and without the matrix
_STANDARD, _ORDER = "qualisys standard", "XYZ"  # roll, pitch, yaw about the moving axes
_AGREES = 2e-2  # difference of matrices that agree; numbers have three digits or more
_MOST_HEADINGS = 1000  # lines; each event has one


def read_qualisys(path: Path, wanted: Selection) -> Rows:
    """Read the poses of a rigid body; see :class:`Reader`."""
    about, bodies, time, width, lines = _read_header(path)
    columns = bodies[choose_name(path, "body", wanted.body, [*bodies], "rigid bodies")]
    rows = collect(path, lines, width, columns, time)
    rate = about.get("FREQUENCY", "")
    if time is None and is_number(rate) and 0 < float(rate) < np.inf:
        rows.times = np.arange(len(rows.values)) / float(rate)
    rows.metres = 1e-3
    drop_zeros(rows, np.delete(rows.values, 6, axis=1))
    positions, turned = rows.values[:, :3], euler_matrices(_ORDER, np.radians(rows.values[:, 3:6]))
    convention = about.get("ROTATION_CONVENTION", "")
    if len(columns) == _FULL:
        turned = _ordered(rows, rows.values[:, 7:].reshape(-1, 3, 3), turned)
    elif convention.lower() != _STANDARD:
        raise RecordingError(
            f"{path}: has no rotation matrices, and angles of the convention "
            f"{shown(convention, 40) or 'unknown'!r}; without matrices only 'Qualisys standard' can be read. "
            "Export the matrices too."
        )
    rows.values = matrix_rows(turned, positions)
    return rows


def _ordered(rows: Rows, elements: np.ndarray, turned: np.ndarray) -> np.ndarray:
    """Matrices (N, 3, 3) in the order in which they equal the matrices of the angles."""
    by_column = elements.swapaxes(1, 2)
    whole = np.isfinite(elements).all(axis=(1, 2)) & np.isfinite(turned).all(axis=(1, 2))
    if not whole.any():
        return by_column
    errors = [np.median(np.abs(each - turned)[whole].max(axis=(1, 2))) for each in (by_column, elements)]
    if min(errors) > _AGREES:
        rows.notes.append(
            "the angles do not have the convention Qualisys standard; the matrices are read column by column."
        )
    elif errors[1] < errors[0]:
        rows.notes.append("the matrices are read row by row, because the angles show this order.")
        return elements
    return by_column


def _read_header(path: Path) -> tuple[dict[str, str], dict[str, range], int | None, int, Lines]:
    """Return the names and values, the columns of every body and of the time, the width, and the rows."""
    lines = read_cells(path, "\t")
    about: dict[str, list[str]] = {}
    for number, cells in lines:  # noqa: B007
        if len(about) > _MOST_HEADINGS or not re.fullmatch(r"[A-Z][A-Z0-9_]+", cells[0]):
            break
        about[cells[0]] = [cell for cell in cells[1:] if cell]
    else:
        number, cells = 0, []
    names, single = about.get("BODY_NAMES", []), {key: " ".join(cells) for key, cells in about.items()}
    count = single.get("NO_OF_BODIES", "")
    if not count.isdecimal() or not cells:
        raise RecordingError(
            f"{path}: expected a 6DOF export with NO_OF_BODIES and rows of numbers, found "
            f"{shown(single.get('DATA_INCLUDED', ''), 40) or 'no data'}; export 6D data as TSV."
        )
    if all(is_number(cell) for cell in cells if cell):
        first, size = len(cells) - _FULL * int(count), _FULL
        first -= first % 2 and not cells[-1]  # a tab at the end of the rows
        starts = [first + i * _FULL for i in range(len(names))] if first in (0, 2) else []
        time = 1 if first else None
        lines = chain([(number, cells)], lines)
    else:  # titles, which may start with the name of the body
        last = [re.split("[ _.:]", title)[-1] for title in cells]
        starts = [i for i in range(len(last) - 6) if last[i : i + 3] == ["X", "Y", "Z"]]
        full = all(last[i + 7 : i + 16] == [f"Rot[{k}]" for k in range(9)] for i in starts)
        size = _FULL if full else _ANGLES_ONLY
        time = cells.index("Time") if "Time" in cells else None
    bodies = {name: range(start, start + size) for name, start in zip(names, starts, strict=False)}
    if len(bodies) != int(count) or len(names) != int(count):
        raise RecordingError(
            f"{path}: expected {count} BODY_NAMES and {_FULL} columns of each body, X to Rot[8]; found "
            f"{len(names)} names and {len(cells)} columns."
        )
    return single, bodies, time, len(cells), lines


def _contents(path: Path) -> list[Entry]:
    about, bodies, *_ = _read_header(path)
    detail = f"rigid body, {shown(about.get('FREQUENCY', '?'), 20)} Hz"
    return [Entry("body", name, detail) for name in bodies]


QUALISYS = Reader(
    name="a TSV export of Qualisys Track Manager",
    suffixes=(".tsv",),
    recognises=lambda path, head: head.startswith((b"FILE_VERSION\t", b"NO_OF_FRAMES\t")),
    read=read_qualisys,
    options=frozenset({"body", "in_body"}),
    contents=_contents,
)

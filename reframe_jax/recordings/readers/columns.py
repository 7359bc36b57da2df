"""Columns of data sets that the user names: which numbers they select, and the poses that they make."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from reframe_jax.recordings.conventions import angle_matrices
from reframe_jax.recordings.readers.collecting import matrix_rows
from reframe_jax.recordings.readers.reader import Entry
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import Rows, shown
from reframe_jax.recordings.selection import Selection, flag

__all__ = ["Column", "column_entries", "find_columns", "set_poses"]

_WIDTHS = (3, 3), (3, 4), (3, 9), (0, 12), (0, 16)  # numbers of a position and of an orientation
_LISTED = 30  # columns in a message
_MOST = 200  # columns that are listed on request


class Column(NamedTuple):
    """A column, or some of its numbers.

    Attributes:
        name: of the column.
        part: the numbers of each row that are taken; all by default.
    """

    name: str
    part: slice = slice(None)


def find_columns(path: Path, wanted: Selection, names: Sequence[str]) -> tuple[list[Column], list[Column]]:
    """The columns of positions and of orientations: ``NAME``, ``NAME[0:3]``, or several with commas.

    Raises:
        RecordingError: if one is not given, or not in the file; the message lists those that are.
    """
    listed = ", ".join(shown(name, 80) for name in names[:_LISTED]) + (", ..." if names[_LISTED:] else "")
    if wanted.position is None or wanted.orientation is None:
        raise RecordingError(
            f"{path}: name its columns, {flag('position')} and {flag('orientation')}: "
            f"{listed or 'it has none'}."
        )
    found: tuple[list[Column], list[Column]] = ([], [])
    for columns, text in zip(found, (wanted.position, wanted.orientation), strict=True):
        for word in [text] if text in names else text.split(","):
            match = re.fullmatch(r"(.+?)\[(\d+):(\d+)\]", word.strip())
            name = match[1] if match else word.strip()
            part = slice(int(match[2]), int(match[3])) if match else slice(None)
            if name not in names:
                raise RecordingError(
                    f"{path}: has no column {shown(name, 80)!r}; columns: {listed or 'none'}."
                )
            columns.append(Column(name, part))
    return found


def set_poses(
    rows: Rows,
    positions: np.ndarray,
    orientations: np.ndarray,
    wanted: Selection,
    stated: float | None = None,
    named: bool = True,
) -> None:
    """Set the values of rows to poses of columns.

    Args:
        rows: the rows.
        positions: (N, 3); (N, 0) of whole matrices.
        orientations: (N, 4) quaternions, whose order is applied by reading, (N, 3) angles, or (N, 9)
            matrices, row by row; (N, 12) or (N, 16) whole matrices.
        wanted: the meaning of angles, and their unit.
        stated: the unit of angles in rad, if the file states it.
        named: whether the user named the columns, in the order that is meant. Others give the order of a
            quaternion by their names, and have three angles as x, y, z.

    Raises:
        RecordingError: if the widths do not fit, or the order or meaning is not given.
    """
    width = orientations.shape[1]
    if (positions.shape[1], width) not in _WIDTHS:
        raise RecordingError(
            f"{rows.path}: expected 3 numbers of a position, and 4 (quaternion), 3 (angles) or 9 (matrix) of "
            f"an orientation; found {positions.shape[1]} and {width}; select some, such as NAME[0:3] or "
            "A,B,C."
        )
    needed = {4: "quaternion", 3: "angles"}.get(width)
    if named and needed is not None and getattr(wanted, needed) is None:
        raise RecordingError(
            f"{rows.path}: does not say how its {width} numbers are meant; give {flag(needed)}."
        )
    for option, its_width in (("quaternion", 4), ("angles", 3), ("angle_unit", 3)):
        if width != its_width and getattr(wanted, option) is not None:
            raise RecordingError(
                f"{rows.path}: has {width} numbers of an orientation; leave out {flag(option)}."
            )
    if width == 3:
        if not named and wanted.angles != "vector":
            orientations = orientations[:, ["xyz".index(axis) for axis in str(wanted.angles).lower()]]
        rows.angles = orientations if stated is None else None
        orientations = angle_matrices(rows.path, orientations, wanted, stated)
    if width in (3, 9):
        rows.values = matrix_rows(orientations.reshape(-1, 3, 3), positions)
    else:
        rows.values = np.hstack([positions, orientations])


def column_entries(columns: Sequence[tuple[str, int, str]]) -> list[Entry]:
    """Columns as options of reading, of their names, widths and details."""
    found = [
        Entry("orientation" if width in (4, 9) else "position", name, detail)
        for name, width, detail in columns[:_MOST]
    ]
    if len(columns) > _MOST:
        found.append(Entry("position", "...", f"and {len(columns) - _MOST} more columns"))
    return found

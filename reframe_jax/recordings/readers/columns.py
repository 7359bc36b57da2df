"""Columns that the user names, and poses from columns."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from reframe_jax.recordings.conventions import read_angles
from reframe_jax.recordings.readers.reader import Entry, matrix_rows
from reframe_jax.recordings.recording import RecordingError, Rows, listed, shown
from reframe_jax.recordings.selection import Selection, flag

OPTIONS = frozenset({"position", "orientation", "quaternion", "angles", "angle_unit", "unit"})
_WIDTHS = (3, 3), (3, 4), (3, 9), (0, 12), (0, 16)  # numbers of a position and of an orientation
_MOST = 200  # columns in a list of contents


class Column(NamedTuple):
    """A column, or a part of the numbers in each row of a column."""

    name: str
    part: slice = slice(None)


def find_columns(path: Path, wanted: Selection, names: Sequence[str]) -> tuple[list[Column], list[Column]]:
    """Find the columns of positions and of orientations: ``NAME``, ``NAME[0:3]``, or several with commas."""
    if wanted.position is None or wanted.orientation is None:
        both = f"{flag('position')} and {flag('orientation')}"
        raise RecordingError(f"{path}: name its columns, {both}: {listed(names, 30)}.")
    found: tuple[list[Column], list[Column]] = ([], [])
    for columns, text in zip(found, (wanted.position, wanted.orientation), strict=True):
        for word in [text] if text in names else text.split(","):
            match = re.fullmatch(r"(.+?)\[(\d+):(\d+)\]", word.strip())
            name = match[1] if match else word.strip()
            if name not in names:
                present = listed(names, 30)
                raise RecordingError(f"{path}: has no column {shown(name, 80)!r}; columns: {present}.")
            columns.append(Column(name, slice(int(match[2]), int(match[3])) if match else slice(None)))
    return found


def set_poses(
    rows: Rows,
    positions: np.ndarray,
    orientations: np.ndarray,
    wanted: Selection,
    stated: float | None = None,
    named: bool = True,
) -> None:
    """Set the values of rows to poses from columns, whose widths and options are checked.

    The positions are (N, 3). The orientations are (N, 4) quaternions as x y z w, (N, 3) angles in a unit that
    the file may have ``stated``, in rad, or (N, 9) matrices, row by row. Whole matrices are (N, 0) and (N,
    12) or (N, 16). Unless the user ``named`` the columns, their names gave the order of quaternions, and
    angles are in the order x, y, z.
    """
    width = orientations.shape[1]
    if (positions.shape[1], width) not in _WIDTHS:
        raise RecordingError(
            f"{rows.path}: expected 3 numbers of a position, and 4 (quaternion), 3 (angles) or 9 (matrix) of "
            f"an orientation; found {positions.shape[1]} and {width}; select some, such as NAME[0:3] or "
            "A,B,C."
        )
    for option, its_width in (("quaternion", 4), ("angles", 3), ("angle_unit", 3)):
        given = getattr(wanted, option) is not None
        if named and width == its_width and option != "angle_unit" and not given:
            raise RecordingError(
                f"{rows.path}: does not state the meaning of the {width} numbers of an orientation; give "
                f"{flag(option)}."
            )
        if width != its_width and given:
            raise RecordingError(f"{rows.path}: has {width} orientation numbers; leave out {flag(option)}.")
    if width == 3:
        rows.angles = read_angles(rows.path, orientations, wanted, stated, by_axis=not named)
        orientations = rows.angles.matrices()
    if width in (3, 9):
        rows.values = matrix_rows(orientations.reshape(-1, 3, 3), positions)
    else:
        rows.values = np.hstack([positions, orientations])


def column_entries(columns: Sequence[tuple[str, int, str]]) -> list[Entry]:
    """List columns, given by name, width and detail, for :func:`list_contents`."""
    found = [
        Entry("orientation" if width in (4, 9) else "position", name, detail)
        for name, width, detail in columns[:_MOST]
    ]
    if len(columns) > _MOST:
        found.append(Entry("position", "...", f"and {len(columns) - _MOST} more columns"))
    return found

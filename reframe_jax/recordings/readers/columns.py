"""Columns of data sets that the user names: which numbers they select, and the poses that they make."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from reframe_jax.recordings.conventions import angle_matrices
from reframe_jax.recordings.readers.exports import matrix_rows
from reframe_jax.recordings.readers.reader import Entry
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import Rows, shown
from reframe_jax.recordings.selection import Selection, flag

__all__ = ["Column", "column_entries", "find_columns", "pose_rows"]

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


def pose_rows(
    path: Path,
    positions: np.ndarray,
    orientations: np.ndarray,
    times: np.ndarray | None,
    wanted: Selection,
    no_times: str,
) -> Rows:
    """Poses of columns.

    Args:
        path: the file.
        positions: (N, 3).
        orientations: (N, 4) quaternions, (N, 3) angles, or (N, 9) matrices, row by row.
        times: (N,) s, or None.
        wanted: the order of quaternions and the meaning of angles, needed for these; the unit of angles.
        no_times: what gives the times if there are none.

    Raises:
        RecordingError: if the widths do not fit, or the order or meaning is not given.
    """
    width = orientations.shape[1]
    if positions.shape[1] != 3 or width not in (3, 4, 9):
        raise RecordingError(
            f"{path}: expected 3 numbers of a position, and 4 (quaternion), 3 (angles) or 9 (matrix) of an "
            f"orientation; found {positions.shape[1]} and {width}; select some, such as NAME[0:3]."
        )
    needed = {4: "quaternion", 3: "angles"}.get(width)
    if wanted.angle_unit is not None and width != 3:
        raise RecordingError(
            f"{path}: has {width} numbers of an orientation; leave out {flag('angle_unit')}."
        )
    for option in ("quaternion", "angles"):
        given = getattr(wanted, option) is not None
        if option == needed and not given:
            raise RecordingError(
                f"{path}: does not say how its {width} numbers are meant; give {flag(option)}."
            )
        if option != needed and given:
            raise RecordingError(f"{path}: has {width} numbers of an orientation; leave out {flag(option)}.")
    if width == 4:
        values = np.column_stack([positions, orientations])  # whose order is applied by reading
    elif width == 3:
        values = matrix_rows(angle_matrices(path, orientations, wanted), positions)
    else:
        values = matrix_rows(orientations.reshape(-1, 3, 3), positions)
    return Rows(
        path,
        "sample",
        np.arange(len(values)),
        values,
        times,
        angles=orientations if width == 3 else None,
        no_times=no_times,
    )


def column_entries(columns: Sequence[tuple[str, int, str]]) -> list[Entry]:
    """Columns as options of reading, of their names, widths and details."""
    found = [
        Entry("orientation" if width in (4, 9) else "position", name, detail)
        for name, width, detail in columns[:_MOST]
    ]
    if len(columns) > _MOST:
        found.append(Entry("position", "...", f"and {len(columns) - _MOST} more columns"))
    return found

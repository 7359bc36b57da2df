"""Data sets of HDF5 files, such as those of robomimic; the user names them."""

from pathlib import Path
from typing import Any

import numpy as np

from reframe_jax.recordings.readers.columns import OPTIONS, Column, column_entries, find_columns, set_poses
from reframe_jax.recordings.readers.reader import Entry, Reader, import_extra, translate_errors
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import Rows, check_size
from reframe_jax.recordings.selection import Selection

_WHOLE = "a whole HDF5 file"
_NO_TIMES = "times in HDF5 files are not read: give the sample time, dt (--dt)"


def read_hdf5(path: Path, wanted: Selection) -> Rows:
    """Read poses from the named data sets, without times; see :class:`Reader`."""
    library = import_extra(path, "h5py", "hdf5")
    with translate_errors(path, _WHOLE), library.File(path, "r") as file:
        sets = _sets(library, file)
        chosen = find_columns(path, wanted, [*sets])
        counts = {len(sets[column.name]) for columns in chosen for column in columns}
        if len(counts) > 1:
            lengths = ", ".join(map(str, sorted(counts)))
            raise RecordingError(f"{path}: expected data sets of the same length; found {lengths}.")
        check_size(path, *counts)
        positions, orientations = (
            np.hstack([_numbers(sets[column.name], column) for column in columns]) for columns in chosen
        )
    rows = Rows(path, "sample", np.arange(len(positions)), positions, None, no_times=_NO_TIMES)
    set_poses(rows, positions, orientations, wanted)
    return rows


def _sets(library: Any, file: Any) -> dict[str, Any]:
    """Return the data sets of numbers by their paths."""
    found: dict[str, Any] = {}

    def visit(name: str, thing: Any) -> None:
        if isinstance(thing, library.Dataset) and thing.dtype.kind in "fiu" and thing.ndim in (1, 2, 3):
            found[name] = thing

    file.visititems(visit)
    return found


def _numbers(data: Any, column: Column) -> np.ndarray:
    """Read some columns of all rows, (N, k).

    Of more than nine columns nothing is read: the result is an empty array of that shape, and the later check
    reports its width.
    """
    if data.ndim != 2:
        matrices = data.ndim == 3 and data.shape[1:] == (3, 3)
        shape = len(data), 9 if matrices else int(data.ndim == 1)
        return np.asarray(data[()], float).reshape(shape)[:, column.part] if shape[1] else np.empty(shape)
    wanted = range(*column.part.indices(data.shape[1]))
    return np.asarray(data[:, column.part], float) if len(wanted) <= 9 else np.empty((len(data), len(wanted)))


def _contents(path: Path) -> list[Entry]:
    library = import_extra(path, "h5py", "hdf5")
    with translate_errors(path, _WHOLE), library.File(path, "r") as file:
        return column_entries(
            [
                (name, int(np.prod(data.shape[1:])), f"{data.shape} {data.dtype}")
                for name, data in _sets(library, file).items()
                if data.ndim < 3 or data.shape[1:] == (3, 3)
            ]
        )


HDF5 = Reader(
    name="an HDF5 file",
    suffixes=(".hdf5", ".h5"),
    recognises=lambda path, head: head.startswith(b"\x89HDF\r\n\x1a\n"),
    read=read_hdf5,
    options=OPTIONS,
    contents=_contents,
)

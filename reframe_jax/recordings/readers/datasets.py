"""Columns of Parquet files, such as those of LeRobot, and of HDF5 files, such as those of robomimic.

The user names the columns; in HDF5 files, a column is a data set.
"""

from pathlib import Path
from typing import Any

import numpy as np

from reframe_jax.recordings.readers.arrays import since_first
from reframe_jax.recordings.readers.columns import OPTIONS, Column, column_entries, find_columns, set_poses
from reframe_jax.recordings.readers.reader import Entry, Reader, import_extra, translate_errors
from reframe_jax.recordings.recording import RecordingError, Rows, check_size, listed, shown
from reframe_jax.recordings.selection import Selection, flag

_WHOLE_PARQUET, _WHOLE_HDF5 = "a whole Parquet file", "a whole HDF5 file"
_TIME, _EPISODE = Column("timestamp"), Column("episode_index")  # names in LeRobot
_NO_TIMES = "name the column of times timestamp, or give the sample time, dt (--dt)"
_NO_TIMES_IN_SETS = "times in HDF5 files are not read: give the sample time, dt (--dt)"
_BATCH = 2**14  # rows


def read_parquet(path: Path, wanted: Selection) -> Rows:
    """Read poses from the named columns, and times from ``timestamp``, s; see :class:`Reader`."""
    library = import_extra(path, "pyarrow.parquet", "parquet")
    with translate_errors(path, _WHOLE_PARQUET), library.ParquetFile(path) as file:
        names = file.schema_arrow.names
        chosen = find_columns(path, wanted, names)
        timed, numbered = _TIME.name in names, _EPISODE.name in names
        if wanted.episode is not None and not numbered:
            raise RecordingError(f"{path}: has no column {_EPISODE.name}; leave out {flag('episode')}.")
        groups = [*chosen, *([[_TIME]] if timed else [])]
        every = [column for group in groups for column in group] + ([_EPISODE] if numbered else [])
        parts: list[list[np.ndarray]] = [[] for _ in groups]
        episodes: set[int] = set()
        where: list[np.ndarray] = []
        count = place = 0
        for batch in file.iter_batches(_BATCH, columns=list(dict.fromkeys(each.name for each in every))):
            kept = np.ones(len(batch), bool)
            if numbered:
                number = _numbers_of_batch(path, batch, _EPISODE)[:, 0]
                episodes |= set(number.astype(int).tolist())
                kept = kept if wanted.episode is None else number == wanted.episode
            where.append(np.flatnonzero(kept) + place)
            count, place = count + len(where[-1]), place + len(batch)
            check_size(path, count)
            for group, part in zip(groups, parts, strict=True):
                part.append(np.hstack([_numbers_of_batch(path, batch, column)[kept] for column in group]))
    if (wanted.episode is None and len(episodes) > 1) or (wanted.episode not in (None, *episodes)):
        numbers = listed(map(str, sorted(episodes)), 10)
        raise RecordingError(f"{path}: contains the episodes {numbers}; name one, {flag('episode')}.")
    if not count:
        raise RecordingError(f"{path}: has no rows.")
    arrays = [np.concatenate(part) for part in parts]
    times, origin = since_first(arrays[2][:, 0]) if timed else (None, None)
    rows = Rows(path, "sample", np.concatenate(where), arrays[0], times, origin, no_times=_NO_TIMES)
    set_poses(rows, arrays[0], arrays[1], wanted)
    return rows


def _numbers_of_batch(path: Path, batch: Any, column: Column) -> np.ndarray:
    """Return some numbers of each row of a batch, (N, k); NaN where a number is missing."""
    cells = batch.column(column.name)
    kind, flat = str(cells.type), cells
    if "list<" in kind:
        flat = cells.flatten()
        if cells.null_count or len(flat) % max(len(cells), 1):
            raise RecordingError(f"{path}: the lists of {shown(column.name, 80)} have different lengths.")
    if not any(word in str(flat.type) for word in ("float", "double", "int")) or "list<" in str(flat.type):
        raise RecordingError(f"{path}: expected numbers in {shown(column.name, 80)}, not {shown(kind, 80)}.")
    return flat.to_numpy(zero_copy_only=False).astype(float).reshape(len(cells), -1)[:, column.part]


def _list_columns(path: Path) -> list[Entry]:
    library = import_extra(path, "pyarrow.parquet", "parquet")
    with translate_errors(path, _WHOLE_PARQUET), library.ParquetFile(path) as file:
        rows = file.metadata.num_rows
        columns = [
            (each.name, getattr(each.type, "list_size", 1), f"{each.type}, {rows} rows")
            for each in file.schema_arrow
            if any(word in str(each.type) for word in ("float", "double"))
        ]
        return column_entries(columns)


PARQUET = Reader(
    name="a Parquet file",
    suffixes=(".parquet",),
    recognises=lambda path, head: head.startswith(b"PAR1"),
    read=read_parquet,
    options=OPTIONS | {"episode", "time_unit"},
    contents=_list_columns,
)


def read_hdf5(path: Path, wanted: Selection) -> Rows:
    """Read poses from the named data sets, without times; see :class:`Reader`."""
    library = import_extra(path, "h5py", "hdf5")
    with translate_errors(path, _WHOLE_HDF5), library.File(path, "r") as file:
        sets = _sets(library, file)
        chosen = find_columns(path, wanted, [*sets])
        counts = {len(sets[column.name]) for columns in chosen for column in columns}
        if len(counts) > 1:
            lengths = ", ".join(map(str, sorted(counts)))
            raise RecordingError(f"{path}: expected data sets of the same length; found {lengths}.")
        check_size(path, *counts)
        positions, orientations = (
            np.hstack([_numbers_of_set(sets[column.name], column) for column in columns])
            for columns in chosen
        )
    rows = Rows(path, "sample", np.arange(len(positions)), positions, None, no_times=_NO_TIMES_IN_SETS)
    set_poses(rows, positions, orientations, wanted)
    return rows


def _sets(library: Any, file: Any) -> dict[str, Any]:
    """Return the data sets of numbers by their paths."""
    things: list[tuple[str, Any]] = []
    file.visititems(lambda *named: things.append(named))
    sets = {name: thing for name, thing in things if isinstance(thing, library.Dataset)}
    return {name: each for name, each in sets.items() if each.dtype.kind in "fiu" and each.ndim in (1, 2, 3)}


def _numbers_of_set(data: Any, column: Column) -> np.ndarray:
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


def _list_sets(path: Path) -> list[Entry]:
    library = import_extra(path, "h5py", "hdf5")
    with translate_errors(path, _WHOLE_HDF5), library.File(path, "r") as file:
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
    contents=_list_sets,
)

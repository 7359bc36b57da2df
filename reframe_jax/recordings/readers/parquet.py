"""Columns of Parquet files, such as those of LeRobot; the user names them."""

from pathlib import Path
from typing import Any

import numpy as np

from reframe_jax.recordings.readers.columns import OPTIONS, Column, column_entries, find_columns, set_poses
from reframe_jax.recordings.readers.reader import Entry, Reader, import_extra, translate_errors
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import Rows, check_size, listed, shown
from reframe_jax.recordings.selection import Selection, flag

_WHOLE = "a whole Parquet file"
_TIME, _EPISODE = Column("timestamp"), Column("episode_index")  # names in LeRobot
_NO_TIMES = "name the column of times timestamp, or give the sample time, dt (--dt)"
_BATCH = 2**14  # rows


def read_parquet(path: Path, wanted: Selection) -> Rows:
    """Read poses from the named columns, and times from ``timestamp``, s; see :class:`Reader`."""
    library = import_extra(path, "pyarrow.parquet", "parquet")
    with translate_errors(path, _WHOLE), library.ParquetFile(path) as file:
        names = file.schema_arrow.names
        chosen = find_columns(path, wanted, names)
        timed, numbered = _TIME.name in names, _EPISODE.name in names
        if wanted.episode is not None and not numbered:
            raise RecordingError(f"{path}: has no column {_EPISODE.name}; leave out {flag('episode')}.")
        groups = [*chosen, *([[_TIME]] if timed else [])]
        every = [column for group in groups for column in group] + ([_EPISODE] if numbered else [])
        parts: list[list[np.ndarray]] = [[] for _ in groups]
        episodes: set[int] = set()
        count = 0
        for batch in file.iter_batches(_BATCH, columns=list(dict.fromkeys(each.name for each in every))):
            kept = np.ones(len(batch), bool)
            if numbered:
                number = _numbers(path, batch, _EPISODE)[:, 0]
                episodes |= set(number.astype(int).tolist())
                kept = kept if wanted.episode is None else number == wanted.episode
            count += int(kept.sum())
            check_size(path, count)
            for group, part in zip(groups, parts, strict=True):
                part.append(np.hstack([_numbers(path, batch, column)[kept] for column in group]))
    if (wanted.episode is None and len(episodes) > 1) or (wanted.episode not in (None, *episodes)):
        numbers = listed(map(str, sorted(episodes)), 10)
        raise RecordingError(f"{path}: contains the episodes {numbers}; name one, {flag('episode')}.")
    if not count:
        raise RecordingError(f"{path}: has no rows.")
    arrays = [np.concatenate(part) for part in parts]
    times = arrays[2][:, 0] if timed else None
    rows = Rows(path, "sample", np.arange(count), arrays[0], times, no_times=_NO_TIMES)
    set_poses(rows, arrays[0], arrays[1], wanted)
    return rows


def _numbers(path: Path, batch: Any, column: Column) -> np.ndarray:
    """Return some numbers of each row of a batch, (N, k); NaN where a number is missing."""
    cells = batch.column(column.name)
    kind, flat = str(cells.type), cells
    if "list<" in kind:
        flat = cells.flatten()
        if cells.null_count or len(flat) % max(len(cells), 1):
            raise RecordingError(f"{path}: the lists of {shown(column.name, 80)} have different lengths.")
    if not any(word in str(flat.type) for word in ("float", "double", "int")) or "list<" in str(flat.type):
        raise RecordingError(
            f"{path}: expected numbers in {shown(column.name, 80)}, found {shown(kind, 80)}."
        )
    values = flat.to_numpy(zero_copy_only=False).astype(float)
    return values.reshape(len(cells), -1)[:, column.part]


def _contents(path: Path) -> list[Entry]:
    library = import_extra(path, "pyarrow.parquet", "parquet")
    with translate_errors(path, _WHOLE), library.ParquetFile(path) as file:
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
    contents=_contents,
)

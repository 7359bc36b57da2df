"""Any number of windows, from disk to disk: in bounded memory, resumable, spread over machines.

:func:`identify_many` cuts the windows into parts, identifies one after the other and writes each as one
Parquet file. A part is on disk whole or not at all, so a run that was killed goes on where it stopped,
and machines that share a disk can share the parts.
"""

import json
import os
import secrets
import sys
import time
import zlib
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import count, islice
from pathlib import Path
from typing import Any

import jax
import numpy as np

import reframe_jax
from reframe_jax.identification.classify import Thresholds
from reframe_jax.identification.entry import default_solver, identify
from reframe_jax.identification.results import (
    AllCandidates,
    AngularFrame,
    Candidates,
    Identification,
    LinearFrame,
)

__all__ = ["identify_many", "load_results"]

Progress = Callable[[int, int | None], None]

_RUN = "run.json"
_FORMAT = 3
_BAR = 20  # characters


def identify_many(
    windows: Any,
    out: str | Path,
    *,
    times: Any = None,
    dt: Any = None,
    part_size: int = 8192,
    parts: Iterable[int] | None = None,
    progress: Progress | bool | None = None,
    **options: Any,
) -> Path:
    """Identify any number of windows and write the results to a folder, resuming what is there.

    Memory is bounded by the part: some 200 MB above the input at 8192 windows of 51 poses. Results are
    those of :func:`identify`, whatever the part size. A run that was killed at any moment loses the part
    it was working on, nothing else; call it again with the same arguments to go on.

    Args:
        windows: (N, K+1, 4, 4) poses: an array, a memory-mapped one (``np.load(file, mmap_mode="r")``),
            a view by :func:`sliding_windows`; or any iterable of (K+1, 4, 4) windows.
        out: folder for the results, made if missing: one Parquet file per part and ``run.json``, the
            options. Read it with :func:`load_results`, or any Parquet reader.
        times: (K+1,) s, or (N, K+1) where the windows are an array.
        dt: sample time in s, a scalar, (K,), or (N, K) where the windows are an array.
        part_size: windows in a part.
        parts: numbers of the parts to do, all by default: gives every machine its share.
        progress: called with the windows done by this call and their number (None if unknown), after
            every part; True for a bar on standard error, the default where that is a terminal.
        **options: of :func:`identify`.

    Returns:
        The folder.

    Raises:
        ValueError: if the folder holds results of other windows or other options, or the input is not
            as above.
        ImportError: if pyarrow is missing (the extra ``parquet``).
    """
    _arrow()
    if part_size < 1:
        raise ValueError(f"part_size must be at least 1, not {part_size}.")
    folder = Path(out)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file; expected a folder for the results.")
    folder.mkdir(parents=True, exist_ok=True)
    total = len(windows) if _is_array(windows) else None
    wanted = None if parts is None else set(parts)
    _check_run(folder, total, part_size, options)
    report, rows, done, seen = _progress(progress), _row_count(total, part_size, wanted), 0, 0
    # one thread computes and writes a part while this one reads the next: no more than one is ever lost
    with ThreadPoolExecutor(1) as worker:
        pending: Future[int] | None = None
        for number, poses in _parts(windows, part_size, wanted):
            where = slice(number * part_size, number * part_size + len(poses))
            seen = where.stop
            if wanted is not None and number not in wanted:
                continue
            timing = {"times": _rows(times, where, total), "dt": _rows(dt, where, total)}
            file, checksum = folder / f"part-{number:08d}.parquet", _checksum(poses, timing)
            if pending is not None:
                report(done := done + pending.result(), rows)
            pending = worker.submit(_do_part, file, poses, timing, options, checksum)
        if pending is not None:
            report(done + pending.result(), rows)
    if total is None:
        _check_run(folder, seen, part_size, options)
    return folder


def load_results(folder: str | Path, parts: Iterable[int] | None = None) -> Identification:
    """The results in a folder written by :func:`identify_many`, as one batch of NumPy arrays.

    Args:
        folder: as given to :func:`identify_many`.
        parts: numbers of the parts to load, all by default: for results that do not fit in memory.

    Raises:
        ValueError: if the folder holds no results, or lacks some of what was asked for.
        ImportError: if pyarrow is missing.
    """
    parquet = _arrow().parquet
    stored = {int(file.stem.removeprefix("part-")): file for file in Path(folder).glob("part-*.parquet")}
    if not stored:
        raise ValueError(f"{folder} holds no results of identify_many (part-*.parquet).")
    wanted = list(_all_parts(Path(folder), max(stored)) if parts is None else parts)
    missing = [number for number in wanted if number not in stored]
    if missing:
        raise ValueError(
            f"{folder} is incomplete: {len(missing)} parts are missing, {missing[:8]} among them. "
            "Run identify_many again."
        )
    tables = [parquet.read_table(stored[number]) for number in wanted]
    columns: dict[str, Any] = {
        name: np.concatenate([_from_arrow(table.column(name)) for table in tables])
        for name in tables[0].column_names
    }

    def build(kind: Any, prefix: str) -> Any:
        return kind(
            **{
                name.removeprefix(prefix): column
                for name, column in columns.items()
                if name.startswith(prefix) and "." not in name.removeprefix(prefix)
            }
        )

    return Identification(
        angular=build(AngularFrame, "angular."),
        linear=build(LinearFrame, "linear."),
        candidates=AllCandidates(
            angular=build(Candidates, "candidates.angular."),
            linear=build(Candidates, "candidates.linear."),
        ),
        status_code=columns["status_code"],
    )


def _all_parts(folder: Path, last: int) -> range:
    """Numbers of the parts of a whole run; of an iterator that did not end, up to the last there is."""
    record = json.loads((folder / _RUN).read_text())
    windows = record["windows"]
    return range(last + 1 if windows is None else -(-windows // record["part_size"]))


def _row_count(total: int | None, size: int, wanted: set[int] | None) -> int | None:
    """Windows in the wanted parts; None if unknown."""
    if total is None or wanted is None:
        return total
    return sum(max(0, min(size, total - number * size)) for number in wanted if number >= 0)


def _do_part(
    file: Path, poses: np.ndarray, timing: dict[str, Any], options: dict[str, Any], checksum: int
) -> int:
    """Identify and write a part, unless it is there; returns its number of windows."""
    if file.exists():
        _check_part(file, checksum)
    else:
        _write(file, _identify(poses, timing, options), checksum)
    return len(poses)


def _identify(poses: Any, timing: dict[str, Any], options: dict[str, Any]) -> Identification:
    """Results on the host, in the precision of the poses whatever JAX is set to."""
    precise = np.asarray(poses[:0]).dtype != np.float32
    with jax.enable_x64(precise):
        return jax.device_get(identify(poses, **timing, **options))


def _arrow() -> Any:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise ImportError(
            "Results are stored as Parquet, which needs pyarrow: pip install 'reframe-jax[parquet]'"
        ) from error
    return pyarrow


def _is_array(windows: Any) -> bool:
    return hasattr(windows, "shape")


def _parts(windows: Any, size: int, wanted: set[int] | None) -> Iterator[tuple[int, np.ndarray]]:
    """Number and windows, (size, K+1, 4, 4), of every part; the last one may be smaller.

    Of an array only the wanted parts.
    """
    if _is_array(windows):
        for number in range(-(-len(windows) // size)):
            if wanted is None or number in wanted:
                yield number, windows[number * size : (number + 1) * size]
        return
    source = iter(windows)
    shape: tuple[int, ...] | None = None
    for number in count():
        batch = [np.asarray(window) for window in islice(source, size)]
        if not batch:
            return
        shape = batch[0].shape if shape is None else shape
        for i, window in enumerate(batch):
            if window.shape != shape:
                raise ValueError(
                    f"All windows must have one shape: window {number * size + i} has {window.shape}, "
                    f"window 0 has {shape}."
                )
        yield number, np.stack(batch)


def _rows(values: Any, rows: slice, total: int | None) -> Any:
    """The part's rows of times or dt, where every window has its own."""
    if values is None or np.ndim(values) < 2:
        return values
    if total is None or len(values) != total:
        raise ValueError(
            "times and dt of every window need the windows as an array, and as many rows as it has; "
            f"they have shape {np.shape(values)}."
        )
    return values[rows]


def _options_record(part_size: int, options: dict[str, Any]) -> dict[str, Any]:
    """What results depend on besides the windows; equal records give equal results."""
    norm = float(options.get("norm", 0.0))
    key = options.get("key")
    return {
        "format": _FORMAT,
        "version": reframe_jax.__version__,
        "part_size": part_size,
        "norm": str(norm),
        "discretization": options.get("discretization", "chord"),
        "thresholds": [float(t) for t in jax.tree.leaves(options.get("thresholds", Thresholds()))],
        "bounds": np.asarray(options.get("bounds", 1.0)).tolist(),
        "solver": repr(options.get("solver") or default_solver(norm)),
        "key": np.asarray(jax.random.key_data(jax.random.key(0) if key is None else key)).tolist(),
    }


def _check_run(folder: Path, total: int | None, part_size: int, options: dict[str, Any]) -> None:
    """Write the options of a new run, or compare with those of the run that is resumed.

    The number of windows is known at once of an array, and at the end of an iterator.
    """
    file, record = folder / _RUN, {"windows": total, **_options_record(part_size, options)}
    before = file.read_text() if file.exists() else None
    if before is not None:
        stored = json.loads(before)
        if total is None:
            record["windows"] = stored.get("windows")
        elif stored.get("windows") is None:
            stored["windows"] = total
        other = [name for name in record if stored.get(name) != record[name]]
        if other:
            raise ValueError(
                f"{folder} holds results of a run with other options ({', '.join(other)}). "
                "Give the options of that run to resume it, or another folder."
            )
    text = json.dumps(record, indent=1) + "\n"
    if text != before:
        _replace(file, lambda temporary: temporary.write_text(text))


def _checksum(poses: np.ndarray, timing: dict[str, Any]) -> int:
    """Of the bytes of a part's input: tells results of other windows from those to be resumed."""
    total = 0
    for values in (poses, *(v for v in timing.values() if v is not None)):
        rows = np.atleast_1d(np.asarray(values))
        for start in range(0, len(rows), 1024):  # sliding windows overlap: copying all takes memory
            total = zlib.crc32(np.ascontiguousarray(rows[start : start + 1024]).data, total)
    return total


def _check_part(file: Path, checksum: int) -> None:
    stored = _arrow().parquet.read_schema(file).metadata.get(b"input")
    if stored != str(checksum).encode():
        raise ValueError(
            f"{file} holds results of other windows. Give the same windows to resume, or another folder."
        )


def _write(file: Path, found: Identification, checksum: int) -> None:
    arrow = _arrow()
    columns = {
        ".".join(entry.name for entry in path): _to_arrow(np.asarray(leaf))
        for path, leaf in jax.tree_util.tree_leaves_with_path(found)
    }
    table = arrow.table(columns).replace_schema_metadata({"input": str(checksum)})
    _replace(file, lambda temporary: arrow.parquet.write_table(table, temporary))


def _replace(file: Path, write: Callable[[Path], Any]) -> None:
    """Write beside the file and rename: the file is there whole or not at all."""
    # process numbers repeat on machines that share a disk
    temporary = file.with_name(f".{file.name}.{secrets.token_hex(8)}")
    write(temporary)
    with temporary.open("rb+") as written:  # on the disk before its name is, should the power fail
        os.fsync(written.fileno())
    os.replace(temporary, file)


def _to_arrow(values: np.ndarray) -> Any:
    """(N, a, b, ...) as a column of N fixed-size lists of lists."""
    arrow = _arrow()
    column = arrow.array(np.ascontiguousarray(values).reshape(-1))
    for size in reversed(values.shape[1:]):
        column = arrow.FixedSizeListArray.from_arrays(column, size)
    return column


def _from_arrow(column: Any) -> np.ndarray:
    """The array that :func:`_to_arrow` made a column of."""
    values, shape = column.combine_chunks(), [len(column)]
    while hasattr(values.type, "list_size"):
        shape.append(values.type.list_size)
        values = values.flatten()
    return np.asarray(values.to_numpy(zero_copy_only=False)).reshape(shape)


def _progress(progress: Progress | bool | None) -> Progress:
    if callable(progress):
        return progress
    if progress is False or (progress is None and not sys.stderr.isatty()):
        return lambda done, total: None
    begin = time.perf_counter()

    def show(done: int, total: int | None) -> None:
        rate = done / (time.perf_counter() - begin)
        line = f"{done} windows, {rate:.0f}/s"
        if total is not None:
            filled = _BAR * done // total
            bar = "#" * filled + "-" * (_BAR - filled)
            line = f"[{bar}] {done} of {total} windows, {rate:.0f}/s, {(total - done) / rate:.0f} s left"
        print(f"\r{line}  ", end="\n" if done == total else "", file=sys.stderr, flush=True)

    return show

"""Any number of windows, from disk to disk: in bounded memory, resumable, spread over machines.

:func:`identify_many` cuts the windows into parts, identifies one after the other and writes each as one
Parquet file. A part is on disk whole or not at all, so a run that was killed goes on where it stopped,
and machines that share a disk can share the parts.
"""

import json
import os
import sys
import time
import zlib
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from typing import Any

import jax
import numpy as np

import reframe_jax
from reframe_jax.classify import Thresholds
from reframe_jax.identify import default_solver, identify
from reframe_jax.results import AllCandidates, AngularFrame, Candidates, Identification, LinearFrame

__all__ = ["identify_many", "load_results"]

Progress = Callable[[int, int | None], None]

_RUN = "run.json"
_FORMAT = 1


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

    Memory is bounded by the part: some 100 MB above the input at 8192 windows of 51 poses. Results are
    those of :func:`identify`, whatever the part size.

    Args:
        windows: (N, K+1, 4, 4) poses: an array, a memory-mapped one (``np.load(file, mmap_mode="r")``),
            a view by :func:`sliding_windows`; or any iterable of (K+1, 4, 4) windows.
        out: folder for the results, made if missing: one Parquet file per part and ``run.json``, the
            options. Read it with :func:`load_results`, or any Parquet reader.
        times: (K+1,) s, or (N, K+1) where the windows are an array.
        dt: sample time in s, a scalar, (K,), or (N, K) where the windows are an array.
        part_size: windows in a part.
        parts: numbers of the parts to do, all by default: gives every machine its share.
        progress: called with the windows done and their number (None if unknown); True for a line on
            standard error, the default where that is a terminal.
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
    folder.mkdir(parents=True, exist_ok=True)
    _check_run(folder, part_size, options)
    wanted = None if parts is None else set(parts)
    report = _progress(progress)
    total = len(windows) if _is_array(windows) else None
    done = 0
    with ThreadPoolExecutor(1) as writer:  # writes a part while the next one is computed
        pending: Future[None] | None = None
        for number, poses in enumerate(_parts(windows, part_size)):
            rows = slice(done, done + len(poses))
            done += len(poses)
            if wanted is not None and number not in wanted:
                continue
            timing = {"times": _rows(times, rows, total), "dt": _rows(dt, rows, total)}
            file, checksum = folder / f"part-{number:08d}.parquet", _checksum(poses, timing)
            if file.exists():
                _check_part(file, checksum)
            else:
                found = _identify(poses, timing, options)
                if pending is not None:
                    pending.result()
                pending = writer.submit(_write, file, found, checksum)
            report(done, total)
        if pending is not None:
            pending.result()
    return folder


def load_results(folder: str | Path) -> Identification:
    """The results in a folder written by :func:`identify_many`, as one batch of NumPy arrays.

    Raises:
        ValueError: if the folder holds no results, or parts between the first and the last are missing.
        ImportError: if pyarrow is missing.
    """
    parquet = _arrow().parquet
    files = sorted(Path(folder).glob("part-*.parquet"))
    if not files:
        raise ValueError(f"{folder} holds no results of identify_many (part-*.parquet).")
    numbers = [int(file.stem.removeprefix("part-")) for file in files]
    missing = sorted(set(range(numbers[-1] + 1)) - set(numbers))
    if missing:
        raise ValueError(f"{folder} is incomplete: parts {missing[:8]} are missing. Run identify_many again.")
    tables = [parquet.read_table(file) for file in files]
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


def _parts(windows: Any, size: int) -> Iterator[np.ndarray]:
    """The windows in batches of (size, K+1, 4, 4); the last one may be smaller."""
    if _is_array(windows):
        for start in range(0, len(windows), size):
            yield windows[start : start + size]
        return
    source, seen = iter(windows), 0
    while batch := [np.asarray(window) for window in islice(source, size)]:
        for i, window in enumerate(batch):
            if window.shape != batch[0].shape:
                raise ValueError(
                    f"All windows must have one shape: window {seen + i} has {window.shape}, "
                    f"window {seen} has {batch[0].shape}."
                )
        seen += len(batch)
        yield np.stack(batch)


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


def _check_run(folder: Path, part_size: int, options: dict[str, Any]) -> None:
    """Write the options of a new run, or compare with those of the run that is resumed."""
    file, record = folder / _RUN, _options_record(part_size, options)
    if file.exists():
        stored = json.loads(file.read_text())
        other = [name for name in record if stored.get(name) != record[name]]
        if other:
            raise ValueError(
                f"{folder} holds results of a run with other options ({', '.join(other)}). "
                "Give the options of that run to resume it, or another folder."
            )
    else:
        _replace(file, lambda temporary: temporary.write_text(json.dumps(record, indent=1) + "\n"))


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
    temporary = file.with_name(f".{file.name}.{os.getpid()}")
    write(temporary)
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
        of = "" if total is None else f" of {total}"
        left = "" if total is None else f", {(total - done) / rate:.0f} s left"
        end = "\n" if done == total else ""
        print(f"\r{done}{of} windows, {rate:.0f}/s{left}  ", end=end, file=sys.stderr, flush=True)

    return show

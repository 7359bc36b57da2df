"""Identify any number of windows with bounded memory, resumable and on several machines.

:func:`identify_many` divides the windows into parts, identifies each part and writes it as one Parquet file,
with the guarantees of :mod:`reframe_jax.storage.parts`. A killed run resumes with the first missing part.
Machines with a common disk can compute different parts.
"""

from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import MISSING, fields, is_dataclass
from itertools import count, islice
from operator import index
from pathlib import Path
from typing import Any, Unpack, get_type_hints

import jax
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.identification.entry import identify
from reframe_jax.identification.options import IdentifyOptions
from reframe_jax.identification.results import Identification
from reframe_jax.storage.parts import PARQUET, Run
from reframe_jax.storage.progress import Progress, make_meter
from reframe_jax.storage.records import checksum, describe_options

_KIND = "results of identify_many"
_UNIT = "windows"
_LISTED = 8  # largest number of missing parts in a message


def identify_many(
    windows: "ArrayLike | Iterable[ArrayLike]",
    out: str | Path,
    *,
    times: "ArrayLike | None" = None,
    dt: "ArrayLike | None" = None,
    part_size: int = 8192,
    parts: Iterable[int] | None = None,
    progress: Progress | bool | None = None,
    **options: Unpack[IdentifyOptions],
) -> Path:
    """Identify any number of windows, write the results to a folder, and resume an interrupted run.

    The part size limits the memory: about 200 MB in addition to the input for 8192 windows of 51 poses. The
    results equal those of :func:`identify` for any part size. Another compiled program computes the result of
    a single window: its rounding errors differ, and its fit can enlarge them. A killed run loses only
    the current part; call the function again with the same arguments to resume. The result is the path of the
    folder.

    Args:
        windows: (N, K+1, 4, 4) poses: an array, a memory-mapped array (``np.load(file, mmap_mode="r")``), a
            view from :func:`sliding_windows`, or any iterable of windows (K+1, 4, 4).
        out: folder for the results, created if missing. It gets one Parquet file per part, which also records
            the options. Read the results with :func:`load_results`, or with any Parquet reader.
        times: (K+1,) s, or (N, K+1) if the windows are an array.
        dt: sample time in s, a scalar, (K,), or (N, K) if the windows are an array.
        part_size: number of windows per part.
        parts: numbers of the parts to compute, by default all parts. Give each machine different numbers.
        progress: function to call after every part, with the number of windows that this call has completed
            and their total number (None if unknown). True shows a progress bar on standard error; this is the
            default if standard error is a terminal.
        **options: options of :func:`identify`.

    Raises:
        ValueError: if the folder contains damaged results or results of other windows or options, or if the
            input is unusable. Nothing is written then.
        TypeError: for an option that :func:`identify` does not have.
        ImportError: if pyarrow is missing (the extra ``parquet``).
    """
    PARQUET.library()
    try:
        part_size = index(part_size)
    except TypeError as error:
        raise ValueError(f"part_size must be a whole number, not {part_size!r}.") from error
    if part_size < 1:
        raise ValueError(f"part_size must be at least 1, not {part_size}.")
    source: Any = windows
    given = {name: values for name, values in (("times", times), ("dt", dt)) if values is not None}
    total = len(source) if hasattr(source, "shape") else None
    if total is not None and len(source.shape) != 4:
        raise ValueError(f"windows must have shape (N, K+1, 4, 4), not {source.shape}.")
    wanted = None if parts is None else set(_part_numbers(parts))
    _check_numbers(wanted, total, part_size)
    depends_on = describe_options(identify, options, without=("times", "dt"))
    run = Run(Path(out), PARQUET, _KIND, {_UNIT: total, "part_size": part_size, **depends_on})
    run.resume()
    report, rows, done, seen = make_meter(progress, _UNIT), total, 0, 0
    if total is not None and wanted is not None:
        rows = sum(min(part_size, total - number * part_size) for number in wanted)
    # one thread computes and writes a part while this thread reads the next, so a kill loses one part at most
    with ThreadPoolExecutor(1) as worker:
        pending: Future[int] | None = None
        for number, poses in _parts(windows, part_size, wanted):
            where = slice(number * part_size, number * part_size + len(poses))
            seen = where.stop
            if wanted is not None and number not in wanted:
                continue
            timing = {name: _rows(values, where, total) for name, values in given.items()}
            source = checksum({"poses": poses, **timing})
            if pending is not None:
                report(done := done + pending.result(), rows)
            pending = worker.submit(_do_part, run, number, poses, timing, options, source)
        if pending is not None:
            report(done + pending.result(), rows)
    _check_numbers(wanted, seen if total is None else total, part_size)
    return run.folder


def load_results(folder: str | Path, parts: Iterable[int] | None = None) -> Identification:
    """Load the results in a folder written by :func:`identify_many`, as one batch of NumPy arrays.

    By default, all parts are loaded; if the windows came from an iterator, whose length is unknown, all parts
    in the folder. Give the numbers of a few parts at a time if the results do not fit in memory.

    Raises:
        ValueError: if the folder contains no results or results of another version, or if requested parts are
            missing; or if a file is damaged, a copy of another file, or made with other options. The message
            names the file.
        ImportError: if pyarrow is missing.
    """
    PARQUET.library()
    run = Run.open(Path(folder), PARQUET, _KIND)
    stored, total = run.parts, run.options.get(_UNIT)
    count = max(stored) + 1 if total is None else -(-total // run.options["part_size"])
    wanted = list(range(count)) if parts is None else _part_numbers(parts)
    if not wanted:
        raise ValueError("parts must name at least one part to load.")
    if missing := [number for number in wanted if number not in stored]:
        raise ValueError(
            f"{folder} is incomplete: {len(missing)} parts are missing, {missing[:_LISTED]} among them. "
            "Run identify_many again."
        )
    loaded = [run.read(number) for number in wanted]
    columns: dict[str, Any] = {name: np.concatenate([part[name] for part in loaded]) for name in loaded[0]}
    try:
        return _build(Identification, "", columns)
    except KeyError as error:
        raise ValueError(
            f"{folder} contains results of another version of reframe_jax (without {error}): identify the "
            "windows again, in another folder."
        ) from error


def _build(kind: Any, prefix: str, columns: dict[str, Any]) -> Any:
    """Build a result from the columns with the names of its fields, and nested results recursively."""
    types, values = get_type_hints(kind), {}
    for field in fields(kind):
        name = prefix + field.name
        if is_dataclass(types[field.name]):
            values[field.name] = _build(types[field.name], name + ".", columns)
        elif name in columns or field.default is MISSING:
            values[field.name] = columns[name]
    return kind(**values)


def _part_numbers(parts: Iterable[int]) -> list[int]:
    try:
        return [index(number) for number in parts]
    except TypeError as error:
        raise ValueError(f"parts must be whole numbers: {error}.") from error


def _check_numbers(wanted: set[int] | None, total: int | None, size: int) -> None:
    """Raise an error for part numbers that do not exist; large numbers need a known number of windows."""
    if total == 0:
        raise ValueError("windows must contain at least one window.")
    if wanted is None:
        return
    stop = None if total is None else -(-total // size)
    wrong = sorted(number for number in wanted if number < 0 or (stop is not None and number >= stop))
    if wrong:
        there = "" if stop is None else f": {total} windows make {stop} parts of {size}"
        raise ValueError(f"There are no parts {wrong[:8]}{there}; numbers start at 0.")


def _do_part(
    run: Run, number: int, poses: np.ndarray, timing: dict[str, Any], options: Mapping[str, Any], source: str
) -> int:
    """Identify and write a part, or check an existing part; return its number of windows."""
    if run.has(number):
        run.read(number, source=source)
    else:
        with jax.enable_x64(np.asarray(poses[:0]).dtype != np.float32):  # in the precision of the poses
            found = jax.device_get(identify(poses, **timing, **options))
        leaves = jax.tree_util.tree_leaves_with_path(found)
        columns = {".".join(entry.name for entry in path): np.asarray(leaf) for path, leaf in leaves}
        run.write(number, columns, source=source)
    return len(poses)


def _parts(windows: Any, size: int, wanted: set[int] | None) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the number and the windows (size, K+1, 4, 4) of every part; of an array, only requested parts."""
    if hasattr(windows, "shape"):
        for number in range(-(-len(windows) // size)):
            if wanted is None or number in wanted:
                yield number, windows[number * size : (number + 1) * size]
        return
    try:
        source = iter(windows)
    except TypeError as error:
        raise ValueError(f"windows must be an array or an iterable of windows, not {windows!r}.") from error
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
    """Rows of ``times`` or ``dt`` that belong to a part, if every window has a separate row."""
    if np.ndim(values) < 2:
        return values
    if total is None or len(values) != total:
        raise ValueError(
            "Separate times or dt for every window need windows as an array, and one row per window; "
            f"the given shape is {np.shape(values)}."
        )
    return values[rows]

"""Identification of any number of windows, from disk to disk: bounded memory, resumable, distributed.

:func:`identify_many` cuts the windows into parts, identifies one after the other and writes each as one
Parquet file; :mod:`reframe_jax.storage.parts` says what that file promises. A killed run resumes where it
stopped, and machines that share a disk can share the parts.
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
from reframe_jax.storage.codecs import PARQUET
from reframe_jax.storage.parts import Run
from reframe_jax.storage.progress import Progress, make_meter
from reframe_jax.storage.records import checksum, describe_options

__all__ = ["identify_many", "load_results"]

_KIND = "results of identify_many"
_UNIT = "windows"
_LISTED = 8  # missing parts in a message


def identify_many(
    windows: ArrayLike | Iterable[ArrayLike],
    out: str | Path,
    *,
    times: ArrayLike | None = None,
    dt: ArrayLike | None = None,
    part_size: int = 8192,
    parts: Iterable[int] | None = None,
    progress: Progress | bool | None = None,
    **options: Unpack[IdentifyOptions],
) -> Path:
    """Identify any number of windows, write the results to a folder, and resume an interrupted run.

    The part size bounds the memory: some 200 MB above the input at 8192 windows of 51 poses. Results equal
    those of :func:`identify`, whatever the part size; a window identified by itself differs by rounding, up
    to about 1e-7, because another program computes it. A killed run loses only the part it was working on;
    call again with the same arguments to resume.

    Args:
        windows: (N, K+1, 4, 4) poses: an array, a memory-mapped one (``np.load(file, mmap_mode="r")``),
            a view by :func:`sliding_windows`; or any iterable of (K+1, 4, 4) windows.
        out: folder for the results, made if missing: one Parquet file per part and ``run.json``, the
            options. Read it with :func:`load_results`, or any Parquet reader.
        times: (K+1,) s, or (N, K+1) where the windows are an array.
        dt: sample time in s, a scalar, (K,), or (N, K) where the windows are an array.
        part_size: windows in a part.
        parts: numbers of the parts to compute, all by default; use it to give every machine its share.
        progress: called with the windows done by this call and their number (None if unknown), after
            every part; True for a bar on standard error, the default where that is a terminal.
        **options: of :func:`identify`.

    Returns:
        The folder.

    Raises:
        ValueError: if the folder holds results of other windows or options, or damaged results, or if the
            input is unusable. Nothing is written in that case.
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
    total = len(source) if _is_array(source) else None
    wanted = None if parts is None else set(_part_numbers(parts))
    _check_numbers(wanted, total, part_size)
    depends_on = describe_options(identify, options, without=("times", "dt"))
    run = Run(Path(out), PARQUET, _KIND, _UNIT, {"part_size": part_size, **depends_on})
    run.resume(total)
    report, rows, done, seen = make_meter(progress, _UNIT), _row_count(total, part_size, wanted), 0, 0
    # one thread computes and writes a part while this one reads the next: no more than one is ever lost
    with ThreadPoolExecutor(1) as worker:
        pending: Future[int] | None = None
        for number, poses in _parts(windows, part_size, wanted):
            where = slice(number * part_size, number * part_size + len(poses))
            seen = where.stop
            if wanted is not None and number not in wanted:
                continue
            timing = {"times": _rows(times, where, total), "dt": _rows(dt, where, total)}
            timing = {name: values for name, values in timing.items() if values is not None}
            source = checksum({"poses": poses, **timing})
            if pending is not None:
                report(done := done + pending.result(), rows)
            pending = worker.submit(_do_part, run, number, poses, timing, options, source)
        if pending is not None:
            report(done + pending.result(), rows)
    _check_numbers(wanted, seen if total is None else total, part_size)
    if run.parts:
        run.finish(seen if total is None else total)
    return run.folder


def load_results(folder: str | Path, parts: Iterable[int] | None = None) -> Identification:
    """Load the results in a folder written by :func:`identify_many`, as one batch of NumPy arrays.

    Args:
        folder: as given to :func:`identify_many`.
        parts: numbers of the parts to load, all by default; load a few if the results do not fit in memory.

    Raises:
        ValueError: if the folder holds no results, those of another version, or lacks requested parts; or if
            a file, named in the message, is damaged, a copy of another, or made with other options than the
            rest.
        ImportError: if pyarrow is missing.
    """
    PARQUET.library()
    run = Run.open(Path(folder), PARQUET, _KIND, _UNIT)
    stored = run.parts
    wanted = _all_parts(run) if parts is None else _part_numbers(parts)
    if not wanted:
        raise ValueError("parts must name at least one part to load.")
    number, missing = _missing(wanted, stored)
    if number:
        raise ValueError(
            f"{folder} is incomplete: {number} parts are missing, {missing} among them. "
            "Run identify_many again."
        )
    loaded = [run.read(number) for number in wanted]
    columns: dict[str, Any] = {name: np.concatenate([part[name] for part in loaded]) for name in loaded[0]}
    count = len(columns["status_code"])
    if parts is None and run.total not in (None, count):
        raise ValueError(f"{folder} has results of {count} windows; run.json says {run.total}.")
    try:
        found: Identification = _build(Identification, "", columns)
    except KeyError as error:
        raise ValueError(
            f"{folder} holds results of another version of reframe_jax (without {error}): identify the "
            "windows again, in another folder."
        ) from error
    return found


def _build(kind: Any, prefix: str, columns: dict[str, Any]) -> Any:
    """A result of the columns that are named after its fields; fields that are results are built alike.

    Raises:
        KeyError: naming a column that is missing.
    """
    types, values = get_type_hints(kind), {}
    for field in fields(kind):
        name = prefix + field.name
        if is_dataclass(types[field.name]):
            values[field.name] = _build(types[field.name], name + ".", columns)
        elif name in columns or field.default is MISSING:
            values[field.name] = columns[name]
    return kind(**values)


def _all_parts(run: Run) -> range:
    """Numbers of the parts of a whole run; of an iterator that did not end, up to the last there is."""
    size = run.options.get("part_size")
    if run.total is None or not isinstance(size, int) or size < 1:
        return range(max(run.parts) + 1)
    return range(-(-run.total // size))


def _missing(wanted: range | list[int], stored: Mapping[int, Path]) -> tuple[int, list[int]]:
    """How many parts are missing, and the first of them; a range may be longer than any list."""
    if isinstance(wanted, range):
        number = wanted.stop - sum(part in wanted for part in stored)
    else:
        number = sum(part not in stored for part in wanted)
    return number, list(islice((part for part in wanted if part not in stored), _LISTED))


def _part_numbers(parts: Iterable[int]) -> list[int]:
    try:
        return [index(number) for number in parts]
    except TypeError as error:
        raise ValueError(f"parts must be whole numbers: {error}.") from error


def _check_numbers(wanted: set[int] | None, total: int | None, size: int) -> None:
    """Refuse numbers of parts that there are not; those too large, once the number of windows is known."""
    if wanted is None:
        return
    stop = None if total is None else -(-total // size)
    wrong = sorted(number for number in wanted if number < 0 or (stop is not None and number >= stop))
    if wrong:
        there = "" if stop is None else f": {total} windows make {stop} parts of {size}"
        raise ValueError(f"There are no parts {wrong[:8]}{there}; the first is number 0.")


def _row_count(total: int | None, size: int, wanted: set[int] | None) -> int | None:
    """Windows in the wanted parts; None if unknown."""
    if total is None or wanted is None:
        return total
    return sum(min(size, total - number * size) for number in wanted)


def _do_part(
    run: Run, number: int, poses: np.ndarray, timing: dict[str, Any], options: Mapping[str, Any], source: str
) -> int:
    """Identify and write a part, or check the one that is there; returns its number of windows."""
    if run.has(number):
        run.read(number, source=source)
    else:
        found = _identify(poses, timing, options)
        leaves = jax.tree_util.tree_leaves_with_path(found)
        columns = {".".join(entry.name for entry in path): np.asarray(leaf) for path, leaf in leaves}
        run.write(number, columns, source=source)
    return len(poses)


def _identify(poses: Any, timing: dict[str, Any], options: Mapping[str, Any]) -> Identification:
    """Results on the host, in the precision of the poses whatever JAX is set to."""
    precise = np.asarray(poses[:0]).dtype != np.float32
    with jax.enable_x64(precise):
        return jax.device_get(identify(poses, **timing, **options))


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
    """The part's rows of times or dt, where every window has its own."""
    if values is None or np.ndim(values) < 2:
        return values
    if total is None or len(values) != total:
        raise ValueError(
            "times and dt of every window need the windows as an array, and as many rows as it has; "
            f"they have shape {np.shape(values)}."
        )
    return values[rows]

"""Arrays of NumPy. Sizes are checked before memory is allocated; pickles are refused."""

import math
import warnings
import zipfile
from collections.abc import Callable
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from reframe_jax.recordings.readers.reader import Reader, translate_errors
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import EPOCH, Rows, check_size, listed
from reframe_jax.recordings.selection import Selection

__all__ = ["ARRAYS", "read_arrays"]

_NAMES = ("poses", "positions", "quaternions", "times", "wrenches")
_NO_TIMES = "add an array times (N,) to an .npz, or give the sample time, dt (--dt)"
_PLAIN = "plain arrays of numbers, as np.save or np.savez writes them"
_LONGEST_HEADER = 10_000  # bytes; NumPy writes 128 for an array of numbers


class _Array(NamedTuple):
    """An array in a file, whose numbers are not yet read."""

    shape: tuple[int, ...]
    dtype: np.dtype
    read: Callable[[], np.ndarray]


def read_arrays(path: Path, wanted: Selection) -> Rows:
    """Read arrays ``poses``, or ``positions`` and ``quaternions``, and ``times`` and ``wrenches``."""
    with path.open("rb") as file, translate_errors(path, _PLAIN):
        if file.read(2) != b"PK":
            return _rows(
                path, {"poses": _check_array("poses", lambda: path.open("rb"), path.stat().st_size)}, []
            )
        with zipfile.ZipFile(file) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            arrays = {}
            for name in _NAMES:
                if info := members.get(name):
                    # other compression methods can expand a few bytes to any size in one step
                    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                        raise ValueError(f"{name} is compressed by another method")
                    arrays[name] = _check_array(name, partial(archive.open, info), info.file_size)
            return _rows(path, arrays, sorted(members.keys() - set(_NAMES)))


def _check_array(name: str, open: Callable[[], IO[bytes]], size: int) -> _Array:
    """Check the header of an array in a stream of ``size`` bytes; the numbers are read when asked for."""
    with open() as stream:
        head = BytesIO(stream.read(_LONGEST_HEADER))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # headers of Python 2, and damaged headers
        version, _ = np.lib.format.read_magic(head)
        read = getattr(np.lib.format, f"read_array_header_{version}_0")
        shape, by_column, dtype = read(head)
    if dtype.hasobject or dtype.itemsize == 0:
        raise ValueError(f"{name} contains objects")
    claimed, held = math.prod(shape) * dtype.itemsize, size - head.tell()
    if min(shape, default=0) < 0 or claimed > held:
        raise ValueError(
            f"{name} has the shape {shape} and should take {claimed} bytes, but has {held} bytes."
        )

    def numbers() -> np.ndarray:
        with open() as stream:
            stream.seek(head.tell())
            content = np.frombuffer(stream.read(claimed), dtype)
        return content.reshape(shape, order="F" if by_column else "C").copy()

    return _Array(shape, dtype, numbers)


def _rows(path: Path, arrays: dict[str, _Array], others: list[str]) -> Rows:
    """Make rows from arrays, if their shapes fit each other."""
    shapes = {name: array.shape for name, array in arrays.items()}
    count = (shapes.get("poses") or shapes.get("positions") or (0,))[0]
    pair = (shapes.get("positions"), shapes.get("quaternions")) == ((count, 3), (count, 4))
    timed = shapes.get("poses") == (count, 8) and "times" not in shapes
    fits = pair or timed or shapes.get("poses") in ((count, 7), (count, 4, 4))
    fits &= shapes.get("times", (count,)) == (count,) and shapes.get("wrenches", (count, 6)) == (count, 6)
    if not (fits and count) or any(array.dtype.kind not in "fiu" for array in arrays.values()):
        found = [f"{name} {array.shape} of {array.dtype}" for name, array in arrays.items()] + others
        raise RecordingError(
            f"{path}: expected numbers: poses (N, 4, 4), or positions (N, 3) and quaternions (N, 4), and "
            f"times (N,), perhaps wrenches (N, 6); found {listed(found, 8)}."
        )
    check_size(path, count)
    with np.errstate(all="ignore"):  # numbers beyond double precision become infinite, and are left out
        names = {"times", "wrenches", *(("positions", "quaternions") if pair else ("poses",))}
        parts = {name: arrays[name].read().reshape(count, -1) for name in names & arrays.keys()}
        if timed:
            parts |= {"times": parts["poses"][:, :1], "poses": parts["poses"][:, 1:]}
        values = np.hstack([parts["positions"], parts["quaternions"]]) if pair else parts["poses"]
        seconds, origin = _since_first(parts["times"][:, 0]) if "times" in parts else (None, None)
        wrenches = parts["wrenches"].astype(float, copy=False) if "wrenches" in parts else None
        values = values.astype(float, copy=False)
    return Rows(
        path, "sample", np.arange(count), values, seconds, origin, wrenches=wrenches, no_times=_NO_TIMES
    )


def _since_first(times: np.ndarray) -> tuple[np.ndarray, str | None]:
    """Convert times (N,) to floats; late times count from the first one, which is the second result.

    The subtraction is before the rounding; integers do not overflow.
    """
    seconds = times.astype(float)
    finite = np.flatnonzero(np.isfinite(seconds))
    if not len(finite) or abs(seconds[finite[0]]) < EPOCH:
        return seconds, None
    first = times[finite[0]]
    if times.dtype.kind == "f":
        return (times - first).astype(float), str(first)
    whole, zero = times.astype(np.uint64), first.astype(np.uint64)  # the difference is exact modulo 2^64
    return np.where(times < first, -(zero - whole).astype(float), (whole - zero).astype(float)), str(first)


ARRAYS = Reader(
    name="arrays of NumPy",
    suffixes=(".npy", ".npz"),
    recognises=lambda path, head: True,
    read=read_arrays,
    options=frozenset({"unit", "time_unit", "quaternion"}),
)

"""Arrays of NumPy; pickles are refused."""

import warnings
from pathlib import Path

import numpy as np

from reframe_jax.recordings.readers.reader import Reader, translate_errors
from reframe_jax.recordings.recording import EPOCH, RecordingError, Rows, check_size, listed
from reframe_jax.recordings.selection import Selection

_NAMES = ("poses", "positions", "quaternions", "times", "wrenches")
_NO_TIMES = "add an array times (N,) to an .npz, or give the sample time, dt (--dt)"
_PLAIN = "plain arrays of numbers, as np.save or np.savez writes them"


def read_arrays(path: Path, wanted: Selection) -> Rows:
    """Read arrays ``poses``, or ``positions`` and ``quaternions``, and ``times`` and ``wrenches``."""
    with path.open("rb") as file, translate_errors(path, _PLAIN), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # headers of Python 2, and damaged headers
        if file.read(2) != b"PK":
            # a file must contain the announced bytes to be mapped
            return _rows(path, {"poses": np.array(np.lib.format.open_memmap(path, mode="r"))}, [])
        file.seek(0)
        with np.load(file, allow_pickle=False) as content:
            arrays = {name: content[name] for name in _NAMES if name in content.files}
            return _rows(path, arrays, sorted(set(content.files) - set(_NAMES)))


def _rows(path: Path, arrays: dict[str, np.ndarray], others: list[str]) -> Rows:
    """Make rows from arrays, if their shapes fit each other."""
    shapes = {name: array.shape for name, array in arrays.items()}
    count = (shapes.get("poses") or shapes.get("positions") or (0,))[0]
    pair = (shapes.get("positions"), shapes.get("quaternions")) == ((count, 3), (count, 4))
    timed = shapes.get("poses") == (count, 8) and "times" not in shapes
    whole = (count, 4, 4), (count, 3, 4), (count, 12), (count, 16), (count, 7)
    fits = pair or timed or shapes.get("poses") in whole
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
        parts = {name: arrays[name].reshape(count, -1) for name in names & arrays.keys()}
        if timed:
            parts |= {"times": parts["poses"][:, :1], "poses": parts["poses"][:, 1:]}
        values = np.hstack([parts["positions"], parts["quaternions"]]) if pair else parts["poses"]
        seconds, origin = since_first(parts["times"][:, 0]) if "times" in parts else (None, None)
        wrenches = parts["wrenches"].astype(float, copy=False) if "wrenches" in parts else None
        values = values.astype(float, copy=False)
    return Rows(
        path, "sample", np.arange(count), values, seconds, origin, wrenches=wrenches, no_times=_NO_TIMES
    )


def since_first(times: np.ndarray) -> tuple[np.ndarray, str | None]:
    """Convert times (N,) to floats; late times count from the first one, which is the second result.

    The subtraction is before the rounding, of Python's integers, which do not overflow.
    """
    seconds = times.astype(float)
    finite = np.flatnonzero(np.isfinite(seconds))
    if not len(finite) or abs(seconds[finite[0]]) < EPOCH:
        return seconds, None
    first = times[finite[0]]
    exact = times.astype(object) - int(first) if times.dtype.kind in "iu" else times - first
    return exact.astype(float), str(first)


ARRAYS = Reader(
    name="arrays of NumPy",
    suffixes=(".npy", ".npz"),
    recognises=lambda path, head: True,
    read=read_arrays,
    options=frozenset({"unit", "time_unit", "quaternion"}),
)

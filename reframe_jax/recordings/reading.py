"""Reading of recordings.

NumPy only. ``Recording.notes`` lists rows that were dropped, repaired or look odd. Everything else that is
wrong raises a :class:`RecordingError` that says where, what was expected, and what to do.
"""

from pathlib import Path
from typing import Literal

import numpy as np

from reframe_jax.recordings.checks import (
    MIN_POSES,
    check_positions,
    check_times,
    drop_unfinished,
    make_poses,
    make_times,
)
from reframe_jax.recordings.readers import READERS
from reframe_jax.recordings.recording import Recording, RecordingError
from reframe_jax.recordings.rows import Rows

__all__ = ["load_recording"]

_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}


def load_recording(
    path: str | Path, *, unit: Literal["m", "cm", "mm"] = "m", dt: float | None = None
) -> Recording:
    """Read a recording of poses.

    Formats, by suffix:

    ``.csv``, ``.tsv``
        Columns named by a header, in any order; others are ignored. Time: ``t``, ``time``,
        ``timestamp``, ``stamp``. Position: ``x``, ``px``, ``pos_x``, ``position.x``; also ``tx``, unless
        there is an ``fx`` or another position, as it is a torque then. Orientation: ``qx``, ``quat_x``,
        ``orientation.x``. Or a pose matrix, ``m00`` to ``m23`` or ``m33`` (or ``t00``): row, column. Lines
        that start with ``#`` or ``%`` are comments; the last one before the numbers may be the header.
    ``.txt``, ``.tum``
        A TUM trajectory: lines of ``t x y z qx qy qz qw``, separated by blanks; ``#`` starts a comment.
    ``.npy``, ``.npz``
        ``poses``: (N, 4, 4), or (N, 7) as ``x y z qx qy qz qw``, or (N, 8) with the time first. An .npz
        may hold ``positions`` (N, 3) and ``quaternions`` (N, 4) instead, and ``times`` (N,). Its other
        arrays are not read.

    A recording has at most 8,388,608 poses. A million of them need less than 300 MB while they are read.

    Args:
        path: the file.
        unit: unit of the positions in the file.
        dt: sample time in s, for files without times; times in the file are then ignored.

    Returns:
        The recording, in metres and seconds.

    Raises:
        RecordingError: if the file or one of its rows cannot be used.
    """
    path = Path(path)
    if unit not in _UNITS:
        raise RecordingError(f"unit must be one of {', '.join(_UNITS)}, not {unit!r}.")
    if dt is not None and not 0 < dt < np.inf:
        raise RecordingError(f"dt must be a positive number of seconds, not {dt!r}.")
    rows = _read(path, unit)
    with np.errstate(all="ignore"):  # numbers too large to be squared: what comes of them is refused below
        times = drop_unfinished(rows, make_times(rows, dt))
        times = check_times(rows, times)
        if len(times) < MIN_POSES:
            raise RecordingError(f"{path}: has {len(times)} usable poses; expected {MIN_POSES} or more.")
        poses = make_poses(rows)
        poses[:, :3, 3] *= _UNITS[unit]
        check_positions(rows, poses[:, :3, 3])
    return Recording(times, poses, path, tuple(rows.notes))


def _read(path: Path, unit: str) -> Rows:
    """The rows of a file, by its suffix."""
    suffix = path.suffix.lower()
    if suffix in (".pkl", ".pickle"):
        raise RecordingError(f"{path}: pickles can run code when they are read; save arrays as .npz instead.")
    if suffix not in READERS:
        raise RecordingError(f"{path}: expected one of {', '.join(READERS)}, not the suffix {suffix!r}.")
    try:
        return READERS[suffix](path, unit)
    except RecordingError:
        raise
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: is not a text file; expected UTF-8.") from error
    except (OSError, ValueError) as error:  # the latter of a path that holds a zero byte
        raise RecordingError(
            f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}."
        ) from error

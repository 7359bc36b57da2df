"""A reader per format, by suffix.

A reader takes a path and the unit of positions (m, cm, mm), and returns :class:`Rows` as they are in the
file. Checks and repairs follow and are the same for all formats. A reader raises :class:`RecordingError` for
unreadable contents; OSError and UnicodeDecodeError may propagate. To add a format, copy ``trajectory.py`` and
add its suffixes here.
"""

from collections.abc import Callable
from pathlib import Path

from reframe_jax.recordings.readers.arrays import read_arrays
from reframe_jax.recordings.readers.table import read_table
from reframe_jax.recordings.readers.trajectory import read_trajectory
from reframe_jax.recordings.rows import Rows

__all__ = ["READERS"]

READERS: dict[str, Callable[[Path, str], Rows]] = {
    ".csv": read_table,
    ".tsv": read_table,
    ".txt": read_trajectory,
    ".tum": read_trajectory,
    ".npy": read_arrays,
    ".npz": read_arrays,
}

"""The type of a reader, and functions for several readers."""

import importlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from reframe_jax.recordings.recording import RecordingError, Rows, listed, shown
from reframe_jax.recordings.selection import Selection, flag

_NEAREST = 3.0  # no body is measured within 3 mm of a tracker, and few beyond 3 m


@dataclass(frozen=True)
class Entry:
    """Data that can be selected in a file."""

    option: str  # name of the option that selects the data, such as ``topic``
    name: str  # value of this option
    detail: str  # a few words about the data: type, count of samples


@dataclass(frozen=True)
class Reader:
    """A reader of one format.

    ``read`` raises :class:`RecordingError` for unreadable contents, and may raise OSError and
    UnicodeDecodeError.
    """

    name: str  # of the format in messages, with an article: "a ROS bag"
    suffixes: tuple[str, ...]  # of files, in lower case with the dot; "/" for folders
    recognises: Callable[[Path, bytes], bool]  # a path and its first bytes (none for a folder)
    read: Callable[[Path, Selection], Rows]
    options: frozenset[str]  # names of the options in :class:`Selection` that the reader uses
    contents: Callable[[Path], list[Entry]] | None = None  # lists the data of formats with several in a file


def import_extra(path: Path, module: str, extra: str) -> ModuleType:
    """Import a module, such as ``pyarrow.parquet``, or name the extra of this package that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        library = module.partition(".")[0]
        remedy = f"pip install 'reframe-jax[{extra}]'"
        raise RecordingError(f"{path}: needs {library}, which is not installed: {remedy}.") from error


@contextmanager
def translate_errors(path: Path, expected: str) -> Iterator[None]:
    """Replace exceptions of a library about the contents of a file by a RecordingError of one line.

    Errors of the disk remain. ``expected`` names the contents, such as "a whole C3D file".
    """
    try:
        yield
    except Exception as error:
        if isinstance(error, RecordingError) or (isinstance(error, OSError) and error.errno is not None):
            raise  # an error with its own message, or an error of the disk
        reason = shown(" ".join(str(error).split())) or type(error).__name__
        problem = reason.rstrip(".")
        raise RecordingError(f"{path}: expected {expected}; it cannot be read: {problem}.") from error


def choose_name(path: Path, option: str, wanted: str | None, names: Sequence[str], what: str) -> str:
    """Return the name that the user gave by an option, or the only one of the names in the file.

    ``what`` is the kind of the names in the plural, such as "rigid bodies". An unknown name, and several
    names of which none was given, are refused.
    """
    if wanted in names:
        return str(wanted)
    if not names:
        raise RecordingError(f"{path}: has no {what}.")
    if wanted is not None:
        raise RecordingError(f"{path}: has no {shown(wanted, 60)!r} among its {what}: {listed(names)}.")
    if len(names) > 1:
        raise RecordingError(f"{path}: has several {what}; name one, {flag(option)}: {listed(names)}.")
    return names[0]


def drop_zeros(rows: Rows, values: np.ndarray) -> None:
    """Leave out the rows in which all values (N, M) are 0, which mark a body that was not seen."""
    rows.keep(~(values == 0).all(axis=1), "all numbers are 0, as the body was not seen", "untracked")


def assume_millimetres(rows: Rows, writer: str) -> None:
    """Set the unit to mm, which ``writer`` usually writes, or to m for small positions, with a note."""
    distance = np.linalg.norm(rows.positions, axis=1)
    distance = distance[np.isfinite(distance)]
    near = len(distance) > 0 and bool(np.median(distance) < _NEAREST)
    rows.metres = 1.0 if near else 1e-3
    rows.notes.append(
        f"positions are read in m, because in mm they would be less than {_NEAREST:g} mm from the origin; if "
        "they are in mm, give unit='mm' (--unit mm)."
        if near
        else f"positions are read in mm, as {writer} writes them."
    )


def matrix_rows(matrices: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Join R (N, 3, 3) and p (N, 3) to the values (N, 12) of :class:`Rows`: [R p], row by row."""
    return np.concatenate([matrices, positions[..., None]], axis=-1).reshape(-1, 12)

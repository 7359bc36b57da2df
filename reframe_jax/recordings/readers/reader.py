"""What a reader is, and what readers share."""

import importlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType

from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import Rows, shown
from reframe_jax.recordings.selection import Selection, flag

__all__ = ["Entry", "Reader", "attribute_to", "choose_name", "import_extra", "translate_errors"]

_LISTED = 20  # names in a message


@dataclass(frozen=True)
class Entry:
    """Something that can be read from a file.

    Attributes:
        option: name of the option that selects it, such as ``topic``.
        name: what to give to that option.
        detail: a few words on it: type, number of samples.
    """

    option: str
    name: str
    detail: str


@dataclass(frozen=True)
class Reader:
    """How to read one format.

    Attributes:
        name: what messages call it, with an article: "a ROS bag".
        suffixes: of its files, in lower case with the dot; "/" for folders.
        recognises: whether the path and the first bytes of the file (none of a folder) belong to the format.
        read: reads the rows. It raises :class:`RecordingError` for unreadable contents; OSError and
            UnicodeDecodeError may propagate.
        options: names of the options in :class:`Selection` that it uses.
        contents: lists what can be read, for formats whose files hold several things.
    """

    name: str
    suffixes: tuple[str, ...]
    recognises: Callable[[Path, bytes], bool]
    read: Callable[[Path, Selection], Rows]
    options: frozenset[str]
    contents: Callable[[Path], list[Entry]] | None = None


def import_extra(path: Path, module: str, extra: str) -> ModuleType:
    """Import an optional library.

    Raises:
        RecordingError: if it is not installed; the message names the extra.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        library = module.partition(".")[0]
        raise RecordingError(
            f"{path}: needs {library}, which is not installed: pip install 'reframe-jax[{extra}]'."
        ) from error


def translate_errors(path: Path, what: str) -> AbstractContextManager[None]:
    """Replace any exception of a library about the contents of a file by a RecordingError of one line.

    Args:
        path: the file.
        what: what the file should be, such as "a whole C3D file".

    Raises:
        RecordingError: in the context, for everything except errors of the disk.
    """
    return attribute_to(partial(_unreadable, path, what))


@contextmanager
def attribute_to(make_error: Callable[[Exception], RecordingError]) -> Iterator[None]:
    """Replace any exception about the contents of a file by an error for the user.

    Args:
        make_error: returns the error for the user, given the exception.

    Raises:
        RecordingError: from ``make_error``. Errors of the disk, and a RecordingError raised in the context,
            pass unchanged.
    """
    try:
        yield
    except RecordingError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise  # the disk's fault, not that of the bytes
        raise make_error(error) from error


def _unreadable(path: Path, what: str, error: Exception) -> RecordingError:
    reason = shown(" ".join(str(error).split())) or type(error).__name__
    return RecordingError(f"{path}: expected {what}; it cannot be read: {reason.rstrip('.')}.")


def choose_name(path: Path, option: str, wanted: str | None, names: list[str], what: str) -> str:
    """The name that the user gave, or the only one there is.

    Args:
        path: the file.
        option: name of the option.
        wanted: its value.
        names: those in the file.
        what: what they are, in the plural: "rigid bodies".

    Raises:
        RecordingError: if there is no such name, or several and none was given; the message lists them.
    """
    if wanted in names:
        return wanted
    listed = ", ".join(shown(name, 60) for name in names[:_LISTED]) + (", ..." if names[_LISTED:] else "")
    if not names:
        raise RecordingError(f"{path}: has no {what}.")
    if wanted is not None:
        raise RecordingError(f"{path}: has no {shown(wanted, 60)!r} among its {what}: {listed}.")
    if len(names) > 1:
        raise RecordingError(f"{path}: has several {what}; name one, {flag(option)}: {listed}.")
    return names[0]

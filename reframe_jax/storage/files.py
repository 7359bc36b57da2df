"""Write files atomically, so that a file is complete or does not exist."""

import errno
import os
import re
import secrets
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

_TEMPORARY = re.compile(r"\..+\.[0-9a-f]{16}")
_ABANDONED = 3600.0  # s, age of an abandoned file; larger than the clock differences between machines


def write_whole(file: Path, write: Callable[[Path], Any]) -> None:
    """Call ``write`` with a temporary path, then rename it, so that readers never see an incomplete file."""
    # several machines with a common disk may have equal process numbers
    temporary = file.with_name(f".{file.name}.{secrets.token_hex(8)}")
    try:
        write(temporary)
        with temporary.open("rb+") as written:
            os.fsync(
                written.fileno()
            )  # the content must be on the disk before a power failure after the rename
        os.replace(temporary, file)
    finally:
        temporary.unlink(missing_ok=True)


def check_place(folder: Path) -> None:
    """Raise an OSError if a missing folder cannot be created, before a long computation."""
    if folder.exists():
        return
    place = folder.absolute().parent
    while not place.exists():
        place = place.parent
    reason = errno.EACCES if place.is_dir() else errno.ENOTDIR
    if reason == errno.ENOTDIR or not os.access(place, os.W_OK | os.X_OK):
        raise OSError(reason, os.strerror(reason), str(folder))


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files that have not changed for an hour; their writers were killed.

    Another machine may still be writing newer files.
    """
    for file in folder.glob(".*"):
        if not _TEMPORARY.fullmatch(file.name):
            continue
        try:
            if time.time() - file.stat().st_mtime > _ABANDONED:
                file.unlink()
        except FileNotFoundError:  # another machine removed the file, or its writer renamed it
            continue

"""Files that exist completely or not at all."""

import errno
import os
import re
import secrets
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

__all__ = ["check_place", "remove_leftovers", "write_whole"]

_TEMPORARY = re.compile(r"\..+\.[0-9a-f]{16}")
_ABANDONED = 3600.0  # s after which a temporary file has no writer any more; machines' clocks differ by less


def write_whole(file: Path, write: Callable[[Path], Any]) -> None:
    """Write a temporary file and rename it: readers see the old file or the complete new one.

    Args:
        file: to write.
        write: writes the file whose path it is given.
    """
    # process numbers repeat on machines that share a disk
    temporary = file.with_name(f".{file.name}.{secrets.token_hex(8)}")
    try:
        write(temporary)
        with temporary.open("rb+") as written:  # on the disk before its name is, should the power fail
            os.fsync(written.fileno())
        os.replace(temporary, file)
    finally:
        temporary.unlink(missing_ok=True)


def check_place(folder: Path) -> None:
    """Check, before a long computation, that a missing folder can be created.

    Raises:
        OSError: if it cannot.
    """
    if folder.exists():
        return
    place = folder.absolute().parent
    while not place.exists():
        place = place.parent
    reason = errno.EACCES if place.is_dir() else errno.ENOTDIR
    if reason == errno.ENOTDIR or not os.access(place, os.W_OK | os.X_OK):
        raise OSError(reason, os.strerror(reason), str(folder))


def remove_leftovers(folder: Path) -> None:
    """Remove leftovers of killed writers: temporary files that have not changed for an hour.

    Another machine may still be writing younger files.
    """
    for file in folder.glob(".*"):
        if not _TEMPORARY.fullmatch(file.name):
            continue
        try:
            if time.time() - file.stat().st_mtime > _ABANDONED:
                file.unlink()
        except FileNotFoundError:  # another machine has removed it, or its writer has renamed it
            continue

"""Files that are there whole or not at all."""

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
    """Write beside a file and rename: whoever looks sees the old file or the whole new one.

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
    """Find out before a long computation whether a folder that is not there can be made.

    Raises:
        OSError: if not.
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
    """Remove what killed writers left in a folder: temporary files that have not changed for an hour.

    Younger ones may belong to another machine that is writing at this moment.
    """
    for file in folder.glob(".*"):
        if not _TEMPORARY.fullmatch(file.name):
            continue
        try:
            if time.time() - file.stat().st_mtime > _ABANDONED:
                file.unlink()
        except FileNotFoundError:  # another machine has removed it, or its writer has renamed it
            continue

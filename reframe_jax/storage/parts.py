"""Runs in parts: a run verifies existing parts and computes only missing parts.

A run is a folder with numbered parts. A part on disk is always complete. Each part contains its name, the
options of the run, and checksums of its input and its contents, so every read detects a part that is damaged,
copied or made with other options. A run writes nothing before the first part is computed; invalid options
therefore leave no files. The file of a part has named arrays and a line of text, as a NumPy archive or as
Parquet.
"""

import errno
import json
import os
import re
import secrets
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

import reframe_jax
from reframe_jax.storage.records import checksum

_FORMAT = 5
_PART = re.compile(r"part-(\d{8,})")
_TEMPORARY = re.compile(r"\..+\.[0-9a-f]{16}")
_HEADER = "reframe_jax"  # name of the text in a file
_ABANDONED = 3600.0  # s, age of an abandoned file; larger than the clock differences between machines

Record = dict[str, Any]


class _Npz:
    """One array of the archive per array, and one for the text."""

    suffix = ".npz"

    def write(self, file: Path, arrays: Mapping[str, np.ndarray], header: str) -> None:
        entries: dict[str, Any] = {**arrays, _HEADER: header}
        with file.open("wb") as stream:
            np.savez_compressed(stream, **entries)

    def read(self, stream: BinaryIO) -> tuple[dict[str, Any], str]:
        with np.load(stream) as stored:
            arrays = dict(stored)
        return arrays, str(arrays.pop(_HEADER))


class _Parquet:
    """One column per array: the first axis gives the rows, the other axes give nested lists."""

    suffix = ".parquet"

    def write(self, file: Path, arrays: Mapping[str, np.ndarray], header: str) -> None:
        arrow = self.library()
        table = arrow.table({name: _to_arrow(arrow, np.asarray(array)) for name, array in arrays.items()})
        # dictionary encoding merges numbers that compare equal but differ in their bits, such as 0 and -0
        table = table.replace_schema_metadata({_HEADER: header})
        arrow.parquet.write_table(table, file, use_dictionary=False)

    def read(self, stream: BinaryIO) -> tuple[dict[str, Any], str]:
        table = self.library().parquet.read_table(stream)
        header = table.schema.metadata[_HEADER.encode()].decode()
        return {name: _from_arrow(table.column(name)) for name in table.column_names}, header

    @staticmethod
    def library() -> Any:
        """Import PyArrow, or raise an ImportError that names the extra."""
        try:
            import pyarrow
            import pyarrow.parquet
        except ImportError as error:
            remedy = "pip install 'reframe-jax[parquet]'"
            raise ImportError(f"Results are stored as Parquet, which needs pyarrow: {remedy}") from error
        return pyarrow


NPZ = _Npz()
PARQUET = _Parquet()
Codec = _Npz | _Parquet
"""A file format of parts; reading raises the errors of the format for a damaged file."""


def _to_arrow(arrow: Any, values: np.ndarray) -> Any:
    """Convert an array (N, a, b, ...) to a column of N nested lists of fixed size."""
    column = arrow.array(np.ascontiguousarray(values).reshape(-1))
    for size in reversed(values.shape[1:]):
        column = arrow.FixedSizeListArray.from_arrays(column, size)
    return column


def _from_arrow(column: Any) -> np.ndarray:
    """Convert a column of :func:`_to_arrow` back to an array."""
    values, shape = column.combine_chunks(), [len(column)]
    while hasattr(values.type, "list_size"):
        shape.append(values.type.list_size)
        values = values.flatten()
    return np.asarray(values.to_numpy(zero_copy_only=False)).reshape(shape)


def write_part(
    file: Path, codec: Codec, arrays: Mapping[str, Any], options: Record, *, source: str = ""
) -> None:
    """Write named arrays as a part, with its name, its options, and the checksum ``source`` of its input."""
    values = {name: np.asarray(array) for name, array in arrays.items()}
    header: Record = {"name": file.stem, "source": source, "options": options}
    header["checksum"] = checksum(values, start=json.dumps(header, sort_keys=True))
    text = json.dumps(header)
    write_whole(file, lambda temporary: codec.write(temporary, values, text))


def read_part(
    file: Path, codec: Codec, options: Record | None = None, *, source: str | None = None
) -> tuple[dict[str, Any], Record]:
    """Read the arrays and the options of a part.

    A ValueError that names the file is raised if it is damaged or renamed, or was made with other options
    than the given ones, or from an input with another checksum.
    """
    if file.is_dir():
        raise _damaged(file, "it is a folder")
    with file.open("rb") as stream:
        try:
            arrays, text = codec.read(stream)
            header = json.loads(text)
            sound = header.pop("checksum") == checksum(arrays, start=json.dumps(header, sort_keys=True))
            name, made_from, made_with = (header[entry] for entry in ("name", "source", "options"))
        except (MemoryError, ImportError):
            raise
        except Exception as error:  # the errors of a format for damaged files are not documented
            raise _damaged(file, f"{type(error).__name__}: {error}") from error
    if not sound:
        raise _damaged(file, "its checksum does not match its contents")
    if name != file.stem:
        raise ValueError(f"{file} is a copy of {name}: delete the copy, and run again to compute this part.")
    if options is not None and made_with != options:
        differ = [name for name in {**made_with, **options} if made_with.get(name) != options.get(name)]
        raise ValueError(
            f"{file} was made with other options ({', '.join(differ)}). Use the options of the file, or "
            "another folder."
        )
    if source is not None and made_from != source:
        raise ValueError(
            f"{file} contains results of other windows or times. Use the same input to resume, or another "
            "folder."
        )
    return arrays, made_with


def _damaged(file: Path, why: str) -> ValueError:
    return ValueError(f"{file} is damaged: delete the file, and run again to compute this part. ({why})")


class Run:
    """A folder of numbered parts, which depend on the same options, as :func:`.records.describe` writes them.

    The folder is created with the first part; a ValueError is raised if it is a file. ``kind`` names the
    contents in messages, such as ``"results of identify_many"``.
    """

    def __init__(self, folder: Path, codec: Codec, kind: str, options: Record) -> None:
        if folder.exists() and not folder.is_dir():
            raise ValueError(f"{folder} is a file; expected a folder for the {kind}.")
        self.folder = folder
        self._codec = codec
        versions = {"kind": kind, "format": _FORMAT, "version": reframe_jax.__version__}
        self.options: Record = json.loads(json.dumps({**versions, **options}))
        self._written = False

    @staticmethod
    def open(folder: Path, codec: Codec, kind: str) -> "Run":
        """Open the run in a folder for reading; raises a ValueError if there is none."""
        run = Run(folder, codec, kind, {})
        if not (files := run.parts):
            raise ValueError(f"{folder} contains no {kind} (part-*{codec.suffix}).")
        _, run.options = read_part(files[min(files)], codec)
        if run.options.get("kind") != kind:
            raise ValueError(f"{folder} contains no {kind}, but {run.options.get('kind')}.")
        return run

    @property
    def parts(self) -> dict[int, Path]:
        """Files of the existing parts by number, in order."""
        files = self.folder.glob(f"part-*{self._codec.suffix}")
        found = {int(match[1]): file for file in files if (match := _PART.fullmatch(file.stem))}
        return dict(sorted(found.items()))

    def resume(self) -> None:
        """Check the first existing part as :func:`read_part`, and remove temporary files of killed writers.

        Writes nothing. An OSError is raised if the folder does not exist and cannot be created.
        """
        if not self.folder.exists():  # before a long computation
            place = next(parent for parent in self.folder.absolute().parents if parent.exists())
            reason = errno.EACCES if place.is_dir() else errno.ENOTDIR
            if reason == errno.ENOTDIR or not os.access(place, os.W_OK | os.X_OK):
                raise OSError(reason, os.strerror(reason), str(self.folder))
        remove_leftovers(self.folder)
        for file in list(self.parts.values())[:1]:
            read_part(file, self._codec, self.options)

    def has(self, number: int) -> bool:
        """Whether a part exists."""
        return self._file(number).exists()

    def read(self, number: int, *, source: str | None = None) -> dict[str, Any]:
        """Read the arrays of a part and check them; see :func:`read_part`."""
        return read_part(self._file(number), self._codec, self.options, source=source)[0]

    def write(self, number: int, arrays: Mapping[str, Any], *, source: str = "") -> None:
        """Write a part; before the first part, check that no other run has begun in the folder."""
        if not self._written:
            self.resume()
            self.folder.mkdir(parents=True, exist_ok=True)
            self._written = True
        write_part(self._file(number), self._codec, arrays, self.options, source=source)

    def _file(self, number: int) -> Path:
        return self.folder / f"part-{number:08d}{self._codec.suffix}"


def write_whole(file: Path, write: Callable[[Path], Any]) -> None:
    """Call ``write`` with a temporary path, then rename it, so that readers never see an incomplete file."""
    # several machines with a common disk may have equal process numbers
    temporary = file.with_name(f".{file.name}.{secrets.token_hex(8)}")
    try:
        write(temporary)
        # the content must be on the disk before a power failure after the rename
        with temporary.open("rb+") as written:
            os.fsync(written.fileno())
        os.replace(temporary, file)
    finally:
        temporary.unlink(missing_ok=True)


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files that have not changed for an hour; their writers were killed.

    Another machine may still be writing newer files.
    """
    for file in filter(lambda file: _TEMPORARY.fullmatch(file.name), folder.glob(".*")):
        with suppress(FileNotFoundError):  # another machine removed the file, or its writer renamed it
            if time.time() - file.stat().st_mtime > _ABANDONED:
                file.unlink()

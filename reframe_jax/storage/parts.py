"""Runs in parts: a run verifies existing parts and computes only missing parts.

A run is a folder with numbered parts and ``run.json``, which records the options of all parts. A part on disk
is always complete. Each part contains its name, the options, and checksums of its input and its contents, so
every read detects a part that is damaged, copied or made with other options. A run writes nothing before the
first part is computed; invalid options therefore leave no files.
"""

import json
import re
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import reframe_jax
from reframe_jax.storage.codecs import Codec
from reframe_jax.storage.files import check_place, remove_leftovers, write_whole
from reframe_jax.storage.records import checksum

__all__ = ["Run", "read_part", "write_part"]

_FORMAT = 4
_LISTED, _LONGEST = 8, 40  # most option names in a message, and longest name
_RUN = "run.json"
_PART = re.compile(r"part-(\d{8,})")

Record = dict[str, Any]


def write_part(
    file: Path, codec: Codec, arrays: Mapping[str, Any], options: Record, *, source: str = ""
) -> None:
    """Write a part atomically; the part records its name, its options, and the checksum of its input."""
    values = {name: np.asarray(array) for name, array in arrays.items()}
    header: Record = {"name": file.stem, "source": source, "options": options}
    header["checksum"] = _checksum(values, header)
    text = json.dumps(header)
    write_whole(file, lambda temporary: codec.write(temporary, values, text))


def read_part(
    file: Path, codec: Codec, options: Record | None = None, *, source: str | None = None
) -> tuple[dict[str, Any], Record]:
    """Read the arrays and the options of a part.

    Raises:
        ValueError: if the file is damaged or renamed, or was made with other options than the given ones, or
            from an input with another checksum. The message names the file.
    """
    if file.is_dir():
        raise _damaged(file, "it is a folder")
    with file.open("rb") as stream:
        try:
            arrays, text = codec.read(stream)
            header = json.loads(text)
            sound = header.pop("checksum") == _checksum(arrays, header)
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
        raise ValueError(
            f"{file} was made with options that differ from its run ({_difference(made_with, options)}). "
            "Use the options of the file, or another folder."
        )
    if source is not None and made_from != source:
        raise ValueError(
            f"{file} contains results of other windows or times. Use the same input to resume, or another "
            "folder."
        )
    return arrays, made_with


def _checksum(arrays: Mapping[str, Any], header: Record) -> str:
    return checksum(arrays, start=json.dumps(header, sort_keys=True))


def _damaged(file: Path, why: str) -> ValueError:
    return ValueError(f"{file} is damaged: delete the file, and run again to compute this part. ({why})")


def _difference(one: Record, other: Record) -> str:
    """Names of the options that differ, shortened, because a damaged record may have long names."""
    differ = [name for name in {**one, **other} if one.get(name) != other.get(name)]
    more = [f"and {len(differ) - _LISTED} more"] if len(differ) > _LISTED else []
    return ", ".join([name[:_LONGEST] for name in differ[:_LISTED]] + more)


class Run:
    """A folder of numbered parts that depend on the same options.

    Args:
        folder: path of the folder, which is created with the first part.
        codec: file format of the parts.
        kind: description of the contents for messages, such as ``"results of identify_many"``.
        unit: word for the counted items, in the plural, such as ``"windows"``.
        options: options that all parts depend on, in the format of
            :func:`reframe_jax.storage.records.describe`.

    Raises:
        ValueError: if the folder is a file.
    """

    def __init__(self, folder: Path, codec: Codec, kind: str, unit: str, options: Record) -> None:
        if folder.exists() and not folder.is_dir():
            raise ValueError(f"{folder} is a file; expected a folder for the {kind}.")
        self.folder = folder
        self._codec = codec
        self._kind = kind
        self._unit = unit
        versions = {"kind": kind, "format": _FORMAT, "version": reframe_jax.__version__}
        self._options: Record = json.loads(json.dumps({**versions, **options}))
        self._total: int | None = None
        self._recorded = False

    @staticmethod
    def open(folder: Path, codec: Codec, kind: str, unit: str) -> "Run":
        """Open the run in a folder for reading; a ValueError says if there is none."""
        run = Run(folder, codec, kind, unit, {})
        files = run.parts
        if not files:
            raise ValueError(f"{folder} contains no {kind} (part-*{codec.suffix}).")
        stored = run._read_record()
        if stored is None:
            _, run._options = read_part(files[min(files)], codec)
        else:
            run._total = stored.pop(unit, None)
            run._options = stored
        return run

    @property
    def parts(self) -> dict[int, Path]:
        """Files of the existing parts by number, in order."""
        found = {}
        for file in self.folder.glob(f"part-*{self._codec.suffix}"):
            if match := _PART.fullmatch(file.stem):
                found[int(match[1])] = file
        return dict(sorted(found.items()))

    @property
    def total(self) -> int | None:
        """Total number of items; None if the run is incomplete and has no given length."""
        return self._total

    @property
    def options(self) -> Record:
        """Options that all parts depend on."""
        return self._options

    def resume(self, total: int | None = None) -> None:
        """Check the existing parts, and remove temporary files of killed writers. Writes nothing.

        Raises:
            ValueError: if the folder contains other data, results with other options, or a damaged record.
            OSError: if the folder does not exist and cannot be created.
        """
        check_place(self.folder)
        remove_leftovers(self.folder)
        self._total = total
        if self._read_record() is not None:
            self._compare()
            return
        for file in self.parts.values():  # without a record, compare the options in every part
            read_part(file, self._codec, self._options)

    def finish(self, total: int | None = None) -> None:
        """Write the record if it is missing, for example because every part existed."""
        self._total = self._total if total is None else total
        self._compare()
        self._record()

    def has(self, number: int) -> bool:
        """Whether a part exists."""
        return self._file(number).exists()

    def read(self, number: int, *, source: str | None = None) -> dict[str, Any]:
        """Read the arrays of a part and check them; see :func:`read_part`."""
        return read_part(self._file(number), self._codec, self._options, source=source)[0]

    def write(self, number: int, arrays: Mapping[str, Any], *, source: str = "") -> None:
        """Write a part; before the first part, also write the record of the run, ``run.json``."""
        if not self._recorded:
            self._compare()
            self._record()
        write_part(self._file(number), self._codec, arrays, self._options, source=source)

    def _file(self, number: int) -> Path:
        return self.folder / f"part-{number:08d}{self._codec.suffix}"

    def _read_record(self) -> Record | None:
        """Read ``run.json``; None if the file does not exist."""
        file = self.folder / _RUN
        try:
            record = json.loads(file.read_bytes())
        except FileNotFoundError:
            return None
        except (ValueError, RecursionError, IsADirectoryError) as error:
            raise _damaged(file, str(error)) from error
        if not isinstance(record, dict) or record.get("kind") != self._kind:
            raise ValueError(
                f"{self.folder} does not contain {self._kind} of this version: see {file}. Use another "
                "folder."
            )
        total = record.get(self._unit)
        if total is not None and (not isinstance(total, int) or total < 0):
            raise _damaged(file, f"{self._unit} is {reprlib.repr(total)}")
        return record

    def _compare(self) -> None:
        """Raise an error if the run has other options; a run without parts is ignored."""
        stored = self._read_record()
        if stored is None or not self.parts:
            return
        total = stored.pop(self._unit, None)
        self._total = total if self._total is None else self._total
        other = _difference(stored, self._options)
        if total is not None and total != self._total:
            other = ", ".join(filter(None, (self._unit, other)))
        if other:
            raise ValueError(
                f"{self.folder} contains {self._kind} with other options ({other}). Use the options of that "
                "run to resume it, or another folder."
            )

    def _record(self) -> None:
        """Write ``run.json`` unless it has the same content."""
        self.folder.mkdir(parents=True, exist_ok=True)
        total = {} if self._total is None else {self._unit: self._total}
        text = json.dumps({**self._options, **total}, indent=1) + "\n"
        file = self.folder / _RUN
        if not file.exists() or file.read_text() != text:
            write_whole(file, lambda temporary: temporary.write_text(text))
        self._recorded = True

"""Runs in parts: existing parts are verified and not computed again.

A run is a folder of numbered parts and ``run.json``, the options that all of them depend on. A part is on
disk completely or not at all. It carries its name, the options, and checksums of its source and its contents,
so every read detects a part that was damaged, copied or made with other options. Nothing is written before
the first part has been computed: refused options leave no trace.
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
_LISTED, _LONGEST = 8, 40  # names of options in a message, and letters of each
_RUN = "run.json"
_PART = re.compile(r"part-(\d{8,})")

Record = dict[str, Any]


def write_part(
    file: Path, codec: Codec, arrays: Mapping[str, Any], options: Record, *, source: str = ""
) -> None:
    """Write a part, completely or not at all.

    Args:
        file: path of the file; its name is recorded in the part.
        codec: the format.
        arrays: contents of the part.
        options: options that the part depends on, as JSON.
        source: checksum of the source of the part.
    """
    values = {name: np.asarray(array) for name, array in arrays.items()}
    header: Record = {"name": file.stem, "source": source, "options": options}
    header["checksum"] = _checksum(values, header)
    text = json.dumps(header)
    write_whole(file, lambda temporary: codec.write(temporary, values, text))


def read_part(
    file: Path, codec: Codec, options: Record | None = None, *, source: str | None = None
) -> tuple[dict[str, Any], Record]:
    """Read the arrays and the options of a part.

    Args:
        file: written by :func:`write_part`.
        codec: the format.
        options: required options; None for any.
        source: required checksum of the source; None for any.

    Raises:
        ValueError: if the file is damaged or renamed, or was made with other options or from another source;
            the message names the file.
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
        except Exception as error:  # what a format makes of damage is not in its documentation
            raise _damaged(file, f"{type(error).__name__}: {error}") from error
    if not sound:
        raise _damaged(file, "its checksum does not match its contents")
    if name != file.stem:
        raise ValueError(f"{file} is a copy of {name}: delete it, and it will be made again.")
    if options is not None and made_with != options:
        raise ValueError(
            f"{file} was made with other options than those of its run ({_difference(made_with, options)}). "
            "Give the options that it was made with, or another folder."
        )
    if source is not None and made_from != source:
        raise ValueError(
            f"{file} holds results of other windows or times. Give the same to resume, or another folder."
        )
    return arrays, made_with


def _checksum(arrays: Mapping[str, Any], header: Record) -> str:
    return checksum(arrays, start=json.dumps(header, sort_keys=True))


def _damaged(file: Path, why: str) -> ValueError:
    return ValueError(f"{file} is damaged: delete it, and it will be made again. ({why})")


def _difference(one: Record, other: Record) -> str:
    """Names of what differs; a damaged record may have names of any length."""
    names = [*one, *(name for name in other if name not in one)]
    differ = [name for name in names if one.get(name) != other.get(name)]
    more = [f"and {len(differ) - _LISTED} more"] if len(differ) > _LISTED else []
    short = [name if len(name) <= _LONGEST else name[:_LONGEST] + "…" for name in differ[:_LISTED]]
    return ", ".join(short + more)


class Run:
    """A folder of numbered parts that depend on the same options.

    Args:
        folder: made when the first part is written.
        codec: format of the parts.
        kind: what the parts hold, in words: ``"results of identify_many"``.
        unit: what is counted, in the plural.
        options: options that all parts depend on, as :func:`reframe_jax.storage.records.describe` writes
            them.

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
        """The run in a folder, to be read.

        Raises:
            ValueError: if there is none, or its record is damaged.
        """
        run = Run(folder, codec, kind, unit, {})
        files = run.parts
        if not files:
            raise ValueError(f"{folder} holds no {kind} (part-*{codec.suffix}).")
        stored = run._read_record()
        if stored is None:
            _, run._options = read_part(files[min(files)], codec)
        else:
            run._total = stored.pop(unit, None)
            run._options = stored
        return run

    @property
    def parts(self) -> dict[int, Path]:
        """Files of the parts that are there, by number, in order."""
        found = {}
        for file in self.folder.glob(f"part-*{self._codec.suffix}"):
            if match := _PART.fullmatch(file.stem):
                found[int(match[1])] = file
        return dict(sorted(found.items()))

    @property
    def total(self) -> int | None:
        """How many there are in all, if the run is known to be complete or was given a length."""
        return self._total

    @property
    def options(self) -> Record:
        """What all parts depend on."""
        return self._options

    def resume(self, total: int | None = None) -> None:
        """Compare with the existing parts, and remove leftovers of killed writers. Writes nothing.

        Args:
            total: how many there are in all, if known.

        Raises:
            ValueError: if the folder holds other data, results with other options, or a damaged record.
            OSError: if the folder is not there and cannot be made.
        """
        check_place(self.folder)
        remove_leftovers(self.folder)
        self._total = total
        if self._read_record() is not None:
            self._compare()
            return
        for file in self.parts.values():  # without a record every part has to speak for itself
            read_part(file, self._codec, self._options)

    def finish(self, total: int | None = None) -> None:
        """Write the record if it is missing, for example because no part had to be made.

        Args:
            total: how many there were in all, where that is known at the end only.

        Raises:
            ValueError: if an earlier run met another number.
        """
        self._total = self._total if total is None else total
        self._compare()
        self._record()

    def has(self, number: int) -> bool:
        """Whether a part is there."""
        return self._file(number).exists()

    def read(self, number: int, *, source: str | None = None) -> dict[str, Any]:
        """The arrays of a part, checked; see :func:`read_part`."""
        return read_part(self._file(number), self._codec, self._options, source=source)[0]

    def write(self, number: int, arrays: Mapping[str, Any], *, source: str = "") -> None:
        """Write a part, after the record of the run.

        Raises:
            ValueError: if another process has begun a run with other options in the meantime.
        """
        if not self._recorded:
            self._compare()
            self._record()
        write_part(self._file(number), self._codec, arrays, self._options, source=source)

    def _file(self, number: int) -> Path:
        return self.folder / f"part-{number:08d}{self._codec.suffix}"

    def _read_record(self) -> Record | None:
        """What ``run.json`` says; None if there is none."""
        file = self.folder / _RUN
        try:
            record = json.loads(file.read_bytes())
        except FileNotFoundError:
            return None
        except (ValueError, RecursionError, IsADirectoryError) as error:
            raise _damaged(file, str(error)) from error
        if not isinstance(record, dict) or record.get("kind") != self._kind:
            raise ValueError(
                f"{self.folder} holds something else than {self._kind}, or those of an earlier version: "
                f"see {file}. Give another folder."
            )
        total = record.get(self._unit)
        if total is not None and (not isinstance(total, int) or total < 0):
            raise _damaged(file, f"{self._unit} is {reprlib.repr(total)}")
        return record

    def _compare(self) -> None:
        """Refuse to go on with a run of other options; one that has no part yet is in nobody's way."""
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
                f"{self.folder} holds {self._kind} with other options ({other}). Give the options of that "
                "run to resume it, or another folder."
            )

    def _record(self) -> None:
        """Write ``run.json``, unless it says the same."""
        self.folder.mkdir(parents=True, exist_ok=True)
        total = {} if self._total is None else {self._unit: self._total}
        text = json.dumps({**self._options, **total}, indent=1) + "\n"
        file = self.folder / _RUN
        if not file.exists() or file.read_text() != text:
            write_whole(file, lambda temporary: temporary.write_text(text))
        self._recorded = True

"""Shared code of the text readers: lines one at a time, numbers collected in compact arrays.

Texts are UTF-8, or in the encodings in which spreadsheets save them: UTF-16, and that of Windows.

A row takes 72 bytes, however long its text is; no more than a line of text is held at a time.
"""

import codecs
import datetime
import decimal
import math
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import EPOCH, MOST_ROWS, Rows, shown

__all__ = ["Collector", "head_in_utf8", "read_lines"]

_MISSING = {"", "null", "none", "na", "n/a", "-", "--", "missing", "#n/a"}
_LONGEST = 2**16  # characters of a line, and bytes by which an encoding is recognised
_SEPARATOR = "sep="  # starts the first line in some files of spreadsheets
_CONTROLS = bytes(range(9)) + b"\x0e\x0f\x7f"  # of no text
# digits enough for nanoseconds since 1970; what is no number becomes NaN instead of an exception
_EXACT = decimal.Context(prec=50, traps=[])


def read_lines(path: Path, blanks: str | None = None) -> Iterator[tuple[int, str]]:
    """Numbered lines of a text that are not blank, stripped, one at a time.

    A first line such as ``sep=;`` is left out.

    Args:
        path: the file.
        blanks: characters to strip at both ends; all white space by default.

    Raises:
        RecordingError: if a line is longer than 65,536 characters.
        OSError, UnicodeDecodeError: from the file.
    """
    with path.open("rb") as start:
        encoding = _find_encoding(start.read(_LONGEST))
    with path.open(encoding=encoding) as file:
        number = 0
        while line := file.readline(_LONGEST + 1):
            number += 1
            if len(line) > _LONGEST:
                raise RecordingError(
                    f"{path}: line {number}: is longer than {_LONGEST} characters; expected a row of numbers."
                )
            if line.strip() and not (number == 1 and line.startswith(_SEPARATOR)):
                yield number, line.strip(blanks).replace("\u2212", "-")  # the minus sign of typesetters


def head_in_utf8(head: bytes) -> bytes:
    """The first bytes of a file as readers recognise them: a text of a spreadsheet as plain UTF-8."""
    if (encoding := _find_encoding(head)) == "utf-16":
        head = head.decode(encoding, errors="ignore").encode()
    return head.partition(b"\n")[2] if head.startswith(_SEPARATOR.encode()) else head


def _find_encoding(head: bytes) -> str:
    """The encoding of a text, by its first bytes; UTF-8 where they are no text."""
    zero = {codecs.BOM_UTF16_LE: 3, codecs.BOM_UTF16_BE: 2}.get(head[:2])
    if zero is not None and head[zero : zero + 1] == b"\0":  # the first letter is a plain one
        return "utf-16"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        if not set(_CONTROLS) & set(head):
            return "cp1252"
    return "utf-8-sig"


class Collector:
    """Turns rows of text into :class:`Rows`.

    Times whose first is later than 1e6 s, such as those since 1970, count from it. They are subtracted as
    they are written, before rounding: floats resolve the time since 1970 to no better than 0.2 us.

    Args:
        path: the file.
        width: cells of every row.
        time: index of the cell with the time, or of two with seconds and nanoseconds, or None.
        columns: indices of the cells with the numbers of a pose.
        wrench: indices of the six cells with a wrench, or none.
    """

    def __init__(
        self,
        path: Path,
        width: int,
        time: int | tuple[int, int] | None,
        columns: Sequence[int],
        wrench: Sequence[int] = (),
    ) -> None:
        self._path, self._width, self._time = path, width, time
        self._columns, self._pose = [*columns, *wrench], len(columns)
        self._where, self._values, self._times = array("q"), array("d"), array("d")
        self._started, self._origin = False, decimal.Decimal(0)

    def add(self, number: int, cells: list[str]) -> None:
        """Add the row in a line.

        Raises:
            RecordingError: if a cell is missing or not a number, or if there are too many rows.
        """
        if len(cells) != self._width:
            raise self._error(
                number,
                f"expected {self._width} columns, found {len(cells)}; delete the line if the recording was "
                "cut off there.",
            )
        if len(self._where) == MOST_ROWS:
            raise self._error(number, f"expected at most {MOST_ROWS} rows; cut the recording into files.")
        self._where.append(number)
        try:
            self._values.extend([float(cells[column]) for column in self._columns])
        except ValueError:
            self._values.extend([self._number(number, cells[column]) for column in self._columns])
        if isinstance(self._time, int):
            self._times.append(self._seconds(number, cells[self._time].strip()))
        elif self._time is not None:
            seconds, nanoseconds = (cells[column].strip() for column in self._time)
            stamp = f"{seconds}.{nanoseconds.zfill(9)}" if seconds.isdecimal() else ""
            self._times.append(self._seconds(number, stamp))

    def rows(self) -> Rows:
        """All rows that were added."""
        values = np.asarray(self._values).reshape(-1, len(self._columns))
        return Rows(
            self._path,
            "line",
            np.asarray(self._where),
            values[:, : self._pose],
            None if self._time is None else np.asarray(self._times),
            str(self._origin) if self._origin else None,
            wrenches=values[:, self._pose :] if self._pose < len(self._columns) else None,
            seconds=1.0 if isinstance(self._time, tuple) else None,
        )

    def _seconds(self, number: int, cell: str) -> float:
        """A time, since the first one if that is late."""
        if ":" in cell:
            cell = _since_1970(cell)
        seconds = self._number(number, cell)
        if not math.isfinite(seconds):
            return seconds
        if not self._started:
            self._started = True
            if abs(seconds) >= EPOCH:
                self._origin = _exactly(cell)
        if not self._origin:
            return seconds
        return float(_EXACT.subtract(_exactly(cell), self._origin))

    def _number(self, number: int, cell: str) -> float:
        """A number, NaN for an empty cell or a word for it."""
        try:
            return float("nan" if cell.strip().lower() in _MISSING else cell)
        except ValueError:
            raise self._error(number, f"expected numbers: found '{shown(cell.strip(), 40)}'.") from None

    def _error(self, number: int, problem: str) -> RecordingError:
        return RecordingError(f"{self._path}: line {number}: {problem}")


def _since_1970(cell: str) -> str:
    """A date and time in s, UTC unless it says otherwise; a text that is none as it is."""
    try:
        moment = datetime.datetime.fromisoformat(cell.strip())
    except ValueError:
        return cell
    moment = moment if moment.tzinfo else moment.replace(tzinfo=datetime.UTC)
    since = moment - datetime.datetime.fromtimestamp(0, datetime.UTC)
    return f"{since.days * 86400 + since.seconds}.{since.microseconds:06d}"


def _exactly(cell: str) -> decimal.Decimal:
    """What ``float`` rounds, underscores between digits included."""
    return _EXACT.create_decimal(cell.replace("_", ""))

"""Divide text files into lines and cells, and collect their numbers, for all readers of text.

Texts are UTF-8, or in the encodings of spreadsheets: UTF-16 and Windows-1252. Only one line is in memory; the
numbers of a row take 72 bytes.
"""

import codecs
import csv
import datetime
import decimal
import math
import re
from array import array
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from reframe_jax.recordings.recording import EPOCH, RecordingError, Rows, check_size, shown

Lines = Iterator[tuple[int, list[str]]]
"""Numbers and cells of lines."""

_LONGEST = 2**16  # characters of a line, and bytes that show the encoding
_SEPARATOR = "sep="  # start of the first line in some files of spreadsheets
_CONTROLS = bytes(range(9)) + b"\x0e\x0f\x7f"  # not in texts
_DECIMAL_COMMA = re.compile(r"[-+]?(\d+|\d*,\d+)(e[-+]?\d+)?", re.IGNORECASE)
_MISSING = re.compile(
    r"|null|none|na|n/a|-+|\?+|\*+|missing|lost|invalid|occluded|no data|#.*|[-+]?(1\.#.*|nan\(.*\))",
    re.IGNORECASE,
)
_CLOCK = re.compile(r"(\d+):([0-5]\d):([0-5]\d(?:\.\d+)?)")  # hours, minutes, seconds
# enough digits for nanoseconds since 1970; cells that are no numbers become NaN, without exceptions
_EXACT = decimal.Context(prec=50, traps=[])


def read_lines(path: Path, blanks: str | None = None) -> Iterator[tuple[int, str]]:
    """Yield the numbers and the stripped text of all lines that are not blank, without ``sep=;``.

    ``blanks`` are the characters to strip at both ends, by default all white space. Lines of more than
    65,536 characters are refused.
    """
    with path.open("rb") as start:
        encoding = _find_encoding(start.read(_LONGEST))
    with path.open(encoding=encoding) as file:
        for number, line in enumerate(iter(lambda: file.readline(_LONGEST + 1), ""), 1):
            if len(line) > _LONGEST:
                raise RecordingError(
                    f"{path}: line {number}: is longer than {_LONGEST} characters; expected a row of numbers."
                )
            if line.strip() and not (number == 1 and line.startswith(_SEPARATOR)):
                yield number, line.strip(blanks).replace("\u2212", "-")  # typographic minus sign


def read_cells(path: Path, delimiter: str | None = None) -> Lines:
    """Yield the numbers and the cells of all lines of an export that are not blank.

    By default, the first tab, semicolon or comma of a line is its delimiter, because later cells may be names
    or decimal numbers with other marks.
    """
    for number, line in read_lines(path, "\r\n"):
        mark = delimiter or next((letter for letter in line if letter in "\t;,"), ",")
        cells = split(line, mark)
        if any(cells):  # spreadsheets fill blank lines with delimiters
            yield number, cells


def head_in_utf8(head: bytes) -> bytes:
    """Convert the first bytes of a file: UTF-16 to UTF-8, without a byte order mark and ``sep=;``."""
    if (encoding := _find_encoding(head)) == "utf-16":
        head = head.decode(encoding, errors="ignore").encode()
    head = head.removeprefix(codecs.BOM_UTF8)
    return head.partition(b"\n")[2] if head.startswith(_SEPARATOR.encode()) else head


def _find_encoding(head: bytes) -> str:
    """Return the encoding of a text by its first bytes; UTF-8 if the bytes are no text."""
    zero = {codecs.BOM_UTF16_LE: 3, codecs.BOM_UTF16_BE: 2}.get(head[:2])
    if zero is not None and head[zero : zero + 1] == b"\0":  # the first letter is in ASCII
        return "utf-16"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        if not set(_CONTROLS) & set(head):
            return "cp1252"
    return "utf-8-sig"


def split(line: str, delimiter: str | None) -> list[str]:
    """Divide a line into stripped cells, and convert decimal commas to points; None divides at blanks.

    If commas separate the cells, numbers with decimal commas are in quotes.
    """
    if delimiter is None:
        cells = re.sub(r"\s+(?=[\[(])", "", line).split()  # a unit belongs to the name before it
    else:
        cells = next(csv.reader([line], delimiter=delimiter)) if '"' in line else line.split(delimiter)
    cells = [cell.strip() for cell in cells]
    if (delimiter != "," or '"' in line) and "," in line:
        cells = [cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell for cell in cells]
    return cells


def trim(cells: list[str], width: int = 0) -> list[str]:
    """Remove empty cells at the end, down to a width."""
    end = len(cells)
    while end > width and not cells[end - 1]:
        end -= 1
    return cells[:end]


def find_delimiter(line: str) -> str | None:
    """Return the character between the cells of a header or of a row of numbers; None for blanks."""
    marks = re.sub(r"([;,|])\s+", r"\1", line)  # a tab after a comma is a blank
    found = next((mark for mark in "\t;,|" if mark in marks), None)
    words = line.split() if found == "," else []
    # numbers with decimal commas between blanks
    return None if len(words) > 2 and all(map(_DECIMAL_COMMA.fullmatch, words)) else found


def first_numbers(head: bytes) -> tuple[int, list[str]]:
    """Return the count of numbers in the first row of a text, and the cells of the comment before the row.

    The count is 0 if the first row that is no comment contains other cells than numbers.
    """
    comment: list[str] = []
    for line in head.decode("utf-8", errors="replace").splitlines():
        text = line.strip()
        if text.startswith(("#", "%")):
            text = text.lstrip("#% ")
            comment = split(text, find_delimiter(text))
        elif text:
            text = text.partition("#")[0].strip()
            cells = trim(split(text, find_delimiter(text)))
            numbers = any(cells) and all(is_number(cell) or not cell for cell in cells)
            return (len(cells) if numbers else 0), comment
    return 0, comment


def is_number(cell: str) -> bool:
    """Return whether a cell contains a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def collect(
    path: Path,
    lines: Iterable[tuple[int, list[str]]],
    width: int,
    columns: Sequence[int],
    time: int | tuple[int, int] | None = None,
    wrench: Sequence[int] = (),
    short: bool = False,
) -> Rows:
    """Collect the numbers in some columns of a table; NaN for empty cells.

    If the first time is later than 1e6 s, times count from it. They are subtracted as decimal numbers,
    because floats resolve the time since 1970 only to 0.2 us. Cells that are no numbers are refused, and rows
    with another count of cells than ``width``, except empty cells beyond it; ``short`` rows may have fewer.

    ``time`` is the column of times, or those of seconds and of nanoseconds. The columns of a measured
    ``wrench`` are kept apart from the poses.
    """
    where, values, times, every = array("q"), array("d"), array("d"), [*columns, *wrench]
    origin: decimal.Decimal | None = None
    for number, cells in lines:
        if short:
            cells = cells + [""] * (width - len(cells))
        cells = trim(cells, width)
        if len(cells) != width:
            remedy = "delete the line if the recording ended there"
            if len(cells) > width:
                remedy = "if numbers have decimal commas, separate the columns by semicolons"
            raise RecordingError(
                f"{path}: line {number}: expected {width} columns, found {len(cells)}; {remedy}."
            )
        where.append(number)
        check_size(path, len(where))
        try:
            values.extend([float(cells[column]) for column in every])
        except ValueError:
            values.extend([_number(path, number, cells[column]) for column in every])
        if time is not None:
            cell = _stamp(cells, time)
            seconds = _number(path, number, cell)
            if math.isfinite(seconds) and (origin or origin is None):
                exact = _EXACT.create_decimal(cell.replace("_", ""))  # with all digits
                if origin is None:
                    origin = decimal.Decimal(0) if abs(seconds) < EPOCH else exact
                seconds = float(_EXACT.subtract(exact, origin)) if origin else seconds
            times.append(seconds)
    poses, wrenches = np.hsplit(np.asarray(values).reshape(-1, len(every)), [len(columns)])
    rows = Rows(path, "line", np.asarray(where), poses, None if time is None else np.asarray(times))
    rows.origin = str(origin) if origin else None
    rows.wrenches = wrenches if wrench else None
    rows.seconds = 1.0 if isinstance(time, tuple) else None
    return rows


def _number(path: Path, number: int, cell: str) -> float:
    """Convert a cell to a number; NaN if the number is missing."""
    try:
        return float("nan" if _MISSING.fullmatch(cell) else cell)
    except ValueError:
        date = re.search(r"\d[-:/.]\d+[-:/.]\d", cell)
        hint = "; write times in seconds, or as 2024-05-01 10:00:00.250" if date else ""
        problem = f"expected numbers: found '{shown(cell, 40)}'{hint}."
        raise RecordingError(f"{path}: line {number}: {problem}") from None


def _stamp(cells: list[str], time: int | tuple[int, int]) -> str:
    """Return a time in seconds, as text; for a date, the seconds since 1970 (UTC by default)."""
    if isinstance(time, tuple):
        seconds, nanoseconds = (cells[column] for column in time)
        return f"{seconds}.{nanoseconds.zfill(9)}" if seconds.isdecimal() else ""
    cell = cells[time]
    if ":" not in cell:
        return cell
    if match := _CLOCK.fullmatch(cell):
        return str(3600 * int(match[1]) + 60 * int(match[2]) + decimal.Decimal(match[3]))
    try:
        moment = datetime.datetime.fromisoformat(cell)
    except ValueError:
        return cell
    moment = moment if moment.tzinfo else moment.replace(tzinfo=datetime.UTC)
    since = moment - datetime.datetime.fromtimestamp(0, datetime.UTC)
    return f"{since.days * 86400 + since.seconds}.{since.microseconds:06d}"

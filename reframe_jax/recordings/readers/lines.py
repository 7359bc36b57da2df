"""Divide text files into lines and cells, for all readers of text.

Texts are UTF-8, or in the encodings of spreadsheets: UTF-16 and Windows-1252. Only one line is in memory.
"""

import codecs
import csv
import re
from collections.abc import Iterator
from pathlib import Path

from reframe_jax.recordings.recording import RecordingError

Lines = Iterator[tuple[int, list[str]]]
"""Numbers and cells of lines."""

_LONGEST = 2**16  # characters of a line, and bytes that show the encoding
_SEPARATOR = "sep="  # start of the first line in some files of spreadsheets
_CONTROLS = bytes(range(9)) + b"\x0e\x0f\x7f"  # not in texts
_DECIMAL_COMMA = re.compile(r"[-+]?(\d+|\d*,\d+)(e[-+]?\d+)?", re.IGNORECASE)


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

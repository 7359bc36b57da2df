"""Shared code of the text readers: lines one at a time, and the cells in them.

Texts are UTF-8, or in the encodings in which spreadsheets save them: UTF-16, and that of Windows. No more
than a line of text is held at a time.
"""

import codecs
import csv
import re
from collections.abc import Iterator
from pathlib import Path

from reframe_jax.recordings.recording import RecordingError

__all__ = ["find_delimiter", "first_numbers", "head_in_utf8", "is_number", "read_lines", "split", "trim"]

_LONGEST = 2**16  # characters of a line, and bytes by which an encoding is recognised
_SEPARATOR = "sep="  # starts the first line in some files of spreadsheets
_CONTROLS = bytes(range(9)) + b"\x0e\x0f\x7f"  # of no text
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(e[-+]?\d+)?", re.IGNORECASE)


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


def split(line: str, delimiter: str | None) -> list[str]:
    """Cells of a line, stripped; decimal commas become points, in quotes if commas separate the cells.

    Args:
        line: the line.
        delimiter: between the cells; blanks by default.
    """
    if delimiter is None:
        cells = re.sub(r"\s+(?=[\[(])", "", line).split()  # a unit belongs to the name before it
    else:
        cells = next(csv.reader([line], delimiter=delimiter)) if '"' in line else line.split(delimiter)
    if (delimiter != "," or '"' in line) and "," in line:
        cells = [cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell.strip()) else cell for cell in cells]
    return [cell.strip() for cell in cells]


def trim(cells: list[str], width: int = 0) -> list[str]:
    """Cells without the empty ones at the end, but no fewer than a width."""
    end = len(cells)
    while end > width and not cells[end - 1]:
        end -= 1
    return cells[:end]


def find_delimiter(line: str) -> str | None:
    """The character between the cells of a header or of a row of numbers; None for blanks."""
    return next((mark for mark in "\t;," if mark in line), None)


def first_numbers(head: bytes) -> tuple[int, list[str]]:
    """Of the first bytes of a text: the numbers in the first row, and the cells of the comment before it.

    0 if the first row that is no comment does not consist of numbers.
    """
    comment: list[str] = []
    for line in head.decode("utf-8-sig", errors="replace").splitlines():
        text = line.strip()
        if text.startswith(("#", "%")):
            text = text.lstrip("#% ")
            comment = split(text, find_delimiter(text))
        elif text:
            text = text.partition("#")[0].strip()
            cells = trim(split(text, find_delimiter(text)))
            # "0.1, 0.2" is separated by commas, "0.1 0.2" by blanks
            whole = all(is_number(cell) or not cell for cell in cells) and any(cells)
            return (len(cells) if whole else 0), comment
    return 0, comment


def is_number(cell: str) -> bool:
    """Whether a cell holds a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return True

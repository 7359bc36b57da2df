"""Shared code of the exports of motion-capture systems: a header, then a row of numbers per frame."""

import csv
import re
from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path

import numpy as np

from reframe_jax.recordings.readers.lines import Collector, read_lines
from reframe_jax.recordings.rows import Rows

__all__ = [
    "collect",
    "collect_plain",
    "drop_zeros",
    "find_delimiter",
    "first_numbers",
    "is_number",
    "matrix_rows",
    "split",
    "trim",
]

_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(e[-+]?\d+)?", re.IGNORECASE)


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


def collect(
    path: Path,
    lines: Iterable[tuple[int, list[str]]],
    width: int,
    columns: Sequence[int],
    time: int | tuple[int, int] | None = None,
    wrench: Sequence[int] = (),
    short: bool = False,
) -> Rows:
    """Numbers in some columns of a table; NaN for empty cells.

    Args:
        path: the file.
        lines: their numbers and cells; empty cells beyond the width are dropped.
        width: cells of every row.
        columns: indices of those that are kept, in this order.
        time: index of the time, or of its seconds and nanoseconds.
        wrench: indices of a wrench, or none.
        short: whether rows may end early, where nothing was seen.
    """
    rows = Collector(path, width, time, columns, wrench)
    for number, cells in lines:
        if short:
            cells += [""] * (width - len(cells))
        rows.add(number, trim(cells, width))
    return rows.rows()


def collect_plain(path: Path, starts: dict[int, int]) -> Rows:
    """All numbers of lines without a header; ``#`` and ``%`` start a comment.

    Args:
        path: the file.
        starts: the column of the first number of a pose, 1 where the time is before it, by the numbers in
            the first row.
    """
    texts = ((number, re.split("[#%]", line)[0].strip()) for number, line in read_lines(path))
    rows = ((number, split(text, find_delimiter(text))) for number, text in texts if text)
    number, cells = next(rows)
    width = len(trim(cells))
    first = starts[width]
    return collect(path, chain([(number, cells)], rows), width, range(first, width), 0 if first else None)


def drop_zeros(rows: Rows, values: np.ndarray) -> None:
    """Drop the rows in which all values (N, M) are 0: so some systems write that a body was not seen."""
    rows.keep(~(values == 0).all(axis=1), "all numbers are 0, as the body was not seen", "untracked")


def matrix_rows(matrices: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Matrices (N, 3, 3) and positions (N, 3) as the values (N, 12) of :class:`Rows`."""
    return np.concatenate([matrices, positions[..., None]], axis=-1).reshape(-1, 12)

"""Shared code of the exports of motion-capture systems: a header, then a row of numbers per frame."""

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from reframe_jax.recordings.readers.lines import Collector
from reframe_jax.recordings.rows import Rows

__all__ = ["collect", "drop_zeros", "is_number", "matrix_rows", "split"]


def split(line: str, delimiter: str) -> list[str]:
    """Cells of a line, stripped."""
    cells = next(csv.reader([line], delimiter=delimiter)) if '"' in line else line.split(delimiter)
    return [cell.strip() for cell in cells]


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
    time: int | None = None,
    short: bool = False,
) -> Rows:
    """Numbers in some columns of a table; NaN for empty cells.

    Args:
        path: the file.
        lines: their numbers and cells; empty cells beyond the width are dropped.
        width: cells of every row.
        columns: indices of those that are kept, in this order.
        time: index of the time.
        short: whether rows may end early, where nothing was seen.
    """
    rows = Collector(path, width, time, columns)
    for number, cells in lines:
        if short:
            cells += [""] * (width - len(cells))
        while len(cells) > width and not cells[-1]:
            cells.pop()
        rows.add(number, cells)
    return rows.rows()


def drop_zeros(rows: Rows, values: np.ndarray) -> None:
    """Drop the rows in which all values (N, M) are 0: so some systems write that a body was not seen."""
    rows.keep(~(values == 0).all(axis=1), "all numbers are 0, as the body was not seen", "untracked")


def matrix_rows(matrices: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Matrices (N, 3, 3) and positions (N, 3) as the values (N, 12) of :class:`Rows`."""
    return np.concatenate([matrices, positions[..., None]], axis=-1).reshape(-1, 12)

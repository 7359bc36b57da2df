"""Shared code of the text readers: numbers of cells, collected in compact arrays.

A row takes 72 bytes, however long its text is.
"""

import datetime
import decimal
import math
import re
from array import array
from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path

import numpy as np

from reframe_jax.recordings.readers.lines import find_delimiter, read_lines, split, trim
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import EPOCH, MOST_ROWS, Rows, shown

__all__ = ["collect", "collect_plain", "drop_zeros", "matrix_rows"]

_MISSING = {"", "null", "none", "na", "n/a", "-", "--", "missing", "#n/a"}
# digits enough for nanoseconds since 1970; what is no number becomes NaN instead of an exception
_EXACT = decimal.Context(prec=50, traps=[])


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

    Times whose first is later than 1e6 s, such as those since 1970, count from it. They are subtracted as
    they are written, before rounding: floats resolve the time since 1970 to no better than 0.2 us.

    Args:
        path: the file.
        lines: their numbers and cells; empty cells beyond the width are dropped.
        width: cells of every row.
        columns: indices of those that are kept, in this order.
        time: index of the time, or of its seconds and nanoseconds.
        wrench: indices of a wrench, or none.
        short: whether rows may end early, where nothing was seen.

    Raises:
        RecordingError: if a cell is missing or not a number, or if there are too many rows.
    """
    where, values, times, every = array("q"), array("d"), array("d"), [*columns, *wrench]
    origin: decimal.Decimal | None = None
    for number, cells in lines:
        if short:
            cells = cells + [""] * (width - len(cells))
        cells = trim(cells, width)
        if len(cells) != width:
            raise _error(
                path,
                number,
                f"expected {width} columns, found {len(cells)}; delete the line if the recording was cut off "
                "there.",
            )
        if len(where) == MOST_ROWS:
            raise _error(path, number, f"expected at most {MOST_ROWS} rows; cut the recording into files.")
        where.append(number)
        try:
            values.extend([float(cells[column]) for column in every])
        except ValueError:
            values.extend([_number(path, number, cells[column]) for column in every])
        if time is not None:
            cell = _stamp(cells, time)
            seconds = _number(path, number, cell)
            if origin is None and math.isfinite(seconds):
                origin = decimal.Decimal(0) if abs(seconds) < EPOCH else _exactly(cell)
            if origin and math.isfinite(seconds):
                seconds = float(_EXACT.subtract(_exactly(cell), origin))
            times.append(seconds)
    numbers = np.asarray(values).reshape(-1, len(every))
    return Rows(
        path,
        "line",
        np.asarray(where),
        numbers[:, : len(columns)],
        None if time is None else np.asarray(times),
        str(origin) if origin else None,
        wrenches=numbers[:, len(columns) :] if wrench else None,
        seconds=1.0 if isinstance(time, tuple) else None,
    )


def collect_plain(path: Path, starts: dict[int, int]) -> Rows:
    """All numbers of lines without a header; ``#`` and ``%`` start a comment.

    Args:
        path: the file.
        starts: the column of the first number of a pose, 1 where the time is before it, by the numbers in
            the first row.
    """
    texts = ((number, re.split("[#%]", line)[0].strip()) for number, line in read_lines(path))
    rows = ((number, split(text, find_delimiter(text))) for number, text in texts if text)
    number, cells = next(rows, (0, []))
    width = len(trim(cells))
    if width not in starts:
        raise _error(path, number, f"expected {' or '.join(map(str, starts))} numbers, found {width}.")
    first = starts[width]
    return collect(path, chain([(number, cells)], rows), width, range(first, width), 0 if first else None)


def _error(path: Path, number: int, problem: str) -> RecordingError:
    return RecordingError(f"{path}: line {number}: {problem}")


def _number(path: Path, number: int, cell: str) -> float:
    """A number, NaN for an empty cell or a word for it."""
    try:
        return float("nan" if cell.strip().lower() in _MISSING else cell)
    except ValueError:
        raise _error(path, number, f"expected numbers: found '{shown(cell.strip(), 40)}'.") from None


def _stamp(cells: list[str], time: int | tuple[int, int]) -> str:
    """A time as it is written: seconds, of dates since 1970 UTC unless they say otherwise."""
    if isinstance(time, tuple):
        seconds, nanoseconds = (cells[column].strip() for column in time)
        return f"{seconds}.{nanoseconds.zfill(9)}" if seconds.isdecimal() else ""
    cell = cells[time].strip()
    try:
        moment = datetime.datetime.fromisoformat(cell if ":" in cell else "")
    except ValueError:
        return cell
    moment = moment if moment.tzinfo else moment.replace(tzinfo=datetime.UTC)
    since = moment - datetime.datetime.fromtimestamp(0, datetime.UTC)
    return f"{since.days * 86400 + since.seconds}.{since.microseconds:06d}"


def _exactly(cell: str) -> decimal.Decimal:
    """What ``float`` rounds, underscores between digits included."""
    return _EXACT.create_decimal(cell.replace("_", ""))


def drop_zeros(rows: Rows, values: np.ndarray) -> None:
    """Drop the rows in which all values (N, M) are 0: so some systems write that a body was not seen."""
    rows.keep(~(values == 0).all(axis=1), "all numbers are 0, as the body was not seen", "untracked")


def matrix_rows(matrices: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Matrices (N, 3, 3) and positions (N, 3) as the values (N, 12) of :class:`Rows`."""
    return np.concatenate([matrices, positions[..., None]], axis=-1).reshape(-1, 12)

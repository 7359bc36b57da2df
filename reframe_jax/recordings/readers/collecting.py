"""Collect the numbers of a text file in compact arrays; a row takes 72 bytes."""

import datetime
import decimal
import math
import re
from array import array
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from reframe_jax.recordings.readers.lines import trim
from reframe_jax.recordings.recording import EPOCH, RecordingError, Rows, check_size, shown

_MISSING = re.compile(
    r"|null|none|na|n/a|-+|\?+|\*+|missing|lost|invalid|occluded|no data|#.*|[-+]?(1\.#.*|nan\(.*\))",
    re.IGNORECASE,
)
_CLOCK = re.compile(r"(\d+):([0-5]\d):([0-5]\d(?:\.\d+)?)")  # hours, minutes, seconds
# enough digits for nanoseconds since 1970; cells that are no numbers become NaN, without exceptions
_EXACT = decimal.Context(prec=50, traps=[])
_NEAREST = 3.0  # no body is measured within 3 mm of a tracker, and few beyond 3 m


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
    because floats resolve the time since 1970 only to 0.2 us. Cells that are no numbers are refused.

    Args:
        path: the file.
        lines: line number and cells of every line; empty cells beyond the width are ignored.
        width: count of cells in a row; rows with another count are refused.
        columns: indices of the columns.
        time: index of the column of times, or of the columns of seconds and of nanoseconds.
        wrench: indices of the columns of a measured wrench, which is kept apart from the poses.
        short: whether rows may have fewer cells than ``width``; the missing ones are empty.
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


def drop_zeros(rows: Rows, values: np.ndarray) -> None:
    """Leave out the rows in which all values (N, M) are 0, which mark a body that was not seen."""
    rows.keep(~(values == 0).all(axis=1), "all numbers are 0, as the body was not seen", "untracked")


def assume_millimetres(rows: Rows, writer: str) -> None:
    """Set the unit to mm, which ``writer`` usually writes, or to m for small positions, with a note."""
    distance = np.linalg.norm(rows.positions, axis=1)
    distance = distance[np.isfinite(distance)]
    near = len(distance) > 0 and bool(np.median(distance) < _NEAREST)
    rows.metres = 1.0 if near else 1e-3
    rows.notes.append(
        f"positions are read in m, because in mm they would be less than {_NEAREST:g} mm from the origin; if "
        "they are in mm, give unit='mm' (--unit mm)."
        if near
        else f"positions are read in mm, as {writer} writes them."
    )


def matrix_rows(matrices: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Join R (N, 3, 3) and p (N, 3) to the values (N, 12) of :class:`Rows`: [R p], row by row."""
    return np.concatenate([matrices, positions[..., None]], axis=-1).reshape(-1, 12)

"""Tables with a header: columns are found by their names."""

import csv
import re
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from reframe_jax.recordings.readers.lines import Collector, read_lines
from reframe_jax.recordings.readers.reader import Reader
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import HEADER, Rows, shown
from reframe_jax.recordings.selection import Selection

__all__ = ["TABLE", "read_table"]

_COMMENT = "#%"


def read_table(path: Path, wanted: Selection) -> Rows:
    """Read a table whose header is the first line, or the last comment before the numbers.

    Args:
        path: the file.
        wanted: the unit of the positions, which are not converted. A header may name it: ``x [mm]``.

    Raises:
        RecordingError: if a column is missing or named twice, or a row does not fit the header.
    """
    lines = read_lines(path)
    comments, first = _first_row(lines)
    following = next(lines, None)
    if first is None or following is None:
        what = "has no more than one line of text" if first or comments else "is empty"
        raise RecordingError(f"{path}: {what}; expected a header such as {HEADER}, and rows of numbers.")
    delimiter = next((mark for mark in "\t;" if mark in first[1]), ",")
    pending = [following]
    number, text = first
    if comments and _is_number(_cells(text, delimiter)[0]):
        (number, text), pending = comments[-1], [first, following]
    header = _cells(text.lstrip(_COMMENT + " "), delimiter)
    if _is_number(header[0]):
        raise RecordingError(
            f"{path}: line {number}: expected a header such as {HEADER}, found numbers; name the columns, "
            "or save a TUM trajectory as .txt."
        )
    names = [name.strip() for name in header]
    time, columns = _find_columns(path, names, wanted.unit or "m")
    rows = Collector(path, len(header), time, columns, _find_wrench(names))
    for number, line in chain(pending, lines):
        if line[0] not in _COMMENT:
            rows.add(number, _cells(line, delimiter))
    return rows.rows()


def _first_row(lines: Iterator[tuple[int, str]]) -> tuple[list[tuple[int, str]], tuple[int, str] | None]:
    """The last comment at the start of a file, if any, and the line after it."""
    comments: list[tuple[int, str]] = []
    for line in lines:
        if line[1][0] not in _COMMENT:
            return comments, line
        comments = [line]
    return comments, None


def _cells(line: str, delimiter: str) -> list[str]:
    return next(csv.reader([line], delimiter=delimiter)) if '"' in line else line.split(delimiter)


def _is_number(cell: str) -> bool:
    return bool(re.fullmatch(r"\s*[-+]?[\d.]+(e[-+]?\d+)?\s*", cell, re.IGNORECASE))


def _find_columns(path: Path, header: list[str], unit: str) -> tuple[int | None, list[int]]:
    """Columns of time and of the numbers of a pose."""
    names = [_plain(name) for name in header]

    def find(pattern: str) -> int | None:
        found = [i for i, name in enumerate(names) if re.fullmatch(pattern, name)]
        if len(found) > 1:
            both = " and ".join(repr(shown(header[i], 40)) for i in found[:2])
            raise RecordingError(f"{path}: columns {both} mean the same; rename or remove all but one.")
        return found[0] if found else None

    time = find(r"(t|time|times|timestamp|stamp|sec|seconds)(_s|_sec|_seconds)?")
    matrix = [find(f"[mt]_?{i // 4}_?{i % 4}") for i in range(16)]
    for size in (16, 12):
        if None not in matrix[:size]:
            return time, [i for i in matrix[:size] if i is not None]
    pose = {axis: find(rf"(p_?|(.*_)?pos(ition)?_)?{axis}(_{unit})?") for axis in "xyz"}
    if set(pose.values()) == {None} and "fx" not in names:
        pose = {axis: find(rf"t_?{axis}(_{unit})?") for axis in "xyz"}
    pose |= {f"q{axis}": find(rf"(q_?|(.*_)?(quat(ernion)?|orientation)_){axis}") for axis in "xyzw"}
    if missing := [key for key, column in pose.items() if column is None]:
        raise RecordingError(
            f"{path}: no column for {', '.join(missing)} (positions in {unit}); expected a header such as "
            f"{HEADER}, found {shown(','.join(header))}."
        )
    return time, [column for column in pose.values() if column is not None]


def _find_wrench(header: list[str]) -> list[int]:
    """Columns of force and torque, all six or none: fx, force_x, wrench.force.x and the like."""
    names, found = [_plain(name) for name in header], []
    for letter, word, unit in (("f", "force", "n"), ("t", "torque", "nm")):
        for axis in "xyz":
            pattern = rf"({letter}_?|(.*_)?{word}_){axis}(_{unit})?"
            found.append([i for i, name in enumerate(names) if re.fullmatch(pattern, name)])
    return [columns[0] for columns in found] if all(len(columns) == 1 for columns in found) else []


def _plain(name: str) -> str:
    """A name in lower case, its other characters as single underscores."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


TABLE = Reader(
    name="a table with named columns",
    suffixes=(".csv", ".tsv"),
    recognises=lambda path, head: True,
    read=read_table,
    options=frozenset({"unit"}),
)

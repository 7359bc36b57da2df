"""Tables with a header: columns are found by their names, in the units that the header states."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, zip_longest
from pathlib import Path

import numpy as np

from reframe_jax.recordings.readers.collecting import collect
from reframe_jax.recordings.readers.columns import find_columns, set_poses
from reframe_jax.recordings.readers.lines import find_delimiter, is_number, read_lines, split, trim
from reframe_jax.recordings.readers.reader import Reader
from reframe_jax.recordings.readers.units import (
    ANGLE_WORDS,
    LENGTH_WORDS,
    TIME_WORDS,
    split_unit,
    units_of_row,
)
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import HEADER, Rows, shown
from reframe_jax.recordings.selection import UNITS, Selection, flag

__all__ = ["TABLE", "read_table"]

_COMMENT = "#%"
_COLUMNS = "position", "orientation"
_TIMES = (
    r"(.*_)?header_stamp",  # rostopic echo -p: the stamp of the message, rather than when it came
    r"t|times?|timestamps?|stamp|sec|secs|seconds|(elapsed_|ros_)?time",
)
_CLOCK = r"(.*_)?(stamp|timespec)_s(ecs?)?|secs?", r"(.*_)?(stamp|timespec)_n(ano)?s(ecs?)?|n(ano)?secs?"
_POSITIONS = r"{axis}", r"(p_?|p_.+_|(.*_)?(pos(ition)?|loc(ation)?|translation)_){axis}"
_QUATERNIONS = r"q_?{axis}", r"(q_.+_|(.*_)?(quat(ernion)?|orientation|rot(ation)?)_(q_?)?){axis}"
_ANGLES = {
    "x": r"(.*_)?(r_?x|rot(ation)?_(vector_|vec_)?x|(rotvec|euler|angle)_x|roll)",
    "y": r"(.*_)?(r_?y|rot(ation)?_(vector_|vec_)?y|(rotvec|euler|angle)_y|pitch)",
    "z": r"(.*_)?(r_?z|rot(ation)?_(vector_|vec_)?z|(rotvec|euler|angle)_z|yaw)",
}
_FRAMES = r"frame(_?(number|num|no|nr|index|idx))?"
_SINCE_1970 = 1e16  # ns; later times are stamps
_NO_TIMES = "name their column t, or time [ms] in another unit, or give the sample time, dt (--dt)"


@dataclass(frozen=True)
class _Header:
    """Names and units of the columns of a table."""

    path: Path
    titles: list[str]
    names: list[str]
    units: list[str]
    body: str | None

    @staticmethod
    def of(path: Path, titles: list[str], body: str | None) -> "_Header":
        names, units = zip(*(split_unit(title) for title in titles), strict=True)
        plain = None if body is None else split_unit(body)[0]
        return _Header(path, titles, [*names], [*units], plain)

    def find(self, pattern: str) -> int | None:
        """The column of a name, if there is one.

        Raises:
            RecordingError: if there are several.
        """
        found = _matches(pattern, self.names)
        if self.body is not None and len(found) > 1:
            # of arrays of poses, the number is enough: 0 for field.poses0
            word = f"[a-z]+{self.body}" if self.body.isdecimal() else re.escape(self.body)
            part = re.compile(rf"(.*_)?{word}_.*")
            found = [i for i in found if part.fullmatch(self.names[i])] or [
                i for i in found if self.names[i].startswith(self.body)
            ]
        if len(found) > 1:
            both = " and ".join(repr(shown(self.titles[i], 40)) for i in found[:2])
            raise RecordingError(
                f"{self.path}: columns {both} mean the same; select one by a part of its name, "
                f"{flag('body')}, or rename all but one."
            )
        return found[0] if found else None

    @property
    def clock(self) -> tuple[int, int] | None:
        """The two columns of seconds and nanoseconds of a stamp, if there are such."""
        plain = [re.sub(r"[^a-z0-9]+", "_", title.lower()).strip("_") for title in self.titles]
        found = [_matches(pattern, plain) for pattern in _CLOCK]
        return (found[0][0], found[1][0]) if all(len(each) == 1 for each in found) else None

    def all(self, patterns: Sequence[str]) -> list[int] | None:
        """The columns of several names, or None if one is missing."""
        found = [self.find(pattern) for pattern in patterns]
        return None if None in found else [i for i in found if i is not None]

    def unit(self, columns: Sequence[int], words: dict[str, float]) -> float | None:
        """The unit that some columns state, in m, s or rad; None if they state none.

        Raises:
            RecordingError: if it is unknown, or not the same for all.
        """
        stated = {self.units[i] for i in columns}
        if stated == {""}:
            return None
        if len(stated) > 1 or not stated <= words.keys():
            listed = shown(", ".join(self.titles[i] for i in columns))
            raise RecordingError(f"{self.path}: expected one of the units {', '.join(words)}: {listed}.")
        return words[stated.pop()]


def read_table(path: Path, wanted: Selection) -> Rows:
    """Read a table whose header is the first line, or the last comment before the numbers."""
    titles, lines = _read_header(path)
    header = _Header.of(path, titles, wanted.body)
    number, first = next(lines, (0, []))
    named = wanted.position is not None or wanted.orientation is not None
    position, orientation = (_named_columns if named else _find_columns)(header, wanted)
    time = header.clock or _find_time(header, first)
    frame = header.find(_FRAMES) if time is None else None
    if frame is not None and not "".join(first[frame : frame + 1]).isdecimal():
        frame = None  # a name
    rows = collect(
        path,
        chain([(number, first)] if first else [], lines),
        len(titles),
        [*position, *orientation],
        time if frame is None else frame,
        _find_wrench(header),
    )
    rows.no_times = _NO_TIMES
    if frame is not None:
        rows.count_frames()
    elif isinstance(time, int):
        rows.seconds = header.unit([time], TIME_WORDS)
        echoed = any(name.startswith("field_") for name in header.names)  # rostopic echo -p, in ns
        if rows.seconds is None and echoed and abs(float(rows.origin or 0)) > _SINCE_1970:
            rows.seconds = 1e-9
    rows.metres = header.unit(position, LENGTH_WORDS) if position else None
    if rows.metres not in (None, UNITS.get(wanted.unit or "", rows.metres)):
        raise RecordingError(f"{rows.path}: its header states another unit; leave out {flag('unit')}.")
    if not named and len(orientation) == 4 and orientation[3] == min(orientation):
        rows.order = "wxyz"
    stated = header.unit(orientation, ANGLE_WORDS) if len(orientation) == 3 else None
    numbers = np.split(rows.values, [len(position)], axis=1)
    set_poses(rows, numbers[0], numbers[1], wanted, stated, named)
    return rows


def _read_header(path: Path) -> tuple[list[str], Iterator[tuple[int, list[str]]]]:
    """The titles of the header, and the rows of cells after it."""
    lines = read_lines(path)
    comments, first = _first_row(lines)
    following = next(lines, None)
    if first is None or following is None:
        what = "has no more than one line of text" if first or comments else "is empty"
        raise RecordingError(f"{path}: {what}; expected a header such as {HEADER}, and rows of numbers.")
    (number, text), pending = first, [following]
    cells = split(text, find_delimiter(text))
    if comments and is_number(cells[0]):
        (number, text), pending = comments[-1], [first, following]
    text = text.lstrip(_COMMENT + " ")
    delimiter = find_delimiter(pending[0][1])  # a comment may have other marks between its words
    titles = split(text, delimiter)
    if len(titles) < 2:
        titles = split(text, find_delimiter(text))
    titles = trim(titles)
    if not titles or is_number(titles[0]):
        raise RecordingError(
            f"{path}: line {number}: expected a header such as {HEADER}, or rows of 8 numbers (t x y z qx qy "
            f"qz qw) or 12 (KITTI); found {len(titles)} numbers."
        )

    header = [*titles]
    units = units_of_row(trim(split(pending[0][1], delimiter)))
    if units is not None:
        pending.pop(0)
        pairs = zip_longest(titles, units[: len(titles)], fillvalue="")
        titles = [f"{title} [{unit}]" if unit else title for title, unit in pairs]

    def rows() -> Iterator[tuple[int, list[str]]]:
        for line, row in chain(pending, lines):
            if row[0] in _COMMENT:
                continue
            cells = trim(split(row, delimiter), len(titles))
            if any(cells) and cells != header:  # which files that were joined repeat
                yield line, cells

    return titles, rows()


def _first_row(lines: Iterator[tuple[int, str]]) -> tuple[list[tuple[int, str]], tuple[int, str] | None]:
    """The last comment at the start of a file, if any, and the line after it."""
    comments: list[tuple[int, str]] = []
    for line in lines:
        if line[1][0] not in _COMMENT or (not comments and "field." in line[1]):
            return comments, line
        comments = [line]
    return comments, None


def _find_time(header: _Header, first: list[str]) -> int | None:
    """The column of the time; ``first`` is the first row."""
    times = [i for i in map(header.find, _TIMES) if i is not None]
    set_ones = [i for i in times if i < len(first) and first[i].strip("0.")]
    return next(iter(set_ones or times[-1:]), None)  # a stamp of 0 was never set


def _find_columns(header: _Header, wanted: Selection) -> tuple[list[int], list[int]]:
    """Columns of the position and of the orientation; of a matrix of both, none and all."""
    for size in (16, 12):
        if matrix := header.all([f"[mt]_?{i // 4}_?{i % 4}" for i in range(size)]):
            return [], matrix
    position = _first(header, _POSITIONS, "xyz")
    if position is None and "fx" not in header.names:
        position = _first(header, (r"(.*_)?t_?{axis}",), "xyz")
    # NDI calls the scalar Q0; rx is a part of a quaternion where there is rw too
    quaternion = (
        _first(header, _QUATERNIONS, "xyzw")
        or header.all(["q_?x", "q_?y", "q_?z", "q_?[0o]"])
        or header.all([f"r_?{axis}" for axis in "xyzw"])
    )
    rotation = None
    for first in (0, 1) if position is not None and quaternion is None else ():
        quaternion = quaternion or header.all([f"q(uat)?_?{first + i}" for i in range(4)])
        if quaternion is not None and wanted.quaternion is None:
            listed = ", ".join(header.titles[i] for i in quaternion)
            raise RecordingError(
                f"{header.path}: does not say in which order {listed} are; give {flag('quaternion')}."
            )
        rotation = rotation or header.all([f"r(ot)?_?{first + i // 3}_?{first + i % 3}" for i in range(9)])
    if quaternion is None and rotation is None:
        position, quaternion = _with_prefix(header) or (position, quaternion)
    if position is not None and quaternion is not None:
        return position, quaternion
    if position is not None and rotation is not None:
        return position, rotation
    angles = header.all([*_ANGLES.values()])
    if position is not None and angles is not None and angles != position:  # p_RS_R_x
        if wanted.angles is None:
            listed = shown(", ".join(header.titles[i] for i in angles), 80)
            raise RecordingError(
                f"{header.path}: does not say what the angles {listed} mean; give {flag('angles')}: vector "
                "for a rotation vector, xyz for turns about the fixed axes, x (roll) first, and so on."
            )
        return position, angles
    missing = [*("xyz" if position is None else ""), *(["qx", "qy", "qz", "qw"] if not quaternion else [])]
    raise RecordingError(
        f"{header.path}: no column for {', '.join(missing)}; expected a header such as {HEADER}, or names "
        f"of columns, {flag('position')} and {flag('orientation')}; found "
        f"{shown(','.join(header.titles))}."
    )


def _named_columns(header: _Header, wanted: Selection) -> tuple[list[int], list[int]]:
    """Columns that the user named, separated by commas."""
    position, orientation = (
        [header.titles.index(column.name) for column in columns]
        for columns in find_columns(header.path, wanted, header.titles)
    )
    return position, orientation


def _with_prefix(header: _Header) -> tuple[list[int], list[int]] | None:
    """Columns such as tool_x and tool_qx, of the only prefix there is, or that of the body."""
    found = {re.sub("_q_?[xyzw]$", "", name) for name in header.names if re.fullmatch(r".+_q_?[xyzw]", name)}
    if header.body is not None:
        found = {prefix for prefix in found if prefix.startswith(header.body)}
    if len(found) > 1:
        raise RecordingError(
            f"{header.path}: has several poses in a row; select one, {flag('body')}: "
            f"{shown(', '.join(sorted(found)), 300)}."
        )
    for prefix in found:
        quaternion = header.all([f"{prefix}_q_?{axis}" for axis in "xyzw"])
        position = header.all([rf"{prefix}_(p_?|pos(ition)?_|t_?)?{axis}" for axis in "xyz"])
        if quaternion is not None and position is not None:
            return position, quaternion
    return None


def _first(header: _Header, patterns: Sequence[str], axes: str) -> list[int] | None:
    """Columns of the first pattern that all axes have: x, or else position_x."""
    for pattern in ("|".join(patterns),) if header.body is None else patterns[::-1]:
        found = header.all([pattern.replace("{axis}", axis) for axis in axes])
        if found is not None:
            return found
    return None


def _find_wrench(header: _Header) -> list[int]:
    """Columns of force and torque, all six or none: fx, force_x, wrench.force.x and the like."""
    words = (("f", "force", "n"), ("t", "torque", "nm"))
    patterns = [rf"({f}_?|(.*_)?{word}_){axis}(_{unit})?" for f, word, unit in words for axis in "xyz"]
    found = [_matches(pattern, header.names) for pattern in patterns]
    return [columns[0] for columns in found] if all(len(columns) == 1 for columns in found) else []


def _matches(pattern: str, names: list[str]) -> list[int]:
    """The columns whose names match a pattern."""
    return [i for i, name in enumerate(names) if re.fullmatch(pattern, name)]


TABLE = Reader(
    name="a table with named columns",
    suffixes=(".csv", ".tsv", ".txt", ".tum"),
    recognises=lambda path, head: True,
    read=read_table,
    options=frozenset({"unit", "time_unit", "quaternion", "angles", "angle_unit", "body", *_COLUMNS}),
)

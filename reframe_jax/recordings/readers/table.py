"""Tables with a header: the names of the columns select them, and the header may state units."""

import re
from collections.abc import Sequence
from itertools import chain, zip_longest
from pathlib import Path

import numpy as np

from reframe_jax.recordings.readers import units
from reframe_jax.recordings.readers.columns import OPTIONS, find_columns, set_poses
from reframe_jax.recordings.readers.lines import (
    Lines,
    collect,
    find_delimiter,
    is_number,
    read_lines,
    split,
    trim,
)
from reframe_jax.recordings.readers.reader import Reader
from reframe_jax.recordings.recording import HEADER, RecordingError, Rows, listed, shown
from reframe_jax.recordings.selection import Selection, flag

_COMMENT = "#%"
_PREAMBLE = 1000  # largest number of lines before the numbers
_TIMES = (
    r"(.*_)?header_stamp",  # rostopic echo -p: the stamp of the message, not the time of its arrival
    r"(elapsed|ros)_time",
    r"t|times?|time_?stamps?|stamp|sec|secs|seconds|zeit|temps?|tiempo|tempo",
)
_DATE = r"date|date_?time"  # the day alone, if there is another time
_CLOCK = r"(.*_)?(stamp|timespec)_s(ecs?)?|secs?", r"(.*_)?(stamp|timespec)_n(ano)?s(ecs?)?|n(ano)?secs?"
_POSITIONS = r"{axis}", r"(p_?|p_.+_|(.*_)?(pos(ition)?|loc(ation)?|translation)_){axis}"
_QUATERNIONS = r"q_?{axis}", r"(q_.+_|(.*_)?(quat(ernion)?|orientation|rot(ation)?)_(q_?)?){axis}"
_ANGLES = [
    rf"(.*_)?(r_?{axis}|rot(ation)?_(vector_|vec_)?{axis}|(rotvec|euler|angle)_{axis}|{word})"
    for axis, word in (("x", "roll"), ("y", "pitch"), ("z", "yaw"))
]
_FRAMES = r"frame(_?(number|num|no|nr|index|idx))?"
_SINCE_1970 = 1e16  # ns; later times are stamps


class _Header:
    """Names and units of the columns of a table."""

    def __init__(self, path: Path, titles: list[str], body: str | None) -> None:
        self.path, self.titles = path, titles
        self.names, self.units = ([*each] for each in zip(*map(units.split_unit, titles), strict=True))
        self.body = None if body is None else units.split_unit(body)[0]
        if self.body is not None and not any(self.body in name for name in self.names):
            raise RecordingError(
                f"{path}: no column has {shown(str(body), 60)!r} in its name, {flag('body')}; columns: "
                f"{listed(titles, 30)}."
            )

    def find(self, pattern: str) -> int | None:
        """Return the index of the only column whose name matches a regular expression, or None."""
        found = _matches(pattern, self.names)
        if self.body is not None and len(found) > 1:
            # in arrays of poses, the number is sufficient: 0 for field.poses0
            word = f"[a-z]+{self.body}" if self.body.isdecimal() else re.escape(self.body)
            part = re.compile(rf"(.*_)?{word}_.*")
            found = [i for i in found if part.fullmatch(self.names[i])] or [
                i for i in found if self.names[i].startswith(self.body)
            ]
        if len(found) > 1:
            both = " and ".join(repr(shown(self.titles[i], 40)) for i in found[:2])
            raise RecordingError(
                f"{self.path}: columns {both} have the same meaning; select one by a part of its name, "
                f"{flag('body')}, or rename all but one."
            )
        return found[0] if found else None

    def all(self, patterns: Sequence[str]) -> list[int] | None:
        """Return the columns of several names, or None if a name is missing."""
        found = [self.find(pattern) for pattern in patterns]
        return None if None in found else [i for i in found if i is not None]

    def axes(self, patterns: Sequence[str], axes: str) -> list[int] | None:
        """Return the columns of all axes for the first of some patterns, or None."""
        for pattern in ("|".join(patterns),) if self.body is None else patterns[::-1]:
            if found := self.all([pattern.replace("{axis}", axis) for axis in axes]):
                return found
        return None

    def unit(self, columns: Sequence[int], words: dict[str, float]) -> float | None:
        """Return the unit of some columns in m, s or rad, which must be the same; None if they state none."""
        stated = {self.units[i] for i in columns}
        if not stated - {""}:
            return None
        if len(stated) > 1 or not stated <= words.keys():
            names, titles = ", ".join([*words][:4]), shown(", ".join(self.titles[i] for i in columns))
            raise RecordingError(
                f"{self.path}: expected the same known unit (such as {names}) in all columns: {titles}."
            )
        return words[stated.pop()]


def read_table(path: Path, wanted: Selection) -> Rows:
    """Read a table whose header is the last line before the numbers; see :class:`Reader`."""
    titles, lines = _read_header(path)
    header = _Header(path, titles, wanted.body)
    number, first = next(lines, (0, []))
    named = wanted.position is not None or wanted.orientation is not None
    if named:
        chosen = find_columns(path, wanted, titles)
        position, orientation = ([titles.index(each.name) for each in columns] for columns in chosen)
    else:
        position, orientation = _find_columns(header, wanted)
    time = _find_time(header, first)
    frame = header.find(_FRAMES) if time is None else None
    if frame is not None and not re.fullmatch(r"\d+(\.0*)?", "".join(first[frame : frame + 1])):
        frame = None  # a name
    lines = chain([(number, first)] if first else [], lines)
    counted = time if frame is None else frame
    rows = collect(path, lines, len(titles), [*position, *orientation], counted, _find_wrench(header))
    rows.no_times = (
        f"name their column t, or time [ms] in another unit (columns: {listed(titles, 10)}), or give the "
        "sample time, dt (--dt)"
    )
    if frame is not None:
        rows.count_frames()
    elif isinstance(time, int):
        rows.seconds = header.unit([time], units.TIME_WORDS)
        # rostopic echo -p and EuRoC, in ns
        known = any(name.startswith(("field_", "p_rs_r_")) for name in header.names)
        if rows.seconds is None and known and abs(float(rows.origin or 0)) > _SINCE_1970:
            rows.seconds = 1e-9
    rows.metres = header.unit(position, units.LENGTH_WORDS)
    if not named and len(orientation) == 4 and orientation[3] == min(orientation):
        rows.order = "wxyz"
    stated = header.unit(orientation, units.ANGLE_WORDS) if len(orientation) == 3 else None
    numbers = np.split(rows.values, [len(position)], axis=1)
    set_poses(rows, numbers[0], numbers[1], wanted, stated, named)
    return rows


def _read_header(path: Path) -> tuple[list[str], Lines]:
    """Return the titles of the header, and the rows of cells below."""
    lines = read_lines(path)
    before: list[tuple[int, str]] = []  # comments, lines of text, and rows without a pose
    for number, text in lines:
        cells = split(text, find_delimiter(text))
        if text[0] not in _COMMENT and sum(map(is_number, cells)) > 2:
            break
        before.append((number, text))
        if len(before) == _PREAMBLE:
            raise RecordingError(f"{path}: has no numbers in its first {_PREAMBLE} lines.")
    else:
        what = "has no rows of numbers" if before else "is empty"
        raise RecordingError(f"{path}: {what}; expected a header such as {HEADER}, and rows of numbers.")
    delimiter = find_delimiter(text)
    headers = [(i, _titles(line, delimiter)) for i, (_, line) in enumerate(before)]
    headers = [(i, titles) for i, titles in headers if len(titles) > 1 and not any(map(is_number, titles))]
    plain = [header for header in headers if before[header[0]][1][0] not in _COMMENT]
    below = units.units_of_row(plain[-1][1]) if len(plain) > 1 else None
    if not headers:
        raise RecordingError(
            f"{path}: line {number}: expected a header such as {HEADER}, or rows of 8 numbers (t x y z qx qy "
            f"qz qw) or 12 (KITTI); found {len(trim(cells))} numbers. Add a header."
        )
    start, titles = (plain or headers)[-1 if below is None else -2]
    header = [*titles]
    if below is not None:
        start = plain[-1][0]
        pairs = zip_longest(titles, below[: len(titles)], fillvalue="")
        titles = [f"{title} [{unit}]" if unit else title for title, unit in pairs]

    def rows() -> Lines:
        late = [line for line in before[start + 1 :] if any(map(is_number, split(line[1], delimiter)))]
        for line, row in chain(late, [(number, text)], lines):
            if row[0] not in _COMMENT:
                cells = trim(split(row, delimiter), len(titles))
                if any(cells) and cells != header:  # joined files repeat the header
                    yield line, cells

    return titles, rows()


def _titles(line: str, delimiter: str | None) -> list[str]:
    """Titles in a header, whose delimiter may differ from that of the rows."""
    text = line.lstrip(_COMMENT + " ")
    titles = trim(split(text, delimiter))
    return titles if len(titles) > 1 else trim(split(text, find_delimiter(text)))


def _find_time(header: _Header, first: list[str]) -> int | tuple[int, int] | None:
    """Return the column of the time, or those of seconds and nanoseconds; ``first`` is the first row."""
    plain = [units.plain_name(title) for title in header.titles]
    clock = [_matches(pattern, plain) for pattern in _CLOCK]
    if all(len(each) == 1 for each in clock):
        return clock[0][0], clock[1][0]
    if not (times := [i for i in map(header.find, _TIMES) if i is not None]):
        return header.find(_DATE)
    filled = [i for i in times if i < len(first) and first[i].strip("0.")]
    return (filled or times[-1:])[0]  # stamps of 0 were never set


def _find_columns(header: _Header, wanted: Selection) -> tuple[list[int], list[int]]:
    """Return the columns of the position and of the orientation; for a matrix of both, none and all."""
    for size in (16, 12):
        if matrix := header.all([f"[mt]_?{i // 4}_?{i % 4}" for i in range(size)]):
            return [], matrix
    if header.body is not None and (of_body := _with_prefix(header)):
        return of_body
    position = header.axes(_POSITIONS, "xyz")
    if position is None and "fx" not in header.names:
        position = header.axes((r"(.*_)?t_?{axis}",), "xyz")
    # NDI names the scalar Q0; rx belongs to a quaternion if there is rw
    quaternion = (
        header.axes(_QUATERNIONS, "xyzw")
        or header.all(["q_?x", "q_?y", "q_?z", "q_?[0o]"])
        or header.all([f"r_?{axis}" for axis in "xyzw"])
    )
    rotation = None
    for first in (0, 1) if position is not None and quaternion is None else ():
        quaternion = quaternion or header.all([f"q(uat)?_?{first + i}" for i in range(4)])
        if quaternion is not None and wanted.quaternion is None:
            titles = ", ".join(header.titles[i] for i in quaternion)
            remedy = f"give {flag('quaternion')}"
            raise RecordingError(f"{header.path}: does not state the order of {titles}; {remedy}.")
        quaternion = None if quaternion is None else sorted(quaternion)  # in the order of the file
        rotation = rotation or header.all([f"r(ot)?_?{first + i // 3}_?{first + i % 3}" for i in range(9)])
    if quaternion is None and rotation is None:
        position, quaternion = _with_prefix(header) or (position, quaternion)
    angles = header.all(_ANGLES) if quaternion is None and rotation is None else None
    if angles == position:  # p_RS_R_x
        angles = None
    if angles is not None and position is not None and wanted.angles is None:
        titles = shown(", ".join(header.titles[i] for i in angles), 80)
        raise RecordingError(
            f"{header.path}: does not state the meaning of the angles {titles}; give {flag('angles')}: "
            "vector for a rotation vector, xyz for rotations about the fixed axes, x (roll) first, and so on."
        )
    orientation = quaternion or rotation or angles
    if position is not None and orientation is not None:
        return position, orientation
    missing = [*("xyz" if position is None else ""), *(["qx", "qy", "qz", "qw"] if not orientation else [])]
    raise RecordingError(
        f"{header.path}: no column for {', '.join(missing)}; expected a header such as {HEADER}, or names of "
        f"columns, {flag('position')} and {flag('orientation')}; found {shown(','.join(header.titles))}."
    )


def _with_prefix(header: _Header) -> tuple[list[int], list[int]] | None:
    """Return columns such as tool_x and tool_qx, with the only prefix or the prefix of the body."""
    found = {re.sub("_q_?[xyzw]$", "", name) for name in header.names if re.fullmatch(r".+_q_?[xyzw]", name)}
    if header.body is not None:
        found = found & {header.body} or {prefix for prefix in found if prefix.startswith(header.body)}
    if len(found) > 1:
        raise RecordingError(
            f"{header.path}: has several poses in a row; select one, {flag('body')}: {listed(sorted(found))}."
        )
    for prefix in found:
        quaternion = header.all([f"{prefix}_q_?{axis}" for axis in "xyzw"])
        position = header.all([rf"{prefix}_(p_?|pos(ition)?_|t_?)?{axis}" for axis in "xyz"])
        if quaternion is not None and position is not None:
            return position, quaternion
    return None


def _find_wrench(header: _Header) -> list[int]:
    """Return six columns of force and torque, such as fx or wrench.force.x; none if one is missing."""
    words = (("f", "force", "n"), ("t", "torque", "nm"))
    patterns = [rf"({f}_?|(.*_)?{word}_){axis}(_{unit})?" for f, word, unit in words for axis in "xyz"]
    found = [_matches(pattern, header.names) for pattern in patterns]
    return [columns[0] for columns in found] if all(len(columns) == 1 for columns in found) else []


def _matches(pattern: str, names: list[str]) -> list[int]:
    return [i for i, name in enumerate(names) if re.fullmatch(pattern, name)]


TABLE = Reader(
    name="a table with named columns",
    suffixes=(".csv", ".tsv", ".txt", ".tum"),
    recognises=lambda path, head: True,
    read=read_table,
    options=OPTIONS | {"time_unit", "body"},
)

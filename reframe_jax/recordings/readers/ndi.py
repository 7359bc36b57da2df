"""Tools in a CSV of the NDI trackers Polaris, Vega and Aurora.

Each row is a frame, or a tool in a frame. Each tool has columns ``Q0, Qx, Qy, Qz, Tx, Ty, Tz`` with Q0 as the
scalar, usually in mm, after its name (``PortHandle`` or the like), ``Frame#`` and ``State`` or
``TransformStatus``. A tool that was not tracked has another state than OK or Enabled, no numbers, or numbers
such as -3.7e28.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path

import numpy as np

from reframe_jax.recordings.readers.lines import Lines, collect, find_delimiter, is_number, read_lines, split
from reframe_jax.recordings.readers.reader import Entry, Reader, assume_millimetres, choose_name
from reframe_jax.recordings.readers.units import LENGTH_WORDS, plain_name, split_unit
from reframe_jax.recordings.recording import RecordingError, Rows
from reframe_jax.recordings.selection import Selection

_NUMBERS = ["q0", "qx", "qy", "qz", "tx", "ty", "tz"]
_STATES = ("state", "status", "transform_status", "tool_status")
_NAMES = ("port_handle", "tool_handle", "tool_id", "tool", "handle", "porthandle", "toolhandle", "toolid")
_FRAMES = ("frame", "frame_number", "framenumber")
_TIMES = ("timestamp", "time", "t", "time_s", "timestamp_s")
_CLOCK = ("timespec_s", "timespec_ns")
_TRACKED = re.compile(r"ok|enabled|valid|tracked|visible|0x0+|0+|")
_NO_TIMES = "it counts frames: give the sample time, dt (--dt), 1/60 s for a Polaris at 60 Hz"
_MOST = 100  # tools
_LOST = 1e20  # larger numbers are no measurements


@dataclass(frozen=True)
class _Tool:
    """Columns of a tool."""

    first: int  # first of the seven columns of the pose
    state: int | None
    frame: int | None
    row: int | None = None  # column of the name, if every tool has separate rows


def read_ndi(path: Path, wanted: Selection) -> Rows:
    """Read the poses of a tool; see :class:`Reader`."""
    names, tools, lines = _read_header(path)
    name = choose_name(path, "body", wanted.body, [*tools], "tools")
    tool = tools[name]
    pose = range(tool.first, tool.first + 7)
    frame = [] if tool.frame is None else [tool.frame]
    tracked = []

    def rows() -> Lines:
        for number, cells in lines:
            if tool.row is not None and cells[tool.row : tool.row + 1] != [name]:
                continue  # the row of another tool
            cells = (cells + [""] * (len(names) - len(cells)))[: len(names)]
            for i in (*pose, *frame):
                cells[i] = cells[i] if is_number(cells[i]) else ""
            state = "" if tool.state is None else cells[tool.state].lower()
            tracked.append(_TRACKED.fullmatch(state) is not None and all(cells[i] for i in pose))
            yield number, cells

    clock = [names.index(each) for each in _CLOCK if each in names]
    time = (clock[0], clock[1]) if len(clock) == 2 else _first(names, range(len(names)), _TIMES)
    found = collect(path, rows(), len(names), [*pose[4:], *pose[1:4], pose[0], *frame], time)
    frames, found.values = found.values[:, 7:], found.values[:, :7]
    found.no_times, found.order = _NO_TIMES, "wxyz"
    if time is None and frames.size:
        found.times = frames[:, 0]
        found.count_frames()
    found.values[np.abs(found.values).max(axis=1, initial=0) > _LOST] = np.nan
    found.metres = LENGTH_WORDS.get(split_unit(names[tool.first + 4])[1])
    if wanted.unit is None and found.metres is None:
        assume_millimetres(found, "NDI")
    found.keep(np.asarray(tracked, bool), "the file states that the tool was not tracked", "untracked")
    return found


def _read_header(path: Path) -> tuple[list[str], dict[str, _Tool], Lines]:
    """Return the names of the columns, the tools, and the rows of cells after the header."""
    lines = read_lines(path)
    header, line = next(((number, line) for number, line in lines if _starts(_names(line))), (0, ""))
    if not header:
        raise RecordingError(f"{path}: expected a header with Q0,Qx,Qy,Qz,Tx,Ty,Tz.")
    names, delimiter = _names(line), find_delimiter(line)
    starts = _starts(names)
    rest = ((number, split(row, delimiter)) for number, row in lines)
    head = list(islice(rest, 1))
    cells = head[0][1] if head else []
    tools: dict[str, _Tool] = {}
    before = 0
    for start in starts:
        near = range(start - 1, before - 1, -1)
        at = _first(names, near, _NAMES)
        port = next((names[i].replace("_", " ") for i in near if re.fullmatch(r"port_\d+", names[i])), "")
        name = ("" if at is None else "".join(cells[at : at + 1])) or port or f"tool {len(tools) + 1}"
        name = name if name not in tools else f"{name} ({len(tools) + 1})"
        tools[name] = _Tool(start, _first(names, near, _STATES), _first(names, near, _FRAMES))
        before = start + 7
    at = _first(names, range(len(names)), _NAMES)
    if len(starts) == 1 and at is not None:
        below = (row for number, row in read_lines(path) if number > header)
        every = dict.fromkeys("".join(split(row, delimiter)[at : at + 1]) for row in below)
        found = [name for name in every if name][:_MOST]
        if len(found) > 1:
            (one,) = tools.values()
            tools = {name: replace(one, row=at) for name in found}
    return names, tools, chain(head, rest)


def _first(names: list[str], columns: Iterable[int], known: tuple[str, ...]) -> int | None:
    """Return the first of some columns with a known name."""
    return next((i for i in columns if names[i] in known), None)


def _names(line: str) -> list[str]:
    return [plain_name(cell) for cell in split(line, find_delimiter(line))]


def _starts(names: list[str]) -> list[int]:
    plain = [split_unit(name)[0] for name in names]
    return [i for i in range(len(plain)) if plain[i : i + 7] == _NUMBERS]


def _recognises(path: Path, head: bytes) -> bool:
    known = {*_STATES, *_NAMES, *_FRAMES, "tools", "tool_count", "toolcount", "error", "markers"}
    headers = [_names(line) for line in head.decode(errors="replace").splitlines()[:20]]
    return any(_starts(names) and known & {*names} for names in headers)


NDI = Reader(
    name="a CSV of an NDI tracker",
    suffixes=(".csv", ".tsv", ".txt"),
    recognises=_recognises,
    read=read_ndi,
    options=frozenset({"body", "in_body", "unit", "time_unit", "quaternion"}),
    contents=lambda path: [Entry("body", name, "tool") for name in _read_header(path)[1]],
)

"""Tools in a CSV of the trackers of NDI (Polaris, Vega, Aurora), as its programs and examples write it.

Each row is a frame, or a tool in a frame. Each tool has columns ``Q0, Qx, Qy, Qz, Tx, Ty, Tz``, of which Q0
is the scalar, in mm, after its number (``PortHandle`` or the like), ``Frame#`` and ``State`` or
``TransformStatus``. A tool that was not tracked has another state than OK or Enabled, no numbers, or numbers
as large as -3.7e28.
"""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path

import numpy as np

from reframe_jax.recordings.readers.collecting import collect
from reframe_jax.recordings.readers.lines import find_delimiter, is_number, read_lines, split
from reframe_jax.recordings.readers.reader import Entry, Reader, choose_name
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import Rows
from reframe_jax.recordings.selection import UNITS, Selection

__all__ = ["NDI", "read_ndi"]

_NUMBERS = ["q0", "qx", "qy", "qz", "tx", "ty", "tz"]
_STATES = ("state", "status", "transformstatus", "transform_status", "tool_status")
_NAMES = ("porthandle", "port_handle", "toolhandle", "tool_handle", "tool_id", "toolid", "tool", "handle")
_FRAMES = ("frame", "frame_number", "framenumber")
_TIMES = ("timestamp", "time", "t", "time_s", "timestamp_s")
_CLOCK = ("timespec_s", "timespec_ns")
_TRACKED = re.compile(r"ok|enabled|valid|tracked|visible|0x0+|0+|")
_NO_TIMES = "frames are counted: give the sample time, dt (--dt), 1/60 s for a Polaris at 60 Hz"
_MOST = 100  # tools
_LOST = 1e20  # mm: numbers that mean that there is none
_NEAREST = 10.0  # mm, from the origin of a tracker, within which no tool is measured

_Lines = Iterator[tuple[int, list[str]]]


@dataclass(frozen=True)
class _Tool:
    """Columns of a tool."""

    first: int  # of seven
    state: int | None
    frame: int | None
    row: int | None = None  # where every tool has a row of its own: the column of its name


def read_ndi(path: Path, wanted: Selection) -> Rows:
    """Read a tool."""
    names, tools, lines = _read_header(path)
    name = choose_name(path, "body", wanted.body, [*tools], "tools")
    tool = tools[name]
    pose = range(tool.first, tool.first + 7)
    frame = [] if tool.frame is None else [tool.frame]
    tracked = []

    def rows() -> _Lines:
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
    if time is None and frames.size and np.isfinite(frames).all() and (np.diff(frames[:, 0]) > 0).all():
        found.frames = frames[:, 0].astype(int)
    found.values[np.abs(found.values).max(axis=1, initial=0) > _LOST] = np.nan
    if wanted.unit is None:
        distance = np.linalg.norm(found.values[:, :3], axis=1)
        distance = distance[np.isfinite(distance)]
        in_mm = not len(distance) or np.median(distance) > _NEAREST
        found.metres = UNITS["mm" if in_mm else "m"]
        found.notes.append(
            "positions are read in mm, as NDI writes them."
            if in_mm
            else "positions are read in m: in mm, the tool would be less than 10 mm from the tracker."
        )
    found.keep(np.asarray(tracked, bool), "the file says that the tool was not tracked", "untracked")
    return found


def _read_header(path: Path) -> tuple[list[str], dict[str, _Tool], _Lines]:
    """Names of the columns, the tools, and the rows of cells after the header."""
    lines = read_lines(path)
    for _, line in lines:
        delimiter = find_delimiter(line)
        names = _plain(line)
        if "q0" in names:
            break
    else:
        raise RecordingError(f"{path}: expected a header with Q0,Qx,Qy,Qz,Tx,Ty,Tz.")
    rest = ((number, split(row, delimiter)) for number, row in lines)
    head = list(islice(rest, 1))
    cells = head[0][1] if head else []
    starts = [i for i in range(len(names)) if names[i : i + 7] == _NUMBERS]
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
        every = dict.fromkeys("".join(split(row, delimiter)[at : at + 1]) for _, row in read_lines(path))
        found = [name for name in every if name][1 : _MOST + 1]
        if len(found) > 1:
            (one,) = tools.values()
            tools = {name: replace(one, row=at) for name in found}
    return names, tools, chain(head, rest)


def _first(names: list[str], columns: Iterable[int], known: tuple[str, ...]) -> int | None:
    """The first of some columns that has one of the known names."""
    return next((i for i in columns if names[i] in known), None)


def _plain(line: str) -> list[str]:
    """The names in a header in plain letters."""
    cells = split(line.lower(), find_delimiter(line))
    return [re.sub(r"[^a-z0-9]+", "_", cell).strip("_") for cell in cells]


def _contents(path: Path) -> list[Entry]:
    return [Entry("body", name, "tool") for name in _read_header(path)[1]]


def _recognises(path: Path, head: bytes) -> bool:
    names = _plain(head.decode("utf-8-sig", errors="replace").split("\n")[0])
    known = {*_STATES, *_NAMES, *_FRAMES, "tools", "toolcount", "error", "markers"}
    return any(names[i : i + 7] == _NUMBERS for i in range(len(names))) and bool(known & {*names})


NDI = Reader(
    name="a CSV of an NDI tracker",
    suffixes=(".csv", ".tsv", ".txt"),
    recognises=_recognises,
    read=read_ndi,
    options=frozenset({"body", "in_body", "unit", "time_unit", "quaternion"}),
    contents=_contents,
)

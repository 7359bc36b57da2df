"""Tools in a CSV of the trackers of NDI (Polaris, Vega, Aurora), as its programs and examples write it.

Each row is a frame, or a tool in a frame. Each tool has columns ``Q0, Qx, Qy, Qz, Tx, Ty, Tz``, of which Q0
is the scalar, in mm, after its number (``PortHandle`` or the like), ``Frame#`` and ``State`` or
``TransformStatus``. A tool that was not tracked has another state than OK or Enabled, no numbers, or numbers
as large as -3.7e28.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reframe_jax.recordings.readers.exports import find_delimiter, is_number, split
from reframe_jax.recordings.readers.lines import Collector, read_lines
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
_TRACKED = re.compile(r"ok|enabled|valid|tracked|visible|0x0+|0+|")
_NO_TIMES = "frames are counted: give the sample time, dt (--dt), 1/60 s for a Polaris at 60 Hz"
_MOST = 100  # tools
_LOST = 1e20  # mm: numbers that mean that there is none
_NEAREST = 10.0  # mm, from the origin of a tracker, within which no tool is measured


@dataclass(frozen=True)
class _Tool:
    """Columns of a tool."""

    first: int  # of seven
    state: int | None
    frame: int | None
    row: int | None = None  # where every tool has a row of its own: the column of its name


@dataclass(frozen=True)
class _Header:
    width: int
    tools: dict[str, _Tool]
    time: int | None
    clock: tuple[int, int] | None  # seconds and nanoseconds


def read_ndi(path: Path, wanted: Selection) -> Rows:
    """Read a tool."""
    header, lines = _read_header(path)
    name = choose_name(path, "body", wanted.body, [*header.tools], "tools")
    tool = header.tools[name]
    time = header.width if header.clock else header.time
    pose = range(tool.first, tool.first + 7)
    rows = Collector(path, header.width + bool(header.clock), time, pose)
    frames, tracked = [], []
    for number, cells in lines:
        if tool.row is not None and cells[tool.row : tool.row + 1] != [name]:
            continue  # the row of another tool
        cells = (cells + [""] * (header.width - len(cells)))[: header.width]
        cells = [cell if is_number(cell) or i not in pose else "" for i, cell in enumerate(cells)]
        state = "" if tool.state is None else cells[tool.state].lower()
        tracked.append(_TRACKED.fullmatch(state) is not None and all(cells[i] for i in pose))
        if tool.frame is not None and is_number(cells[tool.frame]):
            frames.append(int(float(cells[tool.frame])))
        if header.clock:
            seconds, nanoseconds = (cells[i] for i in header.clock)
            cells.append(f"{seconds}.{nanoseconds.zfill(9)}" if seconds.isdecimal() else "")
        rows.add(number, cells)
    found = rows.rows()
    found.no_times = _NO_TIMES
    found.values = found.values[:, [4, 5, 6, 1, 2, 3, 0]]
    found.values[np.abs(found.values).max(axis=1, initial=0) > _LOST] = np.nan
    found.order, found.seconds = "wxyz", 1.0 if header.clock else None
    if len(frames) == len(found.where) and found.times is None and (np.diff(frames) > 0).all():
        found.frames = np.asarray(frames)
    distance = np.linalg.norm(found.values[:, :3], axis=1)
    distance = distance[np.isfinite(distance)]
    if wanted.unit is None:
        in_mm = not len(distance) or np.median(distance) > _NEAREST
        found.metres = UNITS["mm" if in_mm else "m"]
        found.notes.append(
            "positions are read in mm, as NDI writes them."
            if in_mm
            else "positions are read in m: in mm, the tool would be less than 10 mm from the tracker."
        )
    found.keep(np.asarray(tracked, bool), "the file says that the tool was not tracked", "untracked")
    return found


def _read_header(path: Path) -> tuple[_Header, Iterator[tuple[int, list[str]]]]:
    """The header, and the rows of cells after it."""
    lines = read_lines(path)
    for _, line in lines:
        delimiter = find_delimiter(line)
        names = [re.sub(r"[^a-z0-9]+", "_", cell.lower()).strip("_") for cell in split(line, delimiter)]
        if "q0" in names:
            break
    else:
        raise RecordingError(f"{path}: expected a header with Q0,Qx,Qy,Qz,Tx,Ty,Tz.")
    starts = [i for i in range(len(names)) if names[i : i + 7] == _NUMBERS]
    rest = ((number, split(row, delimiter)) for number, row in lines)
    number, cells = next(rest, (0, []))
    tools: dict[str, _Tool] = {}
    before = 0
    for start in starts:
        near = range(start - 1, before - 1, -1)
        state = next((i for i in near if names[i] in _STATES), None)
        frame = next((i for i in near if names[i] in _FRAMES), None)
        at = next((i for i in near if names[i] in _NAMES), None)
        port = next((names[i] for i in near if re.fullmatch(r"port_\d+", names[i])), None)
        name = cells[at] if at is not None and at < len(cells) else ""
        name = name or (port or "").replace("_", " ") or f"tool {len(tools) + 1}"
        tools[name if name not in tools else f"{name} ({len(tools) + 1})"] = _Tool(start, state, frame)
        before = start + 7
    at = next((i for i, name in enumerate(names) if name in _NAMES), None)
    if len(starts) == 1 and at is not None:
        found = _tools_of_rows(path, delimiter, at)
        if len(found) > 1:
            (one,) = tools.values()
            tools = {name: _Tool(one.first, one.state, one.frame, at) for name in found}
    stamp = next((i for i, name in enumerate(names) if name in _TIMES), None)
    pair = [next((i for i, name in enumerate(names) if name == each), None) for each in _CLOCK]
    clock = None if None in pair else (int(str(pair[0])), int(str(pair[1])))
    header = _Header(len(names), tools, stamp, clock)

    def rows() -> Iterator[tuple[int, list[str]]]:
        if number:
            yield number, cells
        yield from rest

    return header, rows()


_CLOCK = ("timespec_s", "timespec_ns")


def _tools_of_rows(path: Path, delimiter: str | None, at: int) -> list[str]:
    """The names in a column of all rows but the header."""
    found: dict[str, None] = {}
    for i, (_, line) in enumerate(read_lines(path)):
        cells = split(line, delimiter)
        if i and len(cells) > at and len(found) < _MOST:
            found[cells[at]] = None
    return [*found]


def _contents(path: Path) -> list[Entry]:
    return [Entry("body", name, "tool") for name in _read_header(path)[0].tools]


def _recognises(path: Path, head: bytes) -> bool:
    line = head.decode("utf-8-sig", errors="replace").split("\n")[0].lower()
    names = [re.sub(r"[^a-z0-9]+", "_", cell).strip("_") for cell in split(line, find_delimiter(line))]
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

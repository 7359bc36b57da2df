"""Transforms in sequence files of Plus, ``.mha`` or ``.mhd``: lines of text before or beside the images.

Every frame has lines ``Seq_Frame0000_ProbeToTrackerTransform = 16 numbers``, row by row, in mm, a line
``..._ProbeToTrackerTransformStatus = OK`` or another word, and ``..._Timestamp = `` in s. Images are not
read.
"""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from reframe_jax.recordings.readers.exports import is_number
from reframe_jax.recordings.readers.reader import Entry, Reader, choose_name
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import MOST_ROWS, Rows, shown
from reframe_jax.recordings.selection import UNITS, Selection

__all__ = ["MHA", "read_mha"]

_LONGEST = 2**16  # bytes of a line
_FIELD = re.compile(r"Seq_Frame(\d+)_(\w+)\s*:?=\s*(.*)")
_TRANSFORM, _STATUS = re.compile(r"(\w+?)(?:Transform)"), re.compile(r"(\w+?)TransformStatus")
_MISSING = " ".join(["nan"] * 16)


def read_mha(path: Path, wanted: Selection) -> Rows:
    """Read a transform, such as ProbeToTracker: the pose of the probe in the tracker."""
    numbers: dict[str, dict[int, str]] = {}
    status: dict[str, dict[int, str]] = {}
    stamps: dict[int, str] = {}
    frames: dict[int, int] = {}
    for line, frame, name, value in _fields(path):
        frames.setdefault(frame, line)
        if match := _STATUS.fullmatch(name):
            status.setdefault(match[1], {})[frame] = value
        elif match := _TRANSFORM.fullmatch(name):
            numbers.setdefault(match[1], {})[frame] = value
        elif name == "Timestamp" or (name == "UnfilteredTimestamp" and frame not in stamps):
            stamps[frame] = value
    if len(frames) > MOST_ROWS:
        raise RecordingError(f"{path}: has more than {MOST_ROWS} frames; cut the recording into files.")
    asked = None if wanted.body is None else wanted.body.removesuffix("Transform")
    body = choose_name(path, "body", asked, [*numbers], "transforms")
    order = sorted(frames)
    values = np.array([_numbers(path, frames[k], numbers[body].get(k, _MISSING)) for k in order])
    seconds = [float(stamps.get(k, "nan")) if is_number(stamps.get(k, "nan")) else np.nan for k in order]
    times = np.asarray(seconds) if stamps else None
    rows = Rows(path, "frame", np.asarray(order), values.reshape(-1, 16), times)
    if times is not None and np.isfinite(times).any():
        first = times[np.isfinite(times)][0]
        if abs(first) > 1e6:
            rows.times, rows.origin = times - first, stamps[order[int(np.flatnonzero(times == first)[0])]]
    rows.seconds = 1.0 if stamps else None
    rows.metres = UNITS[wanted.unit or "mm"]
    good = np.array([status.get(body, {}).get(k, "OK").upper() == "OK" for k in order])
    rows.keep(good, f"the file says that {shown(body, 60)} was not tracked", "untracked")
    return rows


def _numbers(path: Path, line: int, text: str) -> list[float]:
    cells = text.split()
    if len(cells) != 16 or not all(map(is_number, cells)):
        raise RecordingError(
            f"{path}: line {line}: expected the 16 numbers of a transform, found {shown(text, 60)!r}."
        )
    return [float(cell) for cell in cells]


def _fields(path: Path) -> Iterator[tuple[int, int, str, str]]:
    """Line, frame, name and value of the fields of frames, down to the images."""
    with path.open("rb") as file:
        number = 0
        while line := file.readline(_LONGEST):
            number += 1
            text = line.decode("utf-8", errors="replace").strip()
            if match := _FIELD.fullmatch(text):
                yield number, int(match[1]), match[2], match[3]
            elif re.match(r"ElementDataFile\s*=", text) or (not text and path.suffix.lower() == ".nrrd"):
                return


def _contents(path: Path) -> list[Entry]:
    counts: dict[str, int] = {}
    for _, _, name, _ in _fields(path):
        if match := _TRANSFORM.fullmatch(name):
            counts[match[1]] = counts.get(match[1], 0) + 1
    return [Entry("body", name, f"transform, {count} frames") for name, count in counts.items()]


def _recognises(path: Path, head: bytes) -> bool:
    return head.startswith((b"ObjectType", b"NDims", b"NRRD"))


MHA = Reader(
    name="a sequence file of Plus",
    suffixes=(".mha", ".mhd", ".nrrd"),
    recognises=_recognises,
    read=read_mha,
    options=frozenset({"body", "in_body", "unit"}),
    contents=_contents,
)

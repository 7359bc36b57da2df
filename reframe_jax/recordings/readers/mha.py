"""Transforms in sequence files of Plus, ``.mha`` or ``.mhd``: lines of text before or beside the images.

Every frame has lines ``Seq_Frame0000_ProbeToTrackerTransform = 16 numbers``, row by row, in mm, a line
``..._ProbeToTrackerTransformStatus = OK`` or another word, and ``..._Timestamp = `` in s. Images are not
read.
"""

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from reframe_jax.recordings.readers.collecting import collect
from reframe_jax.recordings.readers.lines import is_number
from reframe_jax.recordings.readers.reader import Entry, Reader, choose_name
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import Rows, shown
from reframe_jax.recordings.selection import UNITS, Selection

__all__ = ["MHA", "read_mha"]

_LONGEST = 2**16  # bytes of a line
_FIELD = re.compile(r"Seq_Frame(\d{1,18})_(\w+)\s*:?=\s*(.*)")
_TRANSFORM, _STATUS = re.compile(r"(\w+?)(?:Transform)"), re.compile(r"(\w+?)TransformStatus")
_WIDTH = 16  # numbers of a transform


def read_mha(path: Path, wanted: Selection) -> Rows:
    """Read a transform, such as ProbeToTracker: the pose of the probe in the tracker."""
    numbers: dict[str, dict[int, list[str]]] = {}
    status: dict[str, dict[int, str]] = {}
    stamps: dict[int, str] = {}
    frames: set[int] = set()
    for line, frame, name, value in _fields(path):
        frames.add(frame)
        if match := _STATUS.fullmatch(name):
            status.setdefault(match[1], {})[frame] = value
        elif match := _TRANSFORM.fullmatch(name):
            cells = value.split()
            if len(cells) != _WIDTH or not all(map(is_number, cells)):
                raise RecordingError(
                    f"{path}: line {line}: expected the 16 numbers of a transform, found "
                    f"{shown(value, 60)!r}."
                )
            numbers.setdefault(match[1], {})[frame] = cells
        elif name == "Timestamp" or (name == "UnfilteredTimestamp" and frame not in stamps):
            stamps[frame] = value if is_number(value) else ""
    asked = None if wanted.body is None else wanted.body.removesuffix("Transform")
    body = choose_name(path, "body", asked, [*numbers], "transforms")
    missing = [""] * _WIDTH
    cells_of = ((k, [stamps.get(k, ""), *numbers[body].get(k, missing)]) for k in sorted(frames))
    rows = collect(path, cells_of, 1 + _WIDTH, range(1, 1 + _WIDTH), 0 if stamps else None)
    rows.word, rows.seconds, rows.metres = "frame", 1.0, UNITS[wanted.unit or "mm"]
    good = np.array([status.get(body, {}).get(k, "OK").upper() == "OK" for k in rows.where])
    rows.keep(good, f"the file says that {shown(body, 60)} was not tracked", "untracked")
    return rows


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
    matches = (_TRANSFORM.fullmatch(name) for _, _, name, _ in _fields(path))
    counts = Counter(match[1] for match in matches if match)
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

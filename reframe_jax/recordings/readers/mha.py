"""Transforms in sequence files of Plus, ``.mha``, ``.mhd`` or ``.nrrd``: lines of text before the images.

Every frame has a line ``Seq_Frame0000_ProbeToTrackerTransform = 16 numbers``, row by row and usually in mm, a
line ``..._ProbeToTrackerTransformStatus = OK`` or another word, and ``..._Timestamp =`` in s. The reader
ignores the images.
"""

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from reframe_jax.recordings.readers.lines import collect, is_number
from reframe_jax.recordings.readers.reader import Entry, Reader, assume_millimetres, choose_name
from reframe_jax.recordings.recording import RecordingError, Rows, shown
from reframe_jax.recordings.selection import Selection

_LONGEST = 2**16  # bytes of a line
_FIELD = re.compile(r"Seq_Frame(\d{1,18})_(\w+)\s*:?=\s*(.*)")
_TRANSFORM = re.compile(r"(\w+?)Transform(Status)?")
_WIDTH = 16  # numbers of a transform


def read_mha(path: Path, wanted: Selection) -> Rows:
    """Read the poses of a transform such as ProbeToTracker, the probe in the tracker; see :class:`Reader`."""
    numbers: dict[str, dict[int, list[str]]] = {}
    lost: dict[str, set[int]] = {}
    stamps: dict[int, str] = {}
    frames: set[int] = set()
    for line, frame, name, value in _fields(path):
        frames.add(frame)
        if match := _TRANSFORM.fullmatch(name):
            cells = value.split()
            if match[2]:
                lost.setdefault(match[1], set()).update([] if value.upper() == "OK" else [frame])
            elif len(cells) == _WIDTH and all(map(is_number, cells)):
                numbers.setdefault(match[1], {})[frame] = cells
            else:
                raise RecordingError(
                    f"{path}: line {line}: expected the 16 numbers of a transform, found "
                    f"{shown(value, 60)!r}."
                )
        elif name == "Timestamp" or (name == "UnfilteredTimestamp" and frame not in stamps):
            stamps[frame] = value if is_number(value) else ""
    asked = None if wanted.body is None else wanted.body.removesuffix("Transform")
    body = choose_name(path, "body", asked, [*numbers], "transforms")
    cells_of = ((k, [stamps.get(k, ""), *numbers[body].get(k, [""] * _WIDTH)]) for k in sorted(frames))
    rows = collect(path, cells_of, 1 + _WIDTH, range(1, 1 + _WIDTH), 0 if stamps else None)
    rows.word = "frame"
    good = ~np.isin(rows.where, list(lost.get(body, ())))
    rows.keep(good, f"the file states that {shown(body, 60)} was not tracked", "untracked")
    if wanted.unit is None:
        assume_millimetres(rows, "Plus")
    return rows


def _fields(path: Path) -> Iterator[tuple[int, int, str, str]]:
    """Yield line, frame, name and value of the fields of frames, down to the images."""
    with path.open("rb") as file:
        for number, line in enumerate(iter(lambda: file.readline(_LONGEST), b""), 1):
            text = line.decode("utf-8", errors="replace").strip()
            if match := _FIELD.fullmatch(text):
                yield number, int(match[1]), match[2], match[3]
            elif re.match(r"ElementDataFile\s*=", text) or (not text and path.suffix.lower() == ".nrrd"):
                return


def _contents(path: Path) -> list[Entry]:
    found = (_TRANSFORM.fullmatch(name) for _, _, name, _ in _fields(path))
    counts = Counter(match[1] for match in found if match and not match[2])
    return [Entry("body", name, f"transform, {count} frames") for name, count in counts.items()]


MHA = Reader(
    name="a sequence file of Plus",
    suffixes=(".mha", ".mhd", ".nrrd"),
    recognises=lambda path, head: head.startswith((b"ObjectType", b"NDims", b"NRRD")),
    read=read_mha,
    options=frozenset({"body", "in_body", "unit"}),
    contents=_contents,
)

"""Rigid bodies in C3D files: poses of their markers, or the file's own rotations.

Files are read with the library ezc3d, in another process, as damaged ones can end it or keep it busy for
ever; the structure of a file is checked first. Lengths are in the unit that POINT:UNITS states.
"""

import os
import struct
import subprocess
import sys
from dataclasses import dataclass
from math import prod
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from reframe_jax.recordings.markers import (
    UNSEEN,
    choose_markers,
    fit_markers,
    group_markers,
    marker_entries,
)
from reframe_jax.recordings.readers.collecting import drop_zeros
from reframe_jax.recordings.readers.reader import Entry, Reader, choose_name, import_extra
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import MOST_ROWS, Rows, shown
from reframe_jax.recordings.selection import UNITS, Selection, flag

__all__ = ["C3D", "read_c3d"]

_BLOCK = 512  # bytes
_MOST_PARAMETERS = (
    2 * 255 * _BLOCK
)  # bytes in which they end: a byte each tells where they start, and how long
_BIG_ENDIAN = 86  # the number of the processor that wrote the file, of those from 84
_WHOLE = "a whole C3D file"
_PATIENCE, _SLOWEST = 30.0, 1e6  # s, and bytes a second, after which reading is given up


@dataclass(frozen=True)
class _File:
    """What is needed of a C3D file."""

    markers: list[str]
    points: np.ndarray  # (N, M, 3), NaN where a marker is missing
    rate: float
    rotations: list[str]
    poses: np.ndarray  # (N', R, 4, 4)
    rotation_rate: float
    unit: str


def read_c3d(path: Path, wanted: Selection) -> Rows:
    """Read a rotation, or fit a rigid body to markers."""
    file = _open(path)
    metres = _metres(path, file.unit, wanted)
    name = wanted.body
    notes: list[str] = []
    bodies = list(dict.fromkeys([*file.rotations, *group_markers(file.markers)]))
    if bodies and "," not in (name or ""):
        name = choose_name(path, "body", name, bodies, "bodies")
    of_markers = name not in file.rotations
    if of_markers:
        markers = choose_markers(path, name, file.markers)
        (poses, notes), rate = fit_markers(path, file.points, file.markers, markers, metres), file.rate
    else:
        poses, rate = file.poses[:, file.rotations.index(str(name))], file.rotation_rate
    if len(poses) > MOST_ROWS:
        raise RecordingError(
            f"{path}: has {len(poses)} frames; expected at most {MOST_ROWS}; cut the recording into files."
        )
    times = np.arange(len(poses)) / rate if 0 < rate < np.inf else None
    values = poses.reshape(-1, 16)
    rows = Rows(path, "frame", np.arange(len(poses)), values, times, notes=notes, metres=metres)
    if of_markers:
        rows.missing = UNSEEN
    drop_zeros(rows, values[:, :12])
    return rows


def _metres(path: Path, unit: str, wanted: Selection) -> float:
    """Length of the unit of the file, or of the one given if the file states none."""
    if unit and wanted.unit:
        raise RecordingError(f"{path}: states its unit, {shown(unit, 20)}; leave out {flag('unit')}.")
    stated = unit.lower() or wanted.unit
    if stated is None:
        raise RecordingError(f"{path}: does not state POINT:UNITS; give {flag('unit')}.")
    if stated not in UNITS:
        raise RecordingError(
            f"{path}: expected POINT:UNITS of {', '.join(UNITS)}, found {shown(unit, 20)!r}."
        )
    return UNITS[stated]


def _open(path: Path) -> _File:
    """Read a file; whatever is wrong with it is a :class:`RecordingError`."""
    import_extra(path, "ezc3d", "c3d")
    _check_structure(path)
    script = Path(__file__).with_name("c3d_process.py")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with TemporaryDirectory() as folder:
        out = Path(folder, "out.npz")
        try:
            done = subprocess.run(
                [sys.executable, "-P", script, path.resolve(), out],
                env=environment,
                capture_output=True,
                text=True,
                errors="replace",
                check=False,
                timeout=_PATIENCE + path.stat().st_size / _SLOWEST,
            )
        except subprocess.TimeoutExpired as error:
            raise _damaged(path, "ezc3d does not come to an end with it") from error
        if done.returncode:
            lines = done.stderr.strip().splitlines()
            reason = shown(lines[-1].strip()).rstrip(".") if lines else f"ezc3d ended with {done.returncode}"
            raise _damaged(path, f"it cannot be read: {reason}")
        with np.load(out) as arrays:
            labels, rotations = ([str(label) for label in arrays[name]] for name in ("markers", "rotations"))
            return _File(
                markers=labels,
                points=arrays["points"],
                rate=float(arrays["rates"][0]),
                rotations=rotations[: arrays["poses"].shape[1]],
                poses=arrays["poses"],
                rotation_rate=float(arrays["rates"][1]),
                unit=str(arrays["unit"]),
            )


def _check_structure(path: Path) -> None:
    """Check that header, parameters and data are where they are said to be."""
    there = path.stat().st_size
    with path.open("rb") as file:
        content = file.read(_MOST_PARAMETERS)
    start = _BLOCK * (content[0] - 1) if content else 0
    if len(content) < 2 * _BLOCK or not 0 < start <= len(content) - 4:
        raise _damaged(path, "it ends before its parameters")
    blocks, processor = content[start + 2], content[start + 3]
    order = ">" if processor == _BIG_ENDIAN else "<"
    end = start + _BLOCK * blocks
    if end > len(content):
        raise _damaged(path, "it ends within its parameters")
    place = start + 4
    while blocks and place < end:  # some writers leave 0
        length = abs(struct.unpack_from("b", content, place)[0])
        body = place + 2 + length
        if not length or body + 2 > end:
            break
        (offset,) = struct.unpack_from(order + "H", content, body)
        if content[place + 1] < 128 and not _fits(content, body + 2, end):
            raise _damaged(path, "a parameter is larger than its record")
        if not offset:
            break
        place = body + offset
    if blocks and place > end:
        raise _damaged(path, "the parameters do not end")
    points, analog, first, last = struct.unpack_from(order + "4H", content, 2)
    if processor in (84, 86):  # DEC has floats of its own
        (scale,) = struct.unpack_from(order + "f", content, 12)
        size = (4 * points + analog) * (4 if scale < 0 else 2) * (last - first + 1 if last >= first else 0)
        data = _BLOCK * (struct.unpack_from(order + "H", content, 16)[0] - 1)
        if data + size > there:
            raise _damaged(path, f"{size} bytes of data are announced, {max(there - data, 0)} are there")


def _fits(content: bytes, place: int, end: int) -> bool:
    """Whether the values of a parameter lie within the section."""
    if place + 2 > end:
        return False
    size, count = abs(struct.unpack_from("b", content, place)[0]), content[place + 1]
    dimensions = content[place + 2 : place + 2 + count]
    return count <= 7 and place + 2 + count + size * prod(dimensions) <= end


def _damaged(path: Path, why: str) -> RecordingError:
    return RecordingError(f"{path}: expected {_WHOLE}; {why}.")


def _contents(path: Path) -> list[Entry]:
    file = _open(path)
    found = [Entry("body", label, f"rotation, {file.rotation_rate:g} Hz") for label in file.rotations]
    return found + marker_entries(file.markers, f"other markers, {file.rate:g} Hz")


C3D = Reader(
    name="a C3D file",
    suffixes=(".c3d",),
    recognises=lambda path, head: head[1:2] == b"\x50",
    read=read_c3d,
    options=frozenset({"body", "in_body", "unit"}),
    contents=_contents,
)

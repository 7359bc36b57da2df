"""Rigid bodies in C3D files: poses of markers, or rotations in the file.

The library ezc3d reads files in a separate process, because damaged files can crash it, block it, or claim
any memory; the structure of a file is checked before. Lengths are in the unit of POINT:UNITS.
"""

import os
import re
import struct
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from math import prod
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from reframe_jax.recordings.readers.markers import (
    group_markers,
    marker_entries,
    set_marker_poses,
    unit_of_markers,
)
from reframe_jax.recordings.readers.reader import Entry, Reader, choose_name, drop_zeros, import_extra
from reframe_jax.recordings.recording import RecordingError, Rows, check_size, shown
from reframe_jax.recordings.selection import Selection

_PROCESS = "import sys; from reframe_jax.recordings.readers.c3d import extract; extract(*sys.argv[1:])"
_BLOCK = 512  # bytes
_MOST_PARAMETERS = 2 * 255 * _BLOCK  # bytes: start and length are one byte each
_BIG_ENDIAN = 86  # processor type that wrote the file
_PATIENCE, _SLOWEST = 30.0, 1e6  # s, and bytes per second, after which reading is stopped


def read_c3d(path: Path, wanted: Selection) -> Rows:
    """Read the poses of a body from its rotations in the file, or from its markers; see :class:`Reader`."""
    file = _open(path)
    markers, rotations, unit = file["markers"].tolist(), file["rotations"].tolist(), str(file["unit"])
    name = wanted.body
    bodies = list(dict.fromkeys([*rotations, *group_markers(markers)]))
    if bodies and "," not in (name or ""):
        name = choose_name(path, "body", name, bodies, "bodies")
    turned = name in rotations
    rate = float(file["rates"][int(turned)])
    content = file["poses"][:, rotations.index(name)] if turned else file["points"]
    check_size(path, len(content))
    times = np.arange(len(content)) / rate if 0 < rate < np.inf else None
    rows = Rows(path, "frame", np.arange(len(content)), content.reshape(-1, prod(content.shape[1:])), times)
    if turned:
        rows.metres = unit_of_markers(path, unit, wanted)
    else:
        set_marker_poses(rows, content, markers, replace(wanted, body=name), unit)
    drop_zeros(rows, rows.values[:, :12])
    return rows


def _open(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays that :func:`extract` writes, with errors as :class:`RecordingError`."""
    import_extra(path, "ezc3d", "c3d")
    _check_structure(path)
    with TemporaryDirectory() as folder:
        out = Path(folder, "out.npz")
        try:
            done = subprocess.run(
                [sys.executable, "-P", "-c", _PROCESS, path.resolve(), out],
                env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
                capture_output=True,
                text=True,
                errors="replace",
                check=False,
                timeout=_PATIENCE + path.stat().st_size / _SLOWEST,
            )
        except subprocess.TimeoutExpired as error:
            raise _damaged(path, "ezc3d does not finish reading it") from error
        if done.returncode:
            lines = done.stderr.strip().splitlines() or [f"ezc3d ended with {done.returncode}"]
            raise _damaged(path, f"it cannot be read: {shown(lines[-1].strip()).rstrip('.')}")
        with np.load(out) as arrays:
            return dict(arrays)


def extract(path: str, out: str) -> None:
    """Read a C3D file with ezc3d, and write its arrays to an .npz; an error ends the process in one line.

    The arrays are ``markers`` (M,) labels, ``points`` (N, M, 3), NaN where a marker is missing, ``rotations``
    (R,) labels, ``poses`` (N', R, 4, 4), ``rates`` (2,) of both in Hz, and ``unit``.
    """
    import ezc3d

    try:
        content = ezc3d.c3d(path)
        groups, data = content["parameters"], content["data"]
        points = np.asarray(data["points"], float)[:3].transpose(2, 1, 0)
        lost = (points == 0).all(axis=2) | (data["meta_points"]["residuals"][0].T < 0)
        rotation, poses = groups.get("ROTATION", {}), np.asarray(data["rotations"], float)
        rate = _number(groups["POINT"], "RATE")
        np.savez(
            out,
            markers=np.asarray(_labels(groups["POINT"])[: points.shape[1]], str),
            points=np.where(lost[..., None], np.nan, points),
            rotations=np.asarray(_labels(rotation)[: poses.shape[2]], str),
            poses=poses.transpose(3, 2, 0, 1),
            rates=[rate, _number(rotation, "RATE") or rate * (_number(rotation, "RATIO") or 1)],
            unit="".join(groups["POINT"]["UNITS"]["value"][:1]).strip(),
        )
    except Exception as error:
        sys.exit(" ".join(str(error).split()) or type(error).__name__)


def _labels(group: Mapping[str, Any]) -> list[str]:
    """Return the labels of a group; each parameter LABELS, LABELS2, ... contains up to 255."""
    names = sorted(filter(re.compile(r"LABELS\d*").fullmatch, group), key=lambda name: name[6:].zfill(9))
    return [label.strip() for name in names for label in group[name]["value"]]


def _number(group: Mapping[str, Any], name: str) -> float:
    values = group[name]["value"] if name in group else []
    return float(values[0]) if len(values) else 0.0


def _check_structure(path: Path) -> None:
    """Check that header, parameters and data are inside the file."""
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
    while blocks and place < end:  # some programs write 0 blocks
        body = place + 2 + abs(struct.unpack_from("b", content, place)[0])
        if body == place + 2 or body + 2 > end:
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
    if processor in (84, 86):  # DEC has another format of floats
        (scale,) = struct.unpack_from(order + "f", content, 12)
        needed = (4 * points + analog) * (4 if scale < 0 else 2) * (last - first + 1 if last >= first else 0)
        left = path.stat().st_size - _BLOCK * (struct.unpack_from(order + "H", content, 16)[0] - 1)
        if needed > left:
            raise _damaged(path, f"{needed} bytes of data are announced, {max(left, 0)} are there")


def _fits(content: bytes, place: int, end: int) -> bool:
    """Return whether the values of a parameter are inside the section."""
    if place + 2 > end:
        return False
    size, count = abs(struct.unpack_from("b", content, place)[0]), content[place + 1]
    dimensions = content[place + 2 : place + 2 + count]
    return count <= 7 and place + 2 + count + size * prod(dimensions) <= end


def _damaged(path: Path, why: str) -> RecordingError:
    return RecordingError(f"{path}: expected a whole C3D file; {why}.")


def _contents(path: Path) -> list[Entry]:
    file = _open(path)
    rate, rotation_rate = file["rates"]
    found = [Entry("body", name, f"rotation, {rotation_rate:g} Hz") for name in file["rotations"].tolist()]
    return found + marker_entries(file["markers"].tolist(), f"other markers, {rate:g} Hz")


C3D = Reader(
    name="a C3D file",
    suffixes=(".c3d",),
    recognises=lambda path, head: head[1:2] == b"\x50",
    read=read_c3d,
    options=frozenset({"body", "in_body", "unit"}),
    contents=_contents,
)

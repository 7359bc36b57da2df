"""Recordings of poses on disk: what is read, what is repaired, what is refused.

NumPy only. Quaternions are (x, y, z, w), pose matrices are written row by row. No row is lost silently:
what is dropped, repaired or odd is noted in ``Recording.notes``; everything else that is wrong raises a
:class:`RecordingError` that says where, what was expected, and what to do.
"""

import csv
import re
import zipfile
import zlib
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["Recording", "RecordingError", "load_recording", "save_recording"]

_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_HEADER = "t,x,y,z,qx,qy,qz,qw"
_MIN_POSES = 5  # of the smallest window that can be identified
_FARTHEST = 20.0  # m from the median position: beyond it the unit is wrong, or the row
_EPOCH = 1e6  # s: times that start later than this count from the first sample
_SLOW = 1.0, 1e3  # s between samples: worth a note, and refused
_ROTATION_ERROR = 1e-4, 1e-2  # worth a note, since printing rounds off less; and refused
_STALE = 0.05  # share of repeated poses that is worth a note


class RecordingError(ValueError):
    """A file that cannot be used as a recording."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Poses of a body {b} in the ground {g} over time.

    Attributes:
        times: (K+1,) s, increasing, not necessarily evenly.
        poses: (K+1, 4, 4), m.
        path: file it came from.
        notes: sentences about what was dropped, repaired or looks odd.
    """

    times: np.ndarray
    poses: np.ndarray
    path: Path
    notes: tuple[str, ...] = ()


@dataclass
class _Rows:
    """Rows of a file on their way to poses.

    ``where`` are their line or sample numbers (``word``), (N,); ``values`` (N, 7) positions and
    quaternions, or (N, 12 or 16) matrices; ``times`` (N,) in s, as exactly as they are written.
    """

    path: Path
    word: str
    where: np.ndarray
    values: np.ndarray
    times: np.ndarray | None
    notes: list[str] = field(default_factory=list)

    def error(self, row: int, problem: str) -> RecordingError:
        return RecordingError(f"{self.path}: {self.word} {self.where[row]}: {problem}")

    def keep(self, mask: np.ndarray, why: str) -> None:
        """Drop the rows outside the mask, with a note."""
        dropped = self.where[~mask]
        if len(dropped):
            more = f" and {len(dropped) - 1} more" if len(dropped) > 1 else ""
            self.notes.append(f"{self.word} {dropped[0]}{more} dropped: {why}.")
        self.where, self.values = self.where[mask], self.values[mask]
        self.times = None if self.times is None else self.times[mask]

    def repair(self, error: np.ndarray, what: str) -> None:
        """Refuse rotations whose error is large; note the repair of others."""
        row, (noted, refused) = int(np.argmax(error)), _ROTATION_ERROR
        if not error[row] <= refused:
            raise self.error(row, f"expected {what}; delete the row if tracking was lost there.")
        if error[row] > noted:
            self.notes.append(f"rotations were repaired: up to {error[row]:.1g} away from {what}.")


def load_recording(
    path: str | Path, *, unit: Literal["m", "cm", "mm"] = "m", dt: float | None = None
) -> Recording:
    """Read a recording of poses.

    Formats, by suffix:

    ``.csv``, ``.tsv``
        Columns named by a header, in any order; others are ignored. Time: ``t``, ``time``,
        ``timestamp``, ``stamp``. Position: ``x``, ``px``, ``pos_x``, ``position.x``; also ``tx``, unless
        there is an ``fx`` or another position, as it is a torque then. Orientation: ``qx``, ``quat_x``,
        ``orientation.x``. Or a pose matrix, ``m00`` to ``m23`` or ``m33`` (or ``t00``): row, column.
    ``.txt``, ``.tum``
        A TUM trajectory: lines of ``t x y z qx qy qz qw``, separated by blanks; ``#`` starts a comment.
    ``.npy``, ``.npz``
        ``poses``: (N, 4, 4), or (N, 7) as ``x y z qx qy qz qw``, or (N, 8) with the time first. An .npz
        may hold ``positions`` (N, 3) and ``quaternions`` (N, 4) instead, and ``times`` (N,).

    Args:
        path: the file.
        unit: of its positions.
        dt: sample time in s, for files without times; times in the file are then ignored.

    Returns:
        The recording, in metres and seconds.

    Raises:
        RecordingError: if the file or one of its rows cannot be used.
    """
    path = Path(path)
    if unit not in _UNITS:
        raise RecordingError(f"unit must be one of {', '.join(_UNITS)}, not {unit!r}.")
    if dt is not None and not 0 < dt < np.inf:
        raise RecordingError(f"dt must be a positive number of seconds, not {dt!r}.")
    suffix = path.suffix.lower()
    if suffix in (".pkl", ".pickle"):
        raise RecordingError(f"{path}: pickles can run code when they are read; save arrays as .npz instead.")
    if suffix not in _READERS:
        raise RecordingError(f"{path}: expected one of {', '.join(_READERS)}, not the suffix {suffix!r}.")
    try:
        rows = _READERS[suffix](path, unit)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}.") from error
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: is not a text file; expected UTF-8.") from error
    times = rows.times = _seconds(rows, dt)
    rows.keep(np.isfinite(rows.values).all(axis=1) & np.isfinite(times), "a number is missing or not finite")
    _check_times(rows, rows.times)
    if len(rows.values) < _MIN_POSES:
        raise RecordingError(f"{path}: has {len(rows.values)} usable poses; expected {_MIN_POSES} or more.")
    poses = _poses(rows)
    poses[:, :3, 3] *= _UNITS[unit]
    _check_positions(rows, poses[:, :3, 3])
    return Recording(rows.times, poses, path, tuple(rows.notes))


def save_recording(path: str | Path, times: ArrayLike, poses: ArrayLike) -> None:
    """Write a recording: a ``.csv`` of ``t,x,y,z,qx,qy,qz,qw``, or an ``.npz`` of ``times`` and ``poses``.

    Args:
        path: the file; its suffix decides.
        times: (K+1,) s.
        poses: (K+1, 4, 4), m.

    Raises:
        RecordingError: if the shapes do not fit, a pose is not a rigid transform, or the file cannot be
            written.
    """
    path, times, poses = Path(path), np.asarray(times, dtype=float), np.asarray(poses, dtype=float)
    if not times.size or times.ndim != 1 or poses.shape != (len(times), 4, 4):
        raise RecordingError(
            f"{path}: expected times (N,) and poses (N, 4, 4), N > 0, not {times.shape} and {poses.shape}."
        )
    if not (np.isfinite(times).all() and np.isfinite(poses).all()):
        raise RecordingError(f"{path}: expected finite times and poses; remove the samples that are not.")
    poses = _poses(_Rows(path, "sample", np.arange(len(times)), poses.reshape(-1, 16), times))
    try:
        if path.suffix.lower() == ".npz":
            np.savez(path, times=times, poses=poses)
        elif path.suffix.lower() == ".csv":
            table = np.column_stack([times, poses[:, :3, 3], _quaternions(poses[:, :3, :3])])
            with path.open("w", newline="", encoding="utf-8") as file:
                csv.writer(file, lineterminator="\n").writerows([_HEADER.split(","), *table.tolist()])
        else:
            raise RecordingError(f"{path}: recordings are written as .csv or .npz, not {path.suffix!r}.")
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror}.") from error


def _read_table(path: Path, unit: str) -> _Rows:
    """A table whose header is the first line, or the last comment before the numbers."""
    lines = _lines(path)
    start = next((i for i, (_, line) in enumerate(lines) if line[0] not in "#%"), len(lines))
    if start >= len(lines) - 1:
        what = "has no more than one line of text" if lines else "is empty"
        raise RecordingError(f"{path}: {what}; expected a header such as {_HEADER}, and rows of numbers.")
    delimiter = next((d for d in "\t;" if d in lines[start][1]), ",")
    cells = [(number, next(csv.reader([line.lstrip("#% ")], delimiter=delimiter))) for number, line in lines]
    if start and _is_number(cells[start][1][0]):
        start -= 1
    number, header = cells[start]
    if _is_number(header[0]):
        raise RecordingError(
            f"{path}: line {number}: expected a header such as {_HEADER}, found numbers; name the columns, "
            "or save a TUM trajectory as .txt."
        )
    time, columns = _find_columns(path, [name.strip() for name in header], unit)
    return _parse(path, cells[start + 1 :], len(header), time, columns)


def _read_trajectory(path: Path, unit: str) -> _Rows:
    """A TUM trajectory: 8 numbers to a line, without a header."""
    cells = [(number, line.split("#")[0].split()) for number, line in _lines(path)]
    cells = [(number, row) for number, row in cells if row]
    if not cells or len(cells[0][1]) != 8:
        raise RecordingError(
            f"{path}: expected a TUM trajectory, lines of t x y z qx qy qz qw separated by blanks; save a "
            "table that has a header as .csv."
        )
    return _parse(path, cells, 8, 0, list(range(1, 8)))


def _lines(path: Path) -> list[tuple[int, str]]:
    """Numbered lines that are not blank."""
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    return [(number, line.strip()) for number, line in enumerate(lines, start=1) if line.strip()]


def _is_number(cell: str) -> bool:
    return bool(re.fullmatch(r"\s*[-+]?[\d.]+(e[-+]?\d+)?\s*", cell, re.IGNORECASE))


def _find_columns(path: Path, header: list[str], unit: str) -> tuple[int | None, list[int]]:
    """Columns of time and of the numbers of a pose."""
    names = [re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_") for name in header]

    def find(pattern: str) -> int | None:
        found = [i for i, name in enumerate(names) if re.fullmatch(pattern, name)]
        if len(found) > 1:
            both = " and ".join(repr(header[i]) for i in found)
            raise RecordingError(f"{path}: columns {both} mean the same; rename or remove all but one.")
        return found[0] if found else None

    time = find(r"(t|time|times|timestamp|stamp|sec|seconds)(_s|_sec|_seconds)?")
    matrix = [find(f"[mt]_?{i // 4}_?{i % 4}") for i in range(16)]
    for size in (16, 12):
        if None not in matrix[:size]:
            return time, [i for i in matrix[:size] if i is not None]
    pose = {axis: find(rf"(p_?|(.*_)?pos(ition)?_)?{axis}(_{unit})?") for axis in "xyz"}
    if set(pose.values()) == {None} and "fx" not in names:
        pose = {axis: find(rf"t_?{axis}(_{unit})?") for axis in "xyz"}
    pose |= {f"q{axis}": find(rf"(q_?|(.*_)?(quat(ernion)?|orientation)_){axis}") for axis in "xyzw"}
    if missing := [key for key, column in pose.items() if column is None]:
        raise RecordingError(
            f"{path}: no column for {', '.join(missing)} (positions in {unit}); expected a header such as "
            f"{_HEADER}, found {','.join(header)}."
        )
    return time, [column for column in pose.values() if column is not None]


def _parse(
    path: Path, cells: list[tuple[int, list[str]]], width: int, time: int | None, columns: list[int]
) -> _Rows:
    values, times = [], []
    for number, row in cells:
        if len(row) != width:
            raise RecordingError(
                f"{path}: line {number}: expected {width} columns, found {len(row)}; delete the line if the "
                "recording was cut off there."
            )
        try:
            values.append([float(row[i].strip() or "nan") for i in columns])
            clock = "nan" if time is None else row[time].strip() or "nan"
            times.append(Decimal(clock) if np.isfinite(float(clock)) else Decimal("nan"))
        except ValueError as error:
            raise RecordingError(f"{path}: line {number}: expected numbers: {error}.") from error
    stamps = None if time is None else np.asarray(times, dtype=object)
    return _Rows(path, "line", np.asarray([number for number, _ in cells]), np.asarray(values), stamps)


def _read_arrays(path: Path, unit: str) -> _Rows:
    try:
        with path.open("rb") as file:  # NumPy leaves it open when it is no archive
            loaded = np.load(file, allow_pickle=False)
            arrays = {"poses": loaded} if isinstance(loaded, np.ndarray) else dict(loaded)
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise RecordingError(
            f"{path}: does not hold plain arrays; expected numbers as np.save or np.savez writes them, whole."
        ) from error
    shapes = {name: array.shape for name, array in arrays.items() if array.dtype.kind in "fiu"}
    count = next(iter(shapes.get("poses") or shapes.get("positions") or (0,)))
    if (shapes.get("positions"), shapes.get("quaternions")) == ((count, 3), (count, 4)):
        arrays["poses"] = np.hstack([arrays["positions"], arrays["quaternions"]])
    poses, times = arrays.get("poses", np.empty(0)), arrays.get("times")
    if poses.shape == (count, 8) and times is None:
        poses, times = poses[:, 1:], poses[:, 0]
    fits = poses.shape in ((count, 7), (count, 4, 4)) and shapes.get("times", (count,)) == (count,)
    if not fits or not count or not {"poses", "positions"} & shapes.keys():
        raise RecordingError(
            f"{path}: expected numbers: poses (N, 4, 4), or positions (N, 3) and quaternions (N, 4), and "
            f"times (N,); found {shapes}."
        )
    return _Rows(path, "sample", np.arange(count), poses.reshape(count, -1).astype(float), times)


_READERS = {
    **dict.fromkeys([".csv", ".tsv"], _read_table),
    **dict.fromkeys([".txt", ".tum"], _read_trajectory),
    **dict.fromkeys([".npy", ".npz"], _read_arrays),
}


def _seconds(rows: _Rows, dt: float | None) -> np.ndarray:
    """Times as floating-point numbers, those of a clock since its first sample."""
    if dt is not None:
        if rows.times is not None:
            rows.notes.append(f"the times in the file are ignored, for the sample time of {dt:g} s given.")
        return np.arange(len(rows.values)) * float(dt)
    if rows.times is None:
        raise RecordingError(f"{rows.path}: has no times; name a column t, in seconds, or give dt (--dt).")
    times = rows.times.astype(float)
    finite = np.flatnonzero(np.isfinite(times))
    if not len(finite) or abs(times[finite[0]]) < _EPOCH:
        return times
    first = rows.times[finite[0]]
    rows.notes.append(f"times count from the first sample, at {first} s.")
    # subtracted before rounding: floats resolve the time since 1970 to no better than 0.2 us
    since: np.ndarray = rows.times - first
    return since.astype(float)


def _check_times(rows: _Rows, times: np.ndarray) -> None:
    """Refuse times that do not increase; drop exact duplicates."""
    steps, still = np.diff(times), (np.diff(rows.values, axis=0) == 0).all(axis=1)
    wrong = np.flatnonzero((steps < 0) | ((steps == 0) & ~still))
    if len(wrong):
        now = wrong[0] + 1
        problem = "goes back in time" if steps[wrong[0]] < 0 else "has another pose at the same time"
        raise rows.error(
            now, f"{problem}, {times[now - 1]:g} s to {times[now]:g} s; expected times to increase."
        )
    step = float(np.median(steps)) if len(steps) else 0.0
    slow = f"samples are {step:g} s apart; if the times are in ms, us or ns, convert them or give dt (--dt)."
    if step > _SLOW[1]:
        raise RecordingError(f"{rows.path}: {slow}")
    if step > _SLOW[0]:
        rows.notes.append(slow)
    stale = int(np.sum(still & (steps > 0)))
    if stale > _STALE * len(times):
        rows.notes.append(
            f"{stale} of {len(times)} samples repeat the pose before: a tracker that repeats old samples "
            "makes the velocity jump; remove them unless the body stood still."
        )
    rows.keep(np.append(True, steps > 0)[: len(times)], "it repeats the row before")


def _check_positions(rows: _Rows, positions: np.ndarray) -> None:
    distance = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    row = int(np.argmax(distance))
    if distance[row] > _FARTHEST:
        raise rows.error(
            row,
            f"lies {distance[row]:.3g} m from the median position; expected less than {_FARTHEST:g} m. If "
            "the positions are in mm or cm, say so (unit='mm', --unit mm); otherwise delete the row.",
        )


def _poses(rows: _Rows) -> np.ndarray:
    """Poses (N, 4, 4) with proper rotations; positions in the unit of the file."""
    poses = np.tile(np.eye(4), (len(rows.values), 1, 1))
    if rows.values.shape[1] == 7:
        poses[:, :3, 3] = rows.values[:, :3]
        length = np.linalg.norm(rows.values[:, 3:], axis=1)
        rows.repair(np.abs(length - 1), "a quaternion of length 1")
        poses[:, :3, :3] = _matrices(rows.values[:, 3:] / length[:, None])
        return poses
    poses[:, : rows.values.shape[1] // 4] = rows.values.reshape(len(poses), -1, 4)
    rotations = poses[:, :3, :3]
    error = np.abs(rotations.swapaxes(1, 2) @ rotations - np.eye(3)).max(axis=(1, 2))
    rigid = (poses[:, 3] == [0, 0, 0, 1]).all(axis=1) & (np.linalg.det(rotations) > 0)
    rows.repair(np.where(rigid, error, np.inf), "a pose matrix [R p; 0 0 0 1] with R^T R = I and det R = 1")
    left, _, right = np.linalg.svd(rotations)
    inexact = (error > 1e-12)[:, None, None]  # others stay as they are, bit by bit
    poses[:, :3, :3] = np.where(inexact, left @ right, rotations)
    return poses


def _matrices(quaternions: np.ndarray) -> np.ndarray:
    """(N, 3, 3) from unit quaternions; `rotations` would need JAX and its 64-bit switch."""
    cross = np.cross(quaternions[:, None, :3], np.eye(3)).swapaxes(1, 2)
    turned: np.ndarray = np.eye(3) + 2 * quaternions[:, 3, None, None] * cross + 2 * cross @ cross
    return turned


def rotation_vectors(matrices: np.ndarray) -> np.ndarray:
    """Rotation vectors (..., 3), rad, of rotation matrices (..., 3, 3), half turns included."""
    quaternions = _quaternions(matrices.reshape(-1, 3, 3))
    sine = np.linalg.norm(quaternions[:, :3], axis=1)
    factor = 2 * np.arctan2(sine, quaternions[:, 3]) / np.where(sine == 0, 1, sine)
    return (factor[:, None] * quaternions[:, :3]).reshape(*matrices.shape[:-2], 3)


def _quaternions(matrices: np.ndarray) -> np.ndarray:
    """Unit quaternions with w >= 0: the eigenvectors of 4 q q^T, which is linear in the matrix."""
    outer, trace = np.empty((len(matrices), 4, 4)), np.trace(matrices, axis1=1, axis2=2)
    skew = matrices - matrices.swapaxes(1, 2)
    outer[:, :3, :3] = matrices + matrices.swapaxes(1, 2) + (1 - trace)[:, None, None] * np.eye(3)
    outer[:, 3, :3] = outer[:, :3, 3] = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    outer[:, 3, 3] = 1 + trace
    found = np.linalg.eigh(outer)[1][..., -1]
    return np.where(found[:, 3:] < 0, -found, found)

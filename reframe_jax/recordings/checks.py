"""From rows of numbers to poses: repairs, drops and refusals."""

from collections.abc import Iterator

import numpy as np

from reframe_jax.geometry.numpy_rotations import quaternions_to_matrices
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import Rows

__all__ = ["MIN_POSES", "check_positions", "check_times", "drop_unfinished", "make_poses", "make_times"]

MIN_POSES = 5  # of the smallest window that can be identified
_FARTHEST = 20.0  # m from the median position: beyond it the unit is wrong, or the row
_SLOW = 1.0, 1e3  # s between samples: worth a note, and refused
_ROTATION_ERROR = 1e-4, 1e-2  # worth a note, since printing rounds off less; and refused
_STALE = 0.05  # share of repeated poses that is worth a note
_BLOCK = 2**14  # rows worked on at once, so that intermediate values stay small


def make_times(rows: Rows, dt: float | None) -> np.ndarray:
    """Times of the rows (N,), s: those of the file, or multiples of the sample time.

    Raises:
        RecordingError: if there is neither.
    """
    if dt is not None:
        if rows.times is not None:
            rows.notes.append(f"the times in the file are ignored, for the sample time of {dt:g} s given.")
        return np.arange(len(rows.values)) * float(dt)
    if rows.times is None:
        raise RecordingError(f"{rows.path}: has no times; name a column t, in seconds, or give dt (--dt).")
    if rows.origin is not None:
        rows.notes.append(f"times count from the first sample, at {rows.origin} s.")
    return rows.times


def drop_unfinished(rows: Rows, times: np.ndarray) -> np.ndarray:
    """Drop rows in which a number is missing, and return the remaining times."""
    rows.times = times
    rows.keep(np.isfinite(rows.values).all(axis=1) & np.isfinite(times), "a number is missing or not finite")
    return rows.times


def check_times(rows: Rows, times: np.ndarray) -> np.ndarray:
    """Refuse times that do not increase, drop exact duplicates, and return the remaining times.

    Raises:
        RecordingError: if time decreases, stands still while the body moves, or is not in seconds.
    """
    rows.times = times
    steps, still = np.diff(times), _repeats(rows.values)
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
    return rows.times


def check_positions(rows: Rows, positions: np.ndarray) -> None:
    """Refuse positions (N, 3), m, one of which is far from the others.

    Raises:
        RecordingError: if one is more than 20 m from the median position.
    """
    distance = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    row = int(np.argmax(distance))
    if not distance[row] <= _FARTHEST:
        raise rows.error(
            row,
            f"lies {distance[row]:.3g} m from the median position; expected less than {_FARTHEST:g} m. If "
            "the positions are in mm or cm, say so (unit='mm', --unit mm); otherwise delete the row.",
        )


def make_poses(rows: Rows) -> np.ndarray:
    """Poses (N, 4, 4) with proper rotations; positions in the unit of the file.

    Raises:
        RecordingError: if a rotation is invalid.
    """
    values = rows.values
    poses = np.zeros((len(values), 4, 4))
    poses[:, 3, 3] = 1
    if values.shape[1] == 7:
        poses[:, :3, 3] = values[:, :3]
        length = np.linalg.norm(values[:, 3:], axis=1)
        _judge(rows, np.abs(length - 1), "a quaternion of length 1")
        for block in _blocks(len(values)):
            poses[block, :3, :3] = quaternions_to_matrices(values[block, 3:] / length[block, None])
        return poses
    poses[:, : values.shape[1] // 4] = values.reshape(len(values), -1, 4)
    error = np.empty(len(values))
    for block in _blocks(len(values)):
        rotations = poses[block, :3, :3]
        inexact = np.abs(rotations.swapaxes(1, 2) @ rotations - np.eye(3)).max(axis=(1, 2))
        rigid = (poses[block, 3] == [0, 0, 0, 1]).all(axis=1) & (np.linalg.det(rotations) > 0)
        error[block] = np.where(rigid, inexact, np.inf)
    _judge(rows, error, "a pose matrix [R p; 0 0 0 1] with R^T R = I and det R = 1")
    for block in _blocks(len(values)):
        repaired = np.flatnonzero(error[block] > 1e-12) + block.start  # others stay as they are, bit by bit
        left, _, right = np.linalg.svd(poses[repaired, :3, :3])
        poses[repaired, :3, :3] = left @ right
    return poses


def _judge(rows: Rows, error: np.ndarray, what: str) -> None:
    """Refuse rotations whose error (N,) is large; note the repair of others."""
    row, (noted, refused) = int(np.argmax(error)), _ROTATION_ERROR
    if not error[row] <= refused:
        raise rows.error(row, f"expected {what}; delete the row if tracking was lost there.")
    if error[row] > noted:
        rows.notes.append(f"rotations were repaired: up to {error[row]:.1g} away from {what}.")


def _repeats(values: np.ndarray) -> np.ndarray:
    """Whether each row but the first holds the numbers of the one before: (N-1,) bool."""
    same = np.empty(max(len(values) - 1, 0), bool)
    for block in _blocks(len(same)):
        same[block] = (values[1:][block] == values[:-1][block]).all(axis=1)
    return same


def _blocks(count: int) -> Iterator[slice]:
    """Slices that cover so many rows."""
    for start in range(0, count, _BLOCK):
        yield slice(start, min(start + _BLOCK, count))

"""From rows of numbers to poses: repairs, rows that are left out, and refusals."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from reframe_jax.geometry.numpy_rotations import quaternions_to_matrices, rotation_vectors
from reframe_jax.recordings.continuity import is_unordered
from reframe_jax.recordings.conventions import angle_matrices, keeps_a_point_better, sample_rows
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import Rows, is_path
from reframe_jax.recordings.selection import UNITS, Selection

__all__ = ["MIN_POSES", "check_positions", "check_turns", "drop_unfinished", "make_poses", "note_repeats"]

MIN_POSES = 4  # of a tool whose tip is calibrated; a motion needs 5
_FARTHEST = 20.0  # m from the median position, of a body that is moved by hand or by an arm
_DISTANT_FRACTION = 0.05  # fraction of the rows that are left out if they are farther
_APART = 3.0  # times farther than all others
_VEHICLE, _HAND = 20.0, 50.0  # m/s^2: what a vehicle stays below, and what a hand seldom exceeds
_OVER = 0.5  # s, over which accelerations are taken, so that noise does not count
_FEWEST = 10  # rows; fewer are taken for separate touches
_ROOM = 10.0  # m: separate touches seldom span more
_MANY = 30  # rows, from which on accelerations say something
_SMALL = 3.0  # numbers that span less are metres, rather than mm or cm
_FASTEST, _FAST = 30.0, 8.0  # rad/s, of angles that are refused, and of those that are worth a note
_ROTATION_ERROR = 1e-4, 1e-2  # worth a note, since printing rounds off less; and refused
_ROUNDED = 1e-6  # error of the last row of a matrix that is no more than rounding
_STALE = 0.05  # fraction of repeated poses that is worth a note
_BLOCK = 2**14  # rows worked on at once, so that intermediate values stay small


def drop_unfinished(rows: Rows) -> None:
    """Leave out rows in which a number is missing, or whose quaternion is zero."""
    finite = np.isfinite(rows.values).all(axis=1)
    if rows.times is not None:
        finite &= np.isfinite(rows.times)
    rows.keep(finite, rows.missing, "missing")
    if rows.values.shape[1] == 7:
        turned = (rows.values[:, 3:] != 0).any(axis=1)
    else:
        turned = (rows.values.reshape(len(rows.values), -1, 4)[:, :3, :3] != 0).any(axis=(1, 2))
    rows.keep(turned, "all numbers of the orientation are 0, so tracking was lost", "untracked")


def note_repeats(rows: Rows, poses: np.ndarray) -> None:
    """Note poses (N, 4, 4) that repeat the one before, if there are many of them."""
    stale = int(np.sum((poses[1:] == poses[:-1]).all(axis=(1, 2))))
    if stale > _STALE * len(poses):
        rows.notes.append(
            f"{stale} of {len(poses)} poses repeat the one before exactly: the body rested, or the poses are "
            "written more often than they are measured."
        )


def check_positions(rows: Rows, poses: np.ndarray, wanted: Selection) -> np.ndarray:
    """Leave out rows that are far from all others, and check the unit of the positions.

    Args:
        rows: the rows, with times.
        poses: (N, 4, 4), m.
        wanted: the unit.

    Returns:
        Poses (N, 4, 4) of the rows that are left.

    Raises:
        RecordingError: if the body moves as none does.
    """
    kept = _leave_out_distant(rows, poses[:, :3, 3])
    poses = poses if kept is None else poses[kept]
    positions, count = poses[:, :3, 3], len(poses)
    span = float(np.linalg.norm(np.ptp(positions, axis=0)))
    distance = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    touches = count < _FEWEST or is_unordered(poses)
    change = _acceleration(positions, rows.times) if rows.times is not None else 0.0
    too_fast = f"the velocity changes by {change:.2g} m/s^2, more than"
    advice = "if the positions are in mm, " + (
        "give unit='mm' (--unit mm), for cm unit='cm'"
        if rows.metres is None
        else "the file states another unit: correct it"
    )
    if distance.max(initial=0) > _FARTHEST:
        row = int(np.argmax(distance))
        where = f"lies {distance[row]:.3g} m from the median position"
        if touches:
            raise rows.error(row, f"{where}; {advice}.")
        if not change <= _VEHICLE:
            raise rows.error(row, f"{where}, and {too_fast} that of a vehicle; {advice}.")
        rows.notes.append(f"positions span {span:.3g} m, as those of a vehicle; {advice}.")
    elif touches and span > _ROOM:
        rows.notes.append(f"positions span {span:.3g} m; {advice}.")
    elif change > _HAND and count >= _MANY and span > 1 and is_path(positions):
        rows.notes.append(f"{too_fast} a hand moves a body; {advice}.")
    unit = UNITS[wanted.unit or "m"]
    if unit < 1 and rows.metres is None and span < _SMALL * unit and count >= _MANY:
        rows.notes.append(
            f"positions span {1e3 * span:.2g} mm; if the file has them in m, leave out unit (--unit)."
        )
    return poses


def _leave_out_distant(rows: Rows, positions: np.ndarray) -> np.ndarray | None:
    """Leave out a few rows that are much farther away than all others; the rows (N,) that are left."""
    distance = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    ranked = np.sort(distance)
    limits = np.maximum(_APART * ranked[:-1], _FARTHEST)
    most = max(int(_DISTANT_FRACTION * len(ranked)), 1)
    gaps = np.flatnonzero(~(ranked[1:] <= limits))
    gaps = gaps[gaps + 1 >= len(ranked) - most]
    if not len(gaps):
        return None
    limit = limits[gaps[0]]
    note = "; if the unit is wrong, give unit (--unit)" if rows.metres is None else ""
    kept: np.ndarray = distance <= limit
    rows.keep(kept, f"more than {limit:.3g} m from the other positions{note}", "far")
    return kept


def _acceleration(positions: np.ndarray, times: np.ndarray) -> float:
    """Change of the velocity in m/s^2 that three of four poses stay below."""
    step = np.median(np.diff(times)) if len(times) > 1 else 0.0
    if len(times) < 3 or not step > 0:
        return 0.0
    lag = int(np.clip(np.ceil(_OVER / step), 1, (len(times) - 1) // 2))
    velocities = (positions[lag:] - positions[:-lag]) / (times[lag:] - times[:-lag])[:, None]
    changes = np.linalg.norm(velocities[lag:] - velocities[:-lag], axis=1)
    middle = (times[2 * lag :] - times[: -2 * lag]) / 2
    return float(np.quantile(changes / middle, 0.75))


def check_turns(rows: Rows, poses: np.ndarray, wanted: Selection) -> None:
    """Refuse angles in radians if a body turns as none does; note angles that are degrees rather.

    Raises:
        RecordingError: if half of the steps are faster than 30 rad/s.
    """
    if rows.angles is None or wanted.angle_unit is not None or len(poses) < 3 or rows.times is None:
        return
    steps = poses[1:, :3, :3] @ poses[:-1, :3, :3].swapaxes(1, 2)
    rate = float(np.median(np.linalg.norm(rotation_vectors(steps), axis=1) / np.diff(rows.times)))
    sentence = f"read in rad, its angles turn the body by {rate:.2g} rad/s"
    advice = "if they are in degrees, give angle_unit='deg' (--angle-unit deg)"
    if rate > _FASTEST:
        raise RecordingError(
            f"{rows.path}: {sentence}, faster than any hand; {advice}, else angle_unit='rad' "
            "(--angle-unit rad)."
        )
    some = sample_rows(len(poses))
    degrees = angle_matrices(rows.path, rows.angles[some], replace(wanted, angle_unit="deg"))
    if rate > _FAST:
        rows.notes.append(f"{sentence}; {advice}.")
    elif keeps_a_point_better(poses[some, :3, 3], poses[some, :3, :3], degrees):
        rows.notes.append(
            f"in degrees its angles turn the body about a point, and in rad about none; {advice}, else "
            "angle_unit='rad' (--angle-unit rad)."
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
        last = np.abs(poses[block, 3] - [0, 0, 0, 1]).max(axis=1)
        rigid = (last < _ROUNDED) & (np.linalg.det(rotations) > 0)
        error[block] = np.where(rigid, inexact, np.inf)
    poses[:, 3] = [0, 0, 0, 1]
    _judge(rows, error, "a pose matrix [R p; 0 0 0 1] with R^T R = I and det R = 1")
    for block in _blocks(len(values)):
        repaired = np.flatnonzero(error[block] > 1e-12) + block.start  # others stay as they are, bit by bit
        left, _, right = np.linalg.svd(poses[repaired, :3, :3])
        poses[repaired, :3, :3] = left @ right
    return poses


def _judge(rows: Rows, error: np.ndarray, what: str) -> None:
    """Refuse rotations whose error (N,) is large; note the repair of others."""
    if not len(error):
        return
    row, (noted, refused) = int(np.argmax(error)), _ROTATION_ERROR
    wrong = int(np.sum(~(error <= refused)))
    if wrong > len(error) / 2:
        raise rows.error(
            row,
            f"expected {what}, also in {wrong - 1} of the other {len(error) - 1} rows: the numbers are in "
            "another order, or mean something else.",
        )
    if wrong:
        raise rows.error(row, f"expected {what}; delete the row if tracking was lost there.")
    if error[row] > noted:
        rows.notes.append(f"rotations were repaired: up to {error[row]:.1g} away from {what}.")


def _blocks(count: int) -> Iterator[slice]:
    """Slices that cover so many rows."""
    for start in range(0, count, _BLOCK):
        yield slice(start, min(start + _BLOCK, count))

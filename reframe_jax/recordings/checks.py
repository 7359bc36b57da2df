"""Check the rows of a file and convert them to poses; wrong rows are repaired, left out or refused."""

import numpy as np

from reframe_jax.geometry.numpy_rotations import angles_between, nearest_rotations, quaternions_to_matrices
from reframe_jax.recordings.continuity import is_unordered
from reframe_jax.recordings.conventions import keeps_a_point_better, sample_rows
from reframe_jax.recordings.lost import find_lost_poses
from reframe_jax.recordings.recording import RecordingError, Rows, name_rows
from reframe_jax.recordings.selection import ANGLE_UNITS, UNITS, Selection

MIN_POSES = 4  # smallest number of poses for a calibration; a motion needs 5
_DISTANT = 20.0  # m from the median position: beyond the reach of a hand or an arm
_DISTANT_FRACTION = 0.2  # largest fraction of rows that are left out as distant
_APART = 3.0  # factor between the distance of distant rows and of all others
_VEHICLE, _HAND = 20.0, 50.0  # m/s^2, largest acceleration of a vehicle, and usual largest of a hand
_OVER = 0.5  # s, interval of accelerations, so that noise has no effect
_FEWEST = 10  # rows; fewer count as separate touches
_ROOM = 10.0  # m, largest usual span of separate touches
_MAP = 2e4  # m from the origin, above which positions are those of a map, and not in mm
_MANY = 30  # rows needed to judge accelerations
_SMALL = 3.0  # span of positions in the unit of the file, below which they are probably in m
_FASTEST, _FAST = 30.0, 8.0  # rad/s, of angles in rad: refused, and noted
_ROTATION_ERROR = 1e-4, 1e-2  # noted (above the rounding of printed numbers), and refused
_ROUNDED = 1e-6  # rounding error of the last row of a matrix
_ACROSS, _ALTERNATE = 5.0, 0.4  # step between bodies over a later step of one, and fraction of such steps
_STALE = 0.05  # fraction of repeated poses that is noted
_BLOCK = 2**14  # rows per block, so that intermediate arrays stay small
_WHY = {
    "origin": "0, 0, 0",
    "identity": "the identity",
    "constant": "the pose is a constant distant from the others",
    "frozen": "the previous pose is repeated while the body moved on",
    "end": "the last pose is repeated exactly while the body was moving",
}
_FEW, _FEW_FRACTION = 10, 0.5  # fewest poses, and fewest fraction of poses, of which one must remain
_JUMP, _JUMPS = 2.5, 8  # length of jumps over the longest other step, and most jumps in a note
_CLOSE = 0.02  # m, largest position of lost poses that are close to the identity
_SIZE = 0.3  # m, of a body; converts an angle to a length
_TURN = 0.2  # length of a jump over its angle times the size, below which the angle is given


def drop_unfinished(rows: Rows) -> None:
    """Leave out rows in which a number is missing, or in which the orientation is all zeros."""
    finite = np.isfinite(rows.values).all(axis=1)
    if rows.times is not None:
        finite &= np.isfinite(rows.times)
    rows.keep(finite, rows.missing, "missing")
    if rows.values.shape[1] == 7:
        turned = (rows.values[:, 3:] != 0).any(axis=1)
    else:
        turned = (rows.values.reshape(-1, rows.values.shape[1] // 4, 4)[:, :3, :3] != 0).any(axis=(1, 2))
    rows.keep(turned, "all numbers of the orientation are 0, so tracking was lost", "untracked")


def note_repeats(rows: Rows, poses: np.ndarray) -> None:
    """Add a note to ``rows`` if many poses (N, 4, 4) equal the previous pose."""
    stale = int(np.sum((poses[1:] == poses[:-1]).all(axis=(1, 2))))
    if stale > _STALE * len(poses):
        rows.notes.append(
            f"{stale} of {len(poses)} poses repeat the previous pose exactly: the body rested, or poses are "
            "written more often than they are measured."
        )


def check_positions(rows: Rows, poses: np.ndarray, wanted: Selection) -> tuple[np.ndarray, bool]:
    """Leave out distant rows of poses (N, 4, 4), m, and check the unit of the positions.

    The result is the poses (M, 4, 4) of the remaining rows, and whether they are separate touches in any
    order. Positions that are too far apart for a body in the unit of the file are refused.
    """
    kept = _near(poses[:, :3, 3])
    hint = "; if the unit is wrong, give unit (--unit)" if rows.metres is None else ""
    why = f"more than {_DISTANT:g} m and {_APART:g} times farther away than all other positions{hint}"
    rows.keep(kept, why, "far")
    poses = poses[kept]
    positions, count = poses[:, :3, 3], len(poses)
    if count >= _MANY:
        ahead = [np.linalg.norm(positions[k : count - 4 + k] - positions[:-4], axis=1) for k in range(1, 5)]
        if np.mean(ahead[0] > _ACROSS * np.min(ahead[1:], axis=0) + 1e-3) > _ALTERNATE:
            raise rows.error(1, "the poses of several bodies alternate: keep the rows of one.")
    middle = np.median(positions, axis=0)
    span = float(np.linalg.norm(np.ptp(positions, axis=0)))
    distance = np.linalg.norm(positions - middle, axis=1)
    unordered = is_unordered(poses)
    touches = count < _FEWEST or unordered
    change = _acceleration(positions, np.asarray(rows.times))
    too_fast = f"the velocity changes by {change:.2g} m/s^2, more than"
    remedy = "give unit='mm' (--unit mm), for cm unit='cm'"
    corrected = "correct the unit in the file, or give unit (--unit) if the file states none"
    advice = f"if the positions are in mm, {corrected if rows.metres else remedy}"
    if distance.max(initial=0) > _DISTANT:
        row = int(np.argmax(distance))
        where = f"{distance[row]:.3g} m from the median position"
        if touches:
            raise rows.error(row, f"{where}; {advice}.")
        if not change <= _VEHICLE:
            raise rows.error(row, f"{where}, and {too_fast} that of a vehicle; {advice}.")
        rows.notes.append(f"positions span {span:.3g} m, like those of a vehicle; {advice}.")
    elif touches and span > _ROOM:
        rows.notes.append(f"positions span {span:.3g} m; {advice}.")
    elif rows.metres is None and _DISTANT < (away := float(np.linalg.norm(middle))) < _MAP:
        rows.notes.append(f"positions span {span:.2g} m, {away:.3g} m from the origin; {advice}.")
    elif change > (_HAND if span < _ROOM else _VEHICLE) and count >= _MANY and span > 1 and not touches:
        rows.notes.append(f"{too_fast} that of a hand; {advice}.")
    unit = rows.metres or UNITS[wanted.unit or "m"]
    if unit < 1 and 0 < span < _SMALL * unit and count >= _MANY:
        remedy = corrected if rows.metres else "leave out unit (--unit)"
        rows.notes.append(f"positions span {1e3 * span:.2g} mm; if they are in m, {remedy}.")
    return poses, unordered


def _near(positions: np.ndarray) -> np.ndarray:
    """Mask (N,) of rows; False for a few rows that are much more distant than all others."""
    distance = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    ranked = np.sort(distance)
    limits = np.maximum(_APART * ranked[:-1], _DISTANT)
    most = max(int(_DISTANT_FRACTION * len(ranked)), 1)
    gaps = np.flatnonzero(~(ranked[1:] <= limits))
    gaps = gaps[gaps + 1 >= len(ranked) - most]
    return distance <= (limits[gaps[0]] if len(gaps) else np.inf)


def _acceleration(positions: np.ndarray, times: np.ndarray) -> float:
    """Upper quartile of the acceleration, m/s^2, at increasing times; 0 for fewer than three."""
    if len(times) < 3:
        return 0.0
    lag = int(np.clip(np.ceil(_OVER / np.median(np.diff(times))), 1, (len(times) - 1) // 2))
    velocities = (positions[lag:] - positions[:-lag]) / (times[lag:] - times[:-lag])[:, None]
    changes = np.linalg.norm(velocities[lag:] - velocities[:-lag], axis=1)
    return float(np.quantile(changes / ((times[2 * lag :] - times[: -2 * lag]) / 2), 0.75))


def check_turns(rows: Rows, poses: np.ndarray, wanted: Selection, unordered: bool) -> None:
    """Refuse angles that were read in the wrong unit, or add a note to ``rows`` if in doubt.

    The poses (N, 4, 4), m, are made from these angles. Unordered poses, separate touches, have no velocities.
    """
    angles = rows.angles
    if angles is None or wanted.angle_unit == "rad" or len(poses) < 3 or rows.times is None:
        return
    own, other, read, meant = "rad", "deg", "rad", "degrees"
    if angles.unit != 1:
        own, other, read, meant = other, own, meant, read
    rate = float(np.median(angles_between(poses[:-1, :3, :3], poses[1:, :3, :3]) / np.diff(rows.times)))
    sentence = f"read in {read}, the angles turn the body at {rate:.2g} rad/s"
    advice = f"if they are in {meant}, give angle_unit={other!r} (--angle-unit {other})"
    if angles.stated:
        advice = f"if they are in {meant}, correct the unit in the file"
    elif wanted.angle_unit is None:
        advice += f", else angle_unit={own!r} (--angle-unit {own})"
    swift = rate > _FAST and own == "rad" and not unordered
    if swift and rate > _FASTEST and not angles.stated:
        raise RecordingError(f"{rows.path}: {sentence}, faster than hands and robots turn; {advice}.")
    some = sample_rows(len(poses))
    others = angles[some].matrices(unit=ANGLE_UNITS[other])
    if swift:
        rows.notes.append(f"{sentence}; {advice}.")
    elif keeps_a_point_better(poses[some, :3, 3], poses[some, :3, :3], others):
        rows.notes.append(
            f"read in {meant}, the angles turn the body about a fixed point, but not if read in {read}; "
            f"{advice}."
        )


def make_poses(rows: Rows) -> np.ndarray:
    """Convert rows to poses (N, 4, 4), in the unit of the file; rotations that are not proper are refused."""
    values = rows.values
    blocks = [slice(start, start + _BLOCK) for start in range(0, len(values), _BLOCK)]
    poses = np.zeros((len(values), 4, 4))
    poses[:, 3, 3] = 1
    if values.shape[1] == 7:
        poses[:, :3, 3] = values[:, :3]
        length = np.linalg.norm(values[:, 3:], axis=1)
        lengths = f"the lengths are {length.min(initial=np.inf):.3g} to {length.max(initial=0):.3g}"
        _judge(
            rows,
            np.abs(length - 1),
            "a quaternion of length 1",
            f"{lengths}, so the quaternions are not normalized, or the columns have another order; divide "
            "each quaternion by its length, or correct the order",
        )
        for block in blocks:
            poses[block, :3, :3] = quaternions_to_matrices(values[block, 3:] / length[block, None])
        return poses
    poses[:, : values.shape[1] // 4] = values.reshape(-1, values.shape[1] // 4, 4)
    error = np.empty(len(values))
    for block in blocks:
        rotations = poses[block, :3, :3]
        inexact = np.abs(rotations.swapaxes(1, 2) @ rotations - np.eye(3)).max(axis=(1, 2))
        last = np.abs(poses[block, 3] - [0, 0, 0, 1]).max(axis=1)
        rigid = (last < _ROUNDED) & (np.linalg.det(rotations) > 0)
        error[block] = np.where(rigid, inexact, np.inf)
    poses[:, 3] = [0, 0, 0, 1]
    _judge(
        rows,
        error,
        "a pose matrix [R p; 0 0 0 1] with R^T R = I and det R = 1",
        "the numbers have another order, such as column by column, or another meaning",
    )
    for block in blocks:
        repaired = np.flatnonzero(error[block] > 1e-12) + block.start  # exact rotations keep every bit
        poses[repaired, :3, :3] = nearest_rotations(poses[repaired, :3, :3])
    return poses


def _judge(rows: Rows, error: np.ndarray, expected: str, cause: str) -> None:
    """Refuse rotations with large errors (N,), and note small repairs."""
    if not len(error):
        return
    row, (noted, refused) = int(np.argmax(error)), _ROTATION_ERROR
    wrong = int(np.sum(~(error <= refused)))
    if wrong > len(error) / 2:
        others = f"also in {wrong - 1} of the other {len(error) - 1} rows"
        raise rows.error(row, f"expected {expected}, {others}: {cause}.")
    if wrong:
        raise rows.error(row, f"expected {expected}; delete the row if tracking was lost there.")
    if error[row] > noted:
        rows.notes.append(f"rotations were repaired: up to {error[row]:.1g} away from {expected}.")


def leave_out_lost(rows: Rows, poses: np.ndarray) -> np.ndarray:
    """Leave out the rows of poses (N, 4, 4), m, in which tracking was lost, with notes; return the others.

    Too few remaining poses are refused.
    """
    lost = find_lost_poses(poses, rows.times)
    where, kept = rows.where, lost == ""
    for kind, why in _WHY.items():
        mine = lost == kind
        if not mine.any():
            continue
        if kind in ("origin", "identity"):
            positions = np.abs(poses[mine, :3, 3]).max()
            turns = np.abs(poses[mine, :3, :3] - np.eye(3)).max()
            part = "position" if kind == "origin" else "pose" if positions < _CLOSE else "orientation"
            exact = (positions if kind == "origin" else turns) == 0
            why = f"the {part} is {'' if exact else 'close to '}{why}"
        if kind in ("frozen", "end"):
            why = why.replace("pose", _repeated(poses[mine], poses[np.flatnonzero(mine) - 1]), 1)
        runs = np.flatnonzero(np.diff(mine, prepend=False, append=False)).reshape(-1, 2)
        start, stop = runs[np.argmax(np.diff(runs))]
        before, after = np.flatnonzero(kept[:start]), np.flatnonzero(kept[stop:]) + stop
        back = f" at {rows.word} {where[after[0]]}" if len(after) else ""
        jump = ""
        if len(before) and kind not in ("frozen", "end"):
            there = f"{_distance(poses[before[-1]], poses[start])} at {rows.word} {where[start]}"
            jump = f"; the pose jumps {there}{back and ' and back' + back}"
        elif back:
            jump = f"; the pose jumps {_distance(poses[stop - 1], poses[after[0]])}{back}"
        note = f"{name_rows(rows.word, where[mine])} left out, as tracking was lost: {why}{jump}."
        rows.keep(~np.isin(rows.where, where[mine]), why, kind, note)
    if kept.sum() < _FEW and kept.sum() < _FEW_FRACTION * len(poses):
        notes = " ".join(rows.notes[-2:])
        raise RecordingError(f"{rows.path}: only {kept.sum()} of {len(poses)} poses are left; {notes}")
    return poses[kept]


def _repeated(poses: np.ndarray, before: np.ndarray) -> str:
    """Name the part of poses (N, 4, 4) that equals the previous poses."""
    same = np.isclose(poses, before, rtol=0, atol=1e-9)
    position, orientation = same[:, :3, 3].all(), same[:, :3, :3].all()
    return "pose" if position == orientation else "position" if position else "orientation"


def _distance(before: np.ndarray, after: np.ndarray) -> str:
    """Distance of two poses in words: a length, or an angle if the body hardly changes its position."""
    moved = float(np.linalg.norm(after[:3, 3] - before[:3, 3]))
    turned = float(angles_between(before[:3, :3], after[:3, :3]))
    if moved < _TURN * _SIZE * turned or moved == 0:
        size, unit = float(np.degrees(turned)), "deg"
    else:
        size, unit = (moved, "m") if moved >= 0.1 else (1e3 * moved, "mm")
    return f"{float(f'{size:.2g}'):g} {unit}"


def note_jumps(rows: Rows, poses: np.ndarray) -> None:
    """Add a note to ``rows`` if a few steps of poses (N, 4, 4), m, are much longer than all others."""
    if rows.times is None or len(poses) < 20:
        return
    spans = np.diff(rows.times)
    late = np.maximum(spans / np.median(spans), 1)
    moved = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turned = np.linalg.norm(np.diff(poses[:, :3, :3], axis=0), axis=(1, 2))
    jumps = np.zeros(len(late), bool)
    for steps in (moved / late, turned / late):
        ranked = np.sort(steps)[-_JUMPS - 1 :]
        apart = np.flatnonzero(ranked[1:] > _JUMP * ranked[:-1] + 1e-9)
        jumps |= steps > ranked[apart[0] if len(apart) else -1]
    waiting = (np.flatnonzero(jumps) + 1).tolist()
    if not 0 < len(waiting) <= _JUMPS:
        return
    sentences, all_return = [], True
    while waiting:
        here = waiting.pop(0)
        sentence = f"{_distance(poses[here - 1], poses[here])} at {rows.word} {rows.where[here]}"
        there = poses[here] - poses[here - 1]
        back = poses[waiting[0]] - poses[waiting[0] - 1] if waiting else there
        returns = np.linalg.norm(there + back) < 0.5 * np.linalg.norm(there)
        if returns:
            sentence += f" and back at {rows.word} {rows.where[waiting.pop(0)]}"
        all_return &= bool(returns)
        sentences.append(sentence)
    advice = "remove these rows" if all_return else "or a marker slipped, cut the recording there"
    rows.notes.append(f"the pose jumps {', '.join(sentences)}; if tracking was lost there, {advice}.")

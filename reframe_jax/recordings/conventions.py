"""Meaning of the numbers of an orientation: the order of a quaternion and the unit of angles.

A quaternion that is read in the wrong order is the inverse rotation, between two constant rotations. The
motion remains smooth and turns by the same angles, but the rotations do not fit the positions: a constrained
body has few independent velocities, and wrong orientations add more. The number of independent velocities
therefore shows the order, and distinguishes degrees from radians; for a free motion, it does not.
"""

from collections.abc import Set
from pathlib import Path

import numpy as np

from reframe_jax.geometry.numpy_rotations import angles_between, quaternions_to_matrices, rotation_vectors
from reframe_jax.recordings.recording import AngleTriples, RecordingError, Rows
from reframe_jax.recordings.selection import Selection, flag, unit_of

_FULL_TURN = 2 * np.pi * 1.001
_ROWS = 400  # largest number of rows that are compared
_TURN = 0.1  # rad between the two poses of a velocity: above the noise
_LEAP, _LEAPS = 0.5, 4.0  # rad, length of a jump, and over the longest step without jumps
_FEWEST = 12  # rows for a comparison of velocities
_FEWEST_TOUCHES = 8  # rows for a comparison of fixed points, which has six unknowns
_FLOOR = 1e-4  # mean square velocity that counts as zero, as a fraction of the total
_LITTLE = 0.05  # fraction of the mean square of positions that may remain for a fixed point
_CLEAR = 2.2  # difference of the summed logarithms of mean squares of the whole motion
_CLEAR_CONVENTION = 4.0  # as _CLEAR, for readings of angles, which turn the body by different angles
_REPEATED = 4.0  # as _CLEAR, with directions from one half and mean squares from the other half


def read_angles(
    path: Path, numbers: np.ndarray, wanted: Selection, stated: float | None, by_axis: bool
) -> AngleTriples:
    """Take rotation vectors or Euler angles (N, 3), and check their unit; ``stated`` is in rad, if any.

    Angles in radians that exceed a full turn are refused, unless this unit is stated or given.
    """
    vector = wanted.angles == "vector"
    unit = unit_of(path, wanted, "angle_unit", stated)
    if wanted.angle_unit is None and (stated is None or vector):
        sizes = unit * (np.linalg.norm(numbers, axis=1) if vector else np.abs(numbers))
        largest = np.max(sizes[np.isfinite(sizes)], initial=0.0)
        if largest > _FULL_TURN:
            what = "rotation vectors have a length of" if vector else "angles are"
            advice = "give angle_unit='deg' (--angle-unit deg), else angle_unit='rad' (--angle-unit rad)"
            raise RecordingError(
                f"{path}: its {what} up to {largest:.4g}, more than the 6.28 rad of a turn; if they are in "
                f"degrees, {advice if stated is None else 'correct the unit in the file'}."
            )
    return AngleTriples(numbers, unit, str(wanted.angles), by_axis, stated is not None)


def set_order(rows: Rows, wanted: Selection) -> None:
    """Read the quaternions of rows in the order that the user gave, if any."""
    if wanted.quaternion is None:
        return
    if rows.values.shape[1] != 7:
        raise RecordingError(f"{rows.path}: contains no quaternions; leave out {flag('quaternion')}.")
    turned = reorder(rows.values[:, 3:], rows.order, wanted.quaternion)
    rows.values, rows.order = np.hstack([rows.values[:, :3], turned]), wanted.quaternion


def reorder(quaternions: np.ndarray, stored: str, meant: str) -> np.ndarray:
    """Convert quaternions (N, 4) x y z w, read in the order ``stored``, to the order ``meant``."""
    if stored == meant:
        return quaternions
    return quaternions[:, [1, 2, 3, 0]] if meant == "wxyz" else quaternions[:, [3, 0, 1, 2]]


def check_order(rows: Rows, options: Set[str], poses: np.ndarray, unordered: bool, wanted: Selection) -> None:
    """Note that the motion is constrained or smooth only if the orientations are read in another way."""
    some = sample_rows(len(poses))
    positions, own = poses[some, :3, 3], poses[some, :3, :3]
    read, others = _other_readings(rows, options, own, some, wanted)
    for word, judge, least in (
        ("constrained", fits_better, 0.0 if rows.angles is None else _CLEAR_CONVENTION),
        ("constrained", keeps_a_point_better, 0.0) if unordered else ("smooth", _is_smoother, 0.0),
    ):
        found = [float(judge(positions, own, turned)) for _, _, turned in others]
        if max(found, default=0.0) > least:
            meant, remedy, _ = others[int(np.argmax(found))]
            rows.notes.append(f"{read}, but the motion is {word} only {meant}: check the {remedy}.")
            return


def _other_readings(
    rows: Rows, options: Set[str], own: np.ndarray, some: np.ndarray, wanted: Selection
) -> tuple[str, list[tuple[str, str, np.ndarray]]]:
    """Say how orientations are read, and list other readings: in words, remedy and matrices (M, 3, 3)."""
    if rows.angles is not None and wanted.angles is not None:
        angles, convention = rows.angles[some], wanted.angles
        others = ("xyz", "XYZ") if convention == "vector" else ("vector", convention.swapcase())
        return f"the angles are read in the convention {convention}", [
            (
                f"in the convention {other}",
                f"meaning of the angles; if so, give angles={other!r} (--angles {other})",
                angles.matrices(other),
            )
            for other in others
        ]
    if rows.values.shape[1] == 7 and "quaternion" in options:
        other = "wxyz" if rows.order == "xyzw" else "xyzw"
        numbers = reorder(rows.values[some, 3:], rows.order, other)
        turned = quaternions_to_matrices(numbers / np.linalg.norm(numbers, axis=1, keepdims=True))
        remedy = f"order in the file; if it is {other}, give quaternion={other!r} (--quaternion {other})"
        meant = f"in the order {other}"
        return f"the quaternions are read in the order {rows.order}", [(meant, remedy, turned)]
    if rows.values.shape[1] > 7 and rows.angles is None and "in_body" not in options:
        meant = "if they are read column by column"
        return "the matrices are read row by row", [(meant, "order in the file", own.swapaxes(1, 2))]
    return "", []


def sample_rows(count: int) -> np.ndarray:
    """Select 400 rows (M,) or fewer out of ``count``, evenly, for a comparison."""
    return np.linspace(0, count - 1, min(count, _ROWS)).astype(int)


def fits_better(positions: np.ndarray, own: np.ndarray, other: np.ndarray) -> float:
    """Return how much more the motion is constrained with the other orientations than with its own.

    The result is 0 if the difference may be chance, and a difference of summed logarithms otherwise.

    Short free motions have few independent velocities by chance. Therefore the constrained directions of each
    half of the motion must also be constrained in the other half. The positions (N, 3) are in any unit; the
    other rotations (N, 3, 3) are the same numbers in another order.
    """
    places = positions - positions.mean(axis=0)
    spread = np.sqrt(np.mean(np.sum(places**2, axis=1)))
    lag = _lag(own)
    if len(places) < _FEWEST or not spread > 0 or lag is None:
        return 0.0
    whole, halves = _freedom(places / spread, own, lag) - _freedom(places / spread, other, lag)
    whole /= 1 + _FEWEST / (len(places) - lag)
    return float(whole) if whole > _CLEAR and halves > _REPEATED else 0.0


def keeps_a_point_better(positions: np.ndarray, own: np.ndarray, other: np.ndarray) -> bool:
    """Return whether the body turns about a fixed point with other rotations, but not with its own.

    Unlike :func:`fits_better`, which has the same arguments, this function compares rotations with different
    angles, and needs no path.
    """
    if len(positions) < _FEWEST_TOUCHES or not np.ptp(positions, axis=0).any():
        return False
    places = positions - positions.mean(axis=0)
    missed = []
    for turned in (own, other):
        design = np.concatenate([turned, np.broadcast_to(-np.eye(3), turned.shape)], axis=2).reshape(-1, 6)
        fitted = design @ np.linalg.lstsq(design, places.ravel(), rcond=None)[0]
        missed.append(np.sum((places.ravel() - fitted) ** 2) / np.sum(places**2))
    return bool(missed[1] < _LITTLE and missed[1] < np.exp(-_CLEAR) * missed[0])


def _is_smoother(positions: np.ndarray, own: np.ndarray, other: np.ndarray) -> bool:
    """Return whether the body jumps with its own rotations, but not with the other ones.

    The arguments are those of :func:`fits_better`; the positions have no effect.
    """
    longest = [angles_between(turned[:-1], turned[1:]).max() for turned in (own, other)]
    return bool(longest[0] > max(_LEAP, _LEAPS * longest[1]))


def _lag(turned: np.ndarray) -> int | None:
    """Rows between the two poses of a velocity, so that most turn enough; None if the body hardly turns."""
    lag = 1
    while 2 * lag < len(turned):
        if np.quantile(angles_between(turned[:-lag], turned[lag:]), 0.75) > _TURN:
            return lag
        lag = lag + 1 + lag // 3
    return None


def _freedom(places: np.ndarray, turned: np.ndarray, lag: int) -> np.ndarray:
    """Sums of the logarithms of mean square velocities (2,): of the whole motion, and across its halves.

    Each sum is the smaller one of the velocities in the ground and in the body, because a constraint is
    constant in one of them.
    """
    before, after = turned[:-lag], turned[lag:]
    moved, middle = places[lag:] - places[:-lag], (places[lag:] + places[:-lag]) / 2
    spatial = rotation_vectors(after @ before.swapaxes(1, 2))
    body = rotation_vectors(before.swapaxes(1, 2) @ after)
    velocities = (
        np.hstack([spatial, moved + np.cross(middle, spatial)]),
        np.hstack([body, np.einsum("nji,nj->ni", (before + after) / 2, moved)]),
    )
    sums = []
    for each in velocities:
        one, other = np.array_split(each, 2)
        across = (_log_squares(one, other) + _log_squares(other, one)) / 2
        sums.append((_log_squares(each, each), across))
    return np.min(sums, axis=0)


def _log_squares(velocities: np.ndarray, others: np.ndarray) -> float:
    """Sum of the logarithms of the mean squares of other velocities along the principal directions."""
    directions = np.linalg.eigh(velocities.T @ velocities)[1]
    squares = np.sum((others @ directions) ** 2, axis=0)
    return float(np.sum(np.log(squares / squares.sum() + _FLOOR)))

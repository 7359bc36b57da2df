"""What the numbers of orientations mean: their order, their unit, and which of two readings fits the motion.

Read in another order, quaternions become their inverses between two constant rotations, so the motion is as
smooth as before and turns by the same angles. But it no longer fits the positions: a body that is constrained
moves with few independent velocities, and with more of them if its orientations are wrong. That distinguishes
the orders, and degrees from radians. A motion without a constraint does not.
"""

from pathlib import Path

import numpy as np

from reframe_jax.geometry.numpy_rotations import euler_matrices, rotation_matrices, rotation_vectors
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.selection import ANGLE_UNITS, Selection, flag

__all__ = ["angle_matrices", "fits_better", "keeps_a_point_better", "reorder", "sample_rows"]

_FULL_TURN = 2 * np.pi * 1.001
_ROWS = 400  # that are compared
_TURN = 0.1  # rad between two poses of a velocity, at least: more than noise
_FEWEST = 12  # rows; of so few, the difference must be twice as clear
_FLOOR = 1e-4  # part of the largest mean square velocity that counts as none
_LITTLE = 0.05  # part of the mean square of positions that is missed where a point is kept
_CLEAR = 2.2  # difference of the summed logarithms of mean squares; 0 for free motions


def angle_matrices(
    path: Path, angles: np.ndarray, wanted: Selection, stated: float | None = None
) -> np.ndarray:
    """Rotation matrices (N, 3, 3) of rotation vectors or Euler angles (N, 3).

    Args:
        path: the file.
        angles: in the order of the letters of the option ``angles``, or a rotation vector.
        wanted: what they mean, and their unit.
        stated: their unit in rad, if the file states it.

    Raises:
        RecordingError: if the unit is given twice, or not at all while angles exceed a turn in radians.
    """
    if stated is not None and wanted.angle_unit is not None:
        raise RecordingError(f"{path}: states the unit of its angles; leave out {flag('angle_unit')}.")
    vector = wanted.angles == "vector"
    if stated is None and wanted.angle_unit is None:
        sizes = np.linalg.norm(angles, axis=1) if vector else np.abs(angles)
        largest = np.max(sizes[np.isfinite(sizes)], initial=0.0)
        if largest > _FULL_TURN:
            what = "rotation vectors have a length of" if vector else "angles are"
            raise RecordingError(
                f"{path}: its {what} up to {largest:.4g}, more than the 6.28 rad of a turn; if they are in "
                "degrees, give angle_unit='deg' (--angle-unit deg), else angle_unit='rad' (--angle-unit rad)."
            )
    radians = angles * (stated or ANGLE_UNITS[wanted.angle_unit or "rad"])
    return rotation_matrices(radians) if vector else euler_matrices(str(wanted.angles), radians)


def reorder(quaternions: np.ndarray, stored: str, meant: str) -> np.ndarray:
    """Quaternions (N, 4), x y z w, of numbers that were read in the order ``stored`` and are ``meant``."""
    if stored == meant:
        return quaternions
    # the numbers as the file has them, then the other order
    return quaternions[:, [1, 2, 3, 0]] if meant == "wxyz" else quaternions[:, [3, 0, 1, 2]]


def sample_rows(count: int) -> np.ndarray:
    """Some of so many rows, (M,) int, for :func:`fits_better`."""
    return np.linspace(0, count - 1, min(count, _ROWS)).astype(int)


def fits_better(positions: np.ndarray, own: np.ndarray, other: np.ndarray) -> bool:
    """Whether the motion is constrained with other orientations, and not with its own.

    Args:
        positions: (N, 3).
        own: (N, 3, 3) rotations.
        other: (N, 3, 3) the same numbers in another order or unit.
    """
    places = positions - positions.mean(axis=0)
    spread = np.sqrt(np.mean(np.sum(places**2, axis=1)))
    lag = _lag(own)
    if len(places) < _FEWEST or not spread > 0 or lag is None:
        return False
    free, other_free = (_freedom(places / spread, turned, lag) for turned in (own, other))
    return free - other_free > _CLEAR * (1 + _FEWEST / (len(places) - lag))


def keeps_a_point_better(positions: np.ndarray, own: np.ndarray, other: np.ndarray) -> bool:
    """Whether the body turns about a point with other rotations, and about none with its own.

    Unlike :func:`fits_better`, whose arguments these are, this compares rotations of different sizes.
    """
    if len(positions) < _FEWEST or not np.ptp(positions, axis=0).any():
        return False
    places = positions - positions.mean(axis=0)
    missed = []
    for turned in (own, other):
        design = np.concatenate([turned, np.broadcast_to(-np.eye(3), turned.shape)], axis=2).reshape(-1, 6)
        fitted = design @ np.linalg.lstsq(design, places.ravel(), rcond=None)[0]
        missed.append(np.sum((places.ravel() - fitted) ** 2) / np.sum(places**2))
    return bool(missed[1] < _LITTLE and missed[1] < np.exp(-_CLEAR) * missed[0])


def _lag(turned: np.ndarray) -> int | None:
    """Rows between two poses of a velocity, so that most turn enough; None if the body hardly turns."""
    lag = 1
    while 2 * lag < len(turned):
        between = turned[lag:] @ turned[:-lag].swapaxes(1, 2)
        if np.quantile(np.linalg.norm(rotation_vectors(between), axis=1), 0.75) > _TURN:
            return lag
        lag = lag + 1 + lag // 3
    return None


def _freedom(places: np.ndarray, turned: np.ndarray, lag: int) -> float:
    """Sum of the logarithms of the principal mean squares of velocities, in the ground or in the body.

    The smaller one of both: a constraint is constant in one of them.
    """
    before, after = turned[:-lag], turned[lag:]
    moved, middle = places[lag:] - places[:-lag], (places[lag:] + places[:-lag]) / 2
    spatial = rotation_vectors(after @ before.swapaxes(1, 2))
    body = rotation_vectors(before.swapaxes(1, 2) @ after)
    sums = []
    half = (before + after) / 2  # close to the rotation halfway
    for velocities in (
        np.hstack([spatial, moved + np.cross(middle, spatial)]),
        np.hstack([body, np.einsum("nji,nj->ni", half, moved)]),
    ):
        squares = np.linalg.svd(velocities, compute_uv=False) ** 2
        sums.append(float(np.sum(np.log(squares / squares.sum() + _FLOOR))))
    return min(sums)

"""In which order a file holds the numbers of its quaternions, as the motion shows it: NumPy only.

Read in the wrong order, a rotation becomes its inverse between two constant rotations, so it is as smooth as
before and turns by the same angles. But it no longer fits the positions: a body that is constrained moves
with few independent velocities, and with more of them if its orientations are wrong. That distinguishes the
orders. A motion without a constraint does not.
"""

import numpy as np

from reframe_jax.geometry.numpy_rotations import quaternions_to_matrices, rotation_vectors

__all__ = ["reorder", "shows_other_order"]

_ROWS = 400  # that are compared
_TURN = 0.1  # rad between two poses of a velocity, at least: more than noise
_FEWEST = 12  # rows; of so few, the difference must be twice as clear
_FLOOR = 1e-4  # part of the largest mean square velocity that counts as none
_CLEAR = 2.2  # difference of the summed logarithms of mean squares; 0 for free motions


def reorder(quaternions: np.ndarray, stored: str, meant: str) -> np.ndarray:
    """Quaternions (N, 4), x y z w, of numbers that were read in the order ``stored`` and are ``meant``."""
    if stored == meant:
        return quaternions
    # the numbers as the file has them, then the other order
    return quaternions[:, [1, 2, 3, 0]] if meant == "wxyz" else quaternions[:, [3, 0, 1, 2]]


def shows_other_order(positions: np.ndarray, quaternions: np.ndarray, other: np.ndarray) -> bool:
    """Whether the motion is constrained with quaternions in the other order, and not in this one.

    Args:
        positions: (N, 3).
        quaternions: (N, 4) x y z w, of length 1.
        other: (N, 4) the same numbers in the other order.
    """
    rows = np.linspace(0, len(positions) - 1, min(len(positions), _ROWS)).astype(int)
    places = positions[rows] - positions[rows].mean(axis=0)
    spread = np.sqrt(np.mean(np.sum(places**2, axis=1)))
    if len(rows) < _FEWEST or not spread > 0:
        return False
    here, there = (quaternions_to_matrices(each[rows]) for each in (quaternions, other))
    lag = _lag(here)
    if lag is None:
        return False
    own, others = (_freedom(places / spread, turned, lag) for turned in (here, there))
    return own - others > _CLEAR * (1 + _FEWEST / (len(rows) - lag))


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

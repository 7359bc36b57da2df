"""Estimate the two axes of a universal joint, one fixed in each body, from rotations."""

import numpy as np

_STARTS = 8
_STEPS = 40


def universal_axes(rotations: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pair of axes (3,), one in each body, whose mutual angle varies least over the motion.

    A constraint frame has its constrained rotation axis fixed in one body. In a universal joint, the
    direction of the constrained rotation is perpendicular to both joint axes and fixed in neither body. This
    function therefore estimates the joint axes: for an axis a of the ground and an axis b of the body, a^T
    R(k) b is constant over the rotations (K, 3, 3). ``normal`` (3,) is the direction of the constrained
    rotation in the ground at the mean pose.
    """
    moved = rotations - rotations.mean(axis=0)
    across = np.linalg.svd(normal[None])[2][1:]
    best = np.inf, np.zeros(3), np.zeros(3)
    for angle in np.arange(_STARTS) * np.pi / _STARTS:
        first = np.cos(angle) * across[0] + np.sin(angle) * across[1]
        for _ in range(_STEPS):
            _, second = _least_projection_axis(np.einsum("i,kij->kj", first, moved))
            change, first = _least_projection_axis(moved @ second)
        if change < best[0]:
            best = change, first, second
    return best[1], best[2]


def _least_projection_axis(rows: np.ndarray) -> tuple[float, np.ndarray]:
    """The unit vector (3,) on which rows (K, 3) have the smallest projections, and their sum of squares."""
    values, vectors = np.linalg.eigh(rows.T @ rows)
    return float(values[0]), vectors[:, 0]

"""Three hinges in place of a ball, for robot descriptions that have no balls."""

from itertools import permutations

import numpy as np

from reframe_jax.geometry.numpy_rotations import rotation_matrices
from reframe_jax.joints.chain import JointPart

__all__ = ["ball_hinges"]

_LOCKED = np.radians(80.0)  # of the second hinge; at 90 degrees the first and the third are one


def ball_hinges(point: np.ndarray, vectors: np.ndarray) -> tuple[JointPart, ...]:
    """Return three hinges that turn as a ball did, perpendicular to each other where all are at zero.

    Their axes are those along which the rotations vary most and least, in the order that keeps the second
    hinge farthest from where it locks.

    Args:
        point: (3,) m, the centre.
        vectors: (K, 3) rad, coordinates of the ball.

    Returns:
        Three hinges with the range of the rotations, or none if they come near to locking.
    """
    turns = rotation_matrices(vectors)
    main = np.linalg.eigh(vectors.T @ vectors)[1].T
    bases = [main[list(order)] for order in permutations(range(3))]
    for basis in bases:
        basis[2] = np.cross(basis[0], basis[1])
    # how far the second hinge turns: the third axis leaves the plane across the first by that angle
    leaning = [np.abs(turns @ basis[2] @ basis[0]).max() for basis in bases]
    best = int(np.argmin(leaning))
    if leaning[best] > np.sin(_LOCKED):
        return ()
    basis = bases[best]
    turned = basis @ turns @ basis.T
    angles = (
        np.arctan2(-turned[:, 1, 2], turned[:, 2, 2]),
        np.arcsin(np.clip(turned[:, 0, 2], -1, 1)),
        np.arctan2(-turned[:, 0, 1], turned[:, 0, 0]),
    )
    return tuple(
        JointPart("hinge", axis, point, float(seen.min()), float(seen.max()))
        for axis, seen in zip(basis, map(np.unwrap, angles), strict=True)
    )

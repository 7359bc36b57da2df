"""Replace a ball joint by three hinges, for robot description formats without ball joints."""

from itertools import permutations

import numpy as np

from reframe_jax.geometry.numpy_rotations import rotation_matrices
from reframe_jax.joints.chain import JointPart

_LOCKED = np.radians(80.0)  # largest angle of the second hinge; at 90 degrees two axes coincide


def ball_hinges(point: np.ndarray, vectors: np.ndarray) -> tuple[JointPart, ...]:
    """Return three hinges that reproduce the rotation vectors (K, 3), rad, of a ball joint.

    The axes are perpendicular where all angles are zero. They are the principal axes of the recorded rotation
    vectors, in the order that keeps the second hinge farthest from gimbal lock. If the second hinge comes
    near gimbal lock, there are none.
    """
    turns = rotation_matrices(vectors)
    main = np.linalg.eigh(vectors.T @ vectors)[1].T
    bases = [main[list(order)] for order in permutations(range(3))]
    for basis in bases:
        basis[2] = np.cross(basis[0], basis[1])
    # angle of the second hinge: the third axis leaves the plane normal to the first by this angle
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

"""Rotations in NumPy, for code that does not use JAX, such as the readers of files.

All functions use double precision, independent of JAX's 64-bit setting, and cannot be traced or
differentiated. Use :mod:`reframe_jax.geometry.rotations` for code with JAX. Quaternions are (x, y, z, w).
"""

import numpy as np


def positive_axis(axis: np.ndarray) -> np.ndarray:
    """Return an axis (3,) with the sign that makes its largest component positive."""
    return axis * np.sign(axis[np.argmax(np.abs(axis))])


def skew_vectors(matrices: np.ndarray) -> np.ndarray:
    """Return the vectors w (..., 3) with [w]x = M - M^T, for matrices M (..., 3, 3)."""
    skew = matrices - matrices.swapaxes(-1, -2)
    return np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)


def quaternions_to_matrices(quaternions: np.ndarray) -> np.ndarray:
    """Convert unit quaternions (..., 4) to rotation matrices (..., 3, 3)."""
    cross = np.cross(quaternions[..., None, :3], np.eye(3)).swapaxes(-1, -2)
    return np.eye(3) + 2 * quaternions[..., 3, None, None] * cross + 2 * cross @ cross


def matrices_to_quaternions(matrices: np.ndarray) -> np.ndarray:
    """Convert rotation matrices (..., 3, 3) to unit quaternions (..., 4) with w >= 0.

    A quaternion q is an eigenvector of 4 q q^T, which is linear in the rotation matrix. Half turns therefore
    need no special case.
    """
    transposed = matrices.swapaxes(-1, -2)
    outer, trace = np.empty((*matrices.shape[:-2], 4, 4)), np.trace(matrices, axis1=-2, axis2=-1)
    outer[..., :3, :3] = matrices + transposed + (1 - trace)[..., None, None] * np.eye(3)
    outer[..., 3, :3] = outer[..., :3, 3] = skew_vectors(matrices)
    outer[..., 3, 3] = 1 + trace
    found = np.linalg.eigh(outer)[1][..., -1]
    return np.where(found[..., 3:] < 0, -found, found)


def nearest_rotations(matrices: np.ndarray) -> np.ndarray:
    """Return the rotations (..., 3, 3) nearest to matrices (..., 3, 3), by singular values."""
    left, _, right = np.linalg.svd(matrices)
    left[..., -1] *= np.linalg.det(left @ right)[..., None]  # no reflections
    return left @ right


def rotation_vectors(matrices: np.ndarray) -> np.ndarray:
    """Convert rotation matrices (..., 3, 3), including half turns, to rotation vectors (..., 3), rad."""
    quaternions = matrices_to_quaternions(matrices)
    sine = np.linalg.norm(quaternions[..., :3], axis=-1)
    factor = 2 * np.arctan2(sine, quaternions[..., 3]) / np.where(sine == 0, 1, sine)
    return factor[..., None] * quaternions[..., :3]


def angles_between(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the angles (...), rad, between rotations (..., 3, 3)."""
    chord = np.linalg.norm(after - before, axis=(-2, -1)) / np.sqrt(8)
    return 2 * np.arcsin(np.minimum(chord, 1))


def rotation_matrices(vectors: np.ndarray) -> np.ndarray:
    """Convert rotation vectors (..., 3), rad, to rotation matrices (..., 3, 3)."""
    angle = np.linalg.norm(vectors, axis=-1, keepdims=True)
    sine = 0.5 * np.sinc(angle / (2 * np.pi))  # sin(angle / 2) / angle, 1/2 at 0
    return quaternions_to_matrices(np.concatenate([sine * vectors, np.cos(angle / 2)], axis=-1))


def euler_matrices(order: str, angles: np.ndarray) -> np.ndarray:
    """Convert three Euler angles to rotation matrices (..., 3, 3).

    Args:
        order: three letters. "XYZ" means rotations about the moving axes, x first: Rx Ry Rz. "xyz" means
            rotations about the fixed axes, x first: Rz Ry Rx.
        angles: (..., 3) rad, in the order of the letters.
    """
    turns = [
        rotation_matrices(angles[..., i, None] * np.eye(3)["xyz".index(letter.lower())])
        for i, letter in enumerate(order)
    ]
    first, second, third = turns if order.isupper() else turns[::-1]
    return first @ second @ third

"""4x4 matrices of twists in NumPy, to compare the library with, and components of symmetric matrices."""

import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry.symmetric import INDEX_PAIRS
from reframe_jax.objectives.moments import velocity_moments


def hat(w):
    """[w], 3x3."""
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def bracket(twist):
    """[V], 4x4."""
    return np.block([[hat(twist[:3]), twist[3:, None]], [np.zeros((1, 4))]])


def unbracket(matrix):
    """The twist of [V]."""
    return np.array([matrix[2, 1], matrix[0, 2], matrix[1, 0], *matrix[:3, 3]])


def from_matrix(matrix):
    """Components of symmetric matrices (..., 3, 3), as the library stores them."""
    return tuple(matrix[..., i, j] for i, j in INDEX_PAIRS)


def moments_of_maps(maps):
    """Moments (6, 10, ...) of velocity maps (..., K, 3, 4), or (6, 1, ...) of (..., K, 3, 1)."""
    return velocity_moments(jnp.moveaxis(maps, (-2, -1, -3), (0, 1, 2)))

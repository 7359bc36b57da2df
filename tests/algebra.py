"""4x4 matrices of twists in NumPy, to compare the library with."""

import numpy as np


def hat(w):
    """[w], 3x3."""
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def bracket(twist):
    """[V], 4x4."""
    return np.block([[hat(twist[:3]), twist[3:, None]], [np.zeros((1, 4))]])


def unbracket(matrix):
    """The twist of [V]."""
    return np.array([matrix[2, 1], matrix[0, 2], matrix[1, 0], *matrix[:3, 3]])

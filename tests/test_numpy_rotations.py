"""Rotations in plain NumPy, against SciPy."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from reframe_jax.geometry.numpy_rotations import (
    euler_matrices,
    matrices_to_quaternions,
    nearest_rotations,
    quaternions_to_matrices,
    rotation_matrices,
    rotation_vectors,
)


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3), st.floats(0, np.pi))
def test_rotation_vectors(axis: list[float], angle: float) -> None:
    vector = np.array(axis) / max(float(np.linalg.norm(axis)), 1e-3) * min(angle, np.pi - 1e-6)
    matrices = Rotation.from_rotvec(vector).as_matrix()[None, None]
    np.testing.assert_allclose(rotation_vectors(matrices)[0, 0], vector, atol=1e-7)


@pytest.mark.parametrize("shape", [(), (1,), (3, 5)])
def test_quaternions_and_matrices(shape: tuple[int, ...], rng: np.random.Generator) -> None:
    reference = Rotation.random(int(np.prod(shape)), rng)
    matrices = reference.as_matrix().reshape(*shape, 3, 3)
    quaternions = reference.as_quat(canonical=True).reshape(*shape, 4)
    np.testing.assert_allclose(quaternions_to_matrices(quaternions), matrices, atol=1e-15)
    np.testing.assert_allclose(matrices_to_quaternions(matrices), quaternions, atol=1e-14)


@pytest.mark.parametrize("rotvec", [(0, 0, 0), (np.pi, 0, 0), (0, np.pi, 0), (0, 0, np.pi), (2.2, 2.2, 0)])
def test_half_turns(rotvec: tuple[float, float, float]) -> None:
    matrix = Rotation.from_rotvec(rotvec).as_matrix()
    np.testing.assert_allclose(quaternions_to_matrices(matrices_to_quaternions(matrix)), matrix, atol=1e-14)
    assert np.linalg.norm(rotation_vectors(matrix)) == pytest.approx(np.linalg.norm(rotvec), abs=1e-7)


def test_matrices_of_rotation_vectors(rng: np.random.Generator) -> None:
    vectors = np.concatenate([rng.normal(size=(20, 3)) * 3, np.zeros((1, 3)), np.full((1, 3), 1e-9)])
    np.testing.assert_allclose(
        rotation_matrices(vectors), Rotation.from_rotvec(vectors).as_matrix(), atol=1e-14
    )


@pytest.mark.parametrize("order", ["".join(letters) for letters in permutations("xyz")])
def test_turns_about_three_axes(order: str, rng: np.random.Generator) -> None:
    angles = rng.uniform(-3, 3, size=(10, 3))
    for name in (order, order.upper()):  # SciPy has the same convention: capitals for the moving axes
        expected = Rotation.from_euler(name, angles).as_matrix()
        np.testing.assert_allclose(euler_matrices(name, angles), expected, atol=1e-14)


def test_the_nearest_rotations_leave_rotations_and_undo_reflections_and_scales():
    rng = np.random.default_rng(0)
    turns = Rotation.random(20, rng).as_matrix()
    stretch = rng.uniform(0.5, 2, (20, 3, 1)) * np.eye(3)
    np.testing.assert_allclose(nearest_rotations(turns @ stretch), turns, atol=1e-12)
    found = nearest_rotations(turns * [1, 1, -0.1])
    np.testing.assert_allclose(found, turns, atol=1e-12)

"""Symmetric 3x3 matrices by components, against NumPy and 50-digit arithmetic."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from algebra import from_matrix
from hypothesis import given, settings
from hypothesis import strategies as st

from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.geometry.small import rotate, solve_positive
from reframe_jax.geometry.symmetric import INDEX_PAIRS, pivots, to_matrix


def orthogonal(rng, *shape):
    return np.linalg.qr(rng.normal(size=(*shape, 3, 3)))[0]


def symmetric(rng, *shape):
    m = rng.normal(size=(*shape, 3, 3))
    return (m + np.swapaxes(m, -1, -2)) / 2


def with_spectrum(rng, values, count=40):
    q = orthogonal(rng, count)
    m = (q * np.asarray(values)) @ np.swapaxes(q, -1, -2)
    return (m + np.swapaxes(m, -1, -2)) / 2


def test_components(rng):
    m = symmetric(rng, 4, 2)
    s = from_matrix(jnp.asarray(m))
    assert all(part.shape == (4, 2) for part in s)
    for part, (i, j) in zip(s, INDEX_PAIRS, strict=True):
        np.testing.assert_array_equal(part, m[..., i, j])
    np.testing.assert_array_equal(to_matrix(s), m)


def test_turning_is_the_exponential_to_second_order(rng):
    axes = rotation_exp(jnp.asarray(rng.normal(size=3)))
    for size in (1e-3, 2.0):
        d = size * rng.normal(size=3)
        turned = np.asarray(rotate(jnp.asarray(d), axes))
        np.testing.assert_allclose(turned.T @ turned, np.eye(3), atol=1e-14)
        exact = np.asarray(rotation_exp(jnp.asarray(d)) @ axes)
        assert np.max(np.abs(turned - exact)) < np.linalg.norm(d) ** 3


def test_solve_positive(rng):
    """Of one matrix with several right-hand sides."""
    root = rng.normal(size=(7, 7))
    matrix, right = root @ root.T + np.eye(7), rng.normal(size=(7, 3))
    found = jax.jit(solve_positive)(jnp.asarray(matrix)[..., None], jnp.asarray(right))
    np.testing.assert_allclose(found, np.linalg.solve(matrix, right), rtol=1e-10)


def determinant(s):
    return jnp.prod(jnp.stack(pivots(s)), axis=0)


def test_pivots(rng):
    m = with_spectrum(rng, (0.1, 0.5, 2.0))
    s = from_matrix(jnp.asarray(m))
    np.testing.assert_allclose(determinant(s), np.linalg.det(m), rtol=1e-13)
    factors = np.linalg.cholesky(m)
    diagonal = np.moveaxis(np.diagonal(factors, axis1=1, axis2=2), -1, 0)
    np.testing.assert_allclose(jnp.stack(pivots(s)), diagonal**2, rtol=1e-13)


@pytest.mark.parametrize(
    ("dtype", "small", "tolerance"), [(np.float64, 1e-10, 1e-4), (np.float32, 1e-4, 2e-2)]
)
def test_determinant_of_a_line(dtype, small, tolerance, rng):
    """One free axis and two constrained ones: the determinant is far below the rounding of its terms."""
    mp.mp.dps = 50
    matrices = with_spectrum(rng, (small, 2 * small, 1.0)).astype(dtype)
    exact = [float(mp.det(mp.matrix(m.astype(float).tolist()))) for m in matrices]
    found = determinant(from_matrix(jnp.asarray(matrices)))
    assert found.dtype == dtype
    np.testing.assert_allclose(found, exact, rtol=tolerance)


@settings(max_examples=60)
@given(st.lists(st.floats(-2, 2), min_size=3, max_size=3), st.integers(0, 2**31))
def test_signs_of_the_pivots(values, seed):
    """All positive exactly where the matrix is positive definite."""
    if min(abs(v) for v in values) < 1e-6:
        return
    m = with_spectrum(np.random.default_rng(seed), values, 1)[0]
    assert bool(smallest_pivot(m) > 0) == (min(values) > 0)


smallest_pivot = jax.jit(lambda m: jnp.min(jnp.stack(pivots(from_matrix(m)))))
determinant_of = jax.jit(lambda m: determinant(from_matrix(m)))


def test_singular_matrices():
    """A zero pivot is no division by zero, and leaves derivatives finite."""
    for m in (np.zeros((3, 3)), np.diag([0.0, 1.0, 1.0]), np.diag([1.0, 0.0, 1.0]), np.ones((3, 3))):
        assert determinant_of(m) == 0
        assert np.all(np.isfinite(jax.jit(jax.grad(determinant_of))(m)))

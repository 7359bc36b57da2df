"""Symmetric 3x3 matrices by components, against NumPy and 50-digit arithmetic."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from algebra import from_matrix
from hypothesis import given, settings
from hypothesis import strategies as st

from reframe_jax.geometry.small import count_independent, solve_positive
from reframe_jax.geometry.symmetric import (
    INDEX_PAIRS,
    eigh,
    pivots,
    to_matrix,
)


def orthogonal(rng, *shape):
    return np.linalg.qr(rng.normal(size=(*shape, 3, 3)))[0]


def symmetric(rng, *shape):
    m = rng.normal(size=(*shape, 3, 3))
    return (m + np.swapaxes(m, -1, -2)) / 2


def with_spectrum(rng, values, count=40):
    q = orthogonal(rng, count)
    m = (q * np.asarray(values)) @ np.swapaxes(q, -1, -2)
    return (m + np.swapaxes(m, -1, -2)) / 2


@jax.jit
def decompose(matrix):
    values, vectors = eigh(from_matrix(matrix))
    columns = [jnp.stack(vector, axis=-1) for vector in vectors]
    return jnp.stack(values, axis=-1), jnp.stack(columns, axis=-1)


def check(matrices, dtype=np.float64, tolerance=8):
    """Eigenvalues against NumPy, and orthonormal vectors that diagonalise; errors over the norm."""
    matrices = matrices.astype(dtype)
    values, vectors = (np.asarray(x, dtype=np.float64) for x in decompose(jnp.asarray(matrices)))
    exact = matrices.astype(np.float64)
    scale = np.max(np.abs(exact), axis=(-2, -1), initial=1e-300)[..., None]
    if jax.default_backend() != "cpu" and dtype == np.float32:
        tolerance *= 3  # square roots of GPUs are not rounded correctly
    error = tolerance * np.finfo(dtype).eps
    np.testing.assert_allclose(np.sort(values) / scale, np.linalg.eigvalsh(exact) / scale, atol=error)
    transposed = np.swapaxes(vectors, -1, -2)
    np.testing.assert_allclose(transposed @ vectors, np.broadcast_to(np.eye(3), vectors.shape), atol=error)
    residual = (exact @ vectors - vectors * values[..., None, :]) / scale[..., None]
    np.testing.assert_allclose(residual, 0, atol=error)


class TestEigh:
    @pytest.mark.parametrize("dtype", [np.float64, np.float32])
    def test_random(self, dtype, rng):
        check(symmetric(rng, 500), dtype)

    @pytest.mark.parametrize("dtype", [np.float64, np.float32])
    @pytest.mark.parametrize(
        "values", [(1e-10, 1e-10, 1), (1e-10, 1e-5, 1), (1e-5, 1, 1), (1, 1, 1), (-1, 0, 1), (0, 0, 1)]
    )
    def test_graded_and_degenerate(self, values, dtype, rng):
        check(with_spectrum(rng, values), dtype)

    @pytest.mark.parametrize("dtype", [np.float64, np.float32])
    def test_special(self, dtype):
        """Zero, diagonal in any order, one plane only, all ones, and far from 1 in size."""
        special = np.array(
            [
                np.zeros((3, 3)),
                np.eye(3),
                np.diag([3.0, 1.0, 2.0]),
                np.diag([2.0, 2.0, -1.0]),
                [[1, 1, 0], [1, 1, 0], [0, 0, 1]],
                [[0, 0, 1], [0, 0, 0], [1, 0, 0]],
                np.ones((3, 3)),
                np.ones((3, 3)) + np.eye(3),
            ]
        )
        for size in (1, 1e-25, 1e25):
            check(size * special, dtype)

    @pytest.mark.parametrize("dtype", [np.float64, np.float32])
    def test_tiny_coupling(self, dtype):
        """Off-diagonal entries whose squares vanish, beside equal diagonal ones."""
        tiny = np.sqrt(np.finfo(dtype).tiny) / 16
        matrix = np.array([[1, tiny, 0], [tiny, 1, tiny], [0, tiny, 2]], dtype=dtype)
        for m in (matrix, matrix * dtype(tiny)):
            check(m[None], dtype)

    def test_small_eigenvalues_keep_their_digits(self, rng):
        """Of a scaled well-conditioned matrix each is accurate relative to itself, not to the largest."""
        mp.mp.dps = 50
        for _ in range(10):
            d = 10.0 ** np.array([0, -4, -8])[rng.permutation(3)]
            m = d[:, None] * (np.eye(3) + 0.3 * np.clip(symmetric(rng), -1, 1)) * d
            m = (m + m.T) / 2
            exact = np.sort([float(x) for x in mp.eigsy(mp.matrix(m.tolist()), eigvals_only=True)])
            values, _ = decompose(jnp.asarray(m))
            np.testing.assert_allclose(np.sort(values), exact, rtol=1e-14)

    def test_derivative(self, rng):
        """Of values and vectors, against central differences."""
        for values in ((1.0, 2.0, 4.0), (1e-3, 0.1, 1.0)):
            m, dm = with_spectrum(rng, values, 1)[0], symmetric(rng)
            h = 1e-5 * values[0]
            _, rates = jax.jvp(decompose, (jnp.asarray(m),), (jnp.asarray(dm),))
            up, down = decompose(m + h * dm), decompose(m - h * dm)
            for rate, plus, minus in zip(rates, up, down, strict=True):
                difference = (np.asarray(plus) - np.asarray(minus)) / (2 * h)
                np.testing.assert_allclose(rate, difference, rtol=1e-5, atol=1e-6)

    def test_reverse_and_second_derivatives(self, rng):
        """log det through the eigenvalues: gradient the inverse, Hessian what calculus says."""
        m, a, b = with_spectrum(rng, (0.1, 0.5, 2.0), 1)[0], symmetric(rng), symmetric(rng)

        def log_det(m):
            return jnp.sum(jnp.log(decompose(m)[0]))

        inverse = np.linalg.inv(m)
        _, rate = jax.jit(lambda m: jax.jvp(log_det, (m,), (jnp.asarray(a),)))(m)
        assert rate == pytest.approx(np.trace(inverse @ a), rel=1e-12)
        along = jax.jit(lambda t: log_det(m + t[0] * a + t[1] * b))
        second = jax.jit(jax.hessian(along))(jnp.zeros(2))
        assert second[0, 1] == pytest.approx(-np.trace(inverse @ a @ inverse @ b), rel=1e-11)
        slope = jax.jit(jax.grad(along))(jnp.zeros(2))
        np.testing.assert_allclose(slope, [np.trace(inverse @ a), np.trace(inverse @ b)], rtol=1e-12)

    def test_derivative_at_equal_eigenvalues_is_finite(self, rng):
        dm = symmetric(rng, 3)
        m = np.array([np.zeros((3, 3)), np.eye(3), np.diag([1.0, 1.0, 2.0])])
        _, (values, vectors) = jax.jvp(decompose, (jnp.asarray(m),), (jnp.asarray(dm),))
        assert np.all(np.isfinite(values))
        assert np.all(np.isfinite(vectors))
        np.testing.assert_allclose(np.sum(values, axis=-1), np.trace(dm, axis1=1, axis2=2), atol=1e-14)

    def test_a_bad_matrix_spoils_no_other(self, rng):
        m = symmetric(rng, 5)
        spoilt = m.copy()
        spoilt[2, 0, 1] = spoilt[2, 1, 0] = np.nan
        for good, bad in zip(decompose(m), decompose(spoilt), strict=True):
            np.testing.assert_array_equal(np.delete(good, 2, axis=0), np.delete(bad, 2, axis=0))
            assert np.any(np.isnan(bad[2]))


def test_components(rng):
    m = symmetric(rng, 4, 2)
    s = from_matrix(jnp.asarray(m))
    assert all(part.shape == (4, 2) for part in s)
    for part, (i, j) in zip(s, INDEX_PAIRS, strict=True):
        np.testing.assert_array_equal(part, m[..., i, j])
    np.testing.assert_array_equal(to_matrix(s), m)


def test_solve_positive(rng):
    """Of one matrix with several right-hand sides."""
    root = rng.normal(size=(7, 7))
    matrix, right = root @ root.T + np.eye(7), rng.normal(size=(7, 3))
    found = jax.jit(solve_positive)(jnp.asarray(matrix)[..., None], jnp.asarray(right))
    np.testing.assert_allclose(found, np.linalg.solve(matrix, right), rtol=1e-10)


def determinant(s):
    return jnp.prod(jnp.stack(pivots(s)), axis=0)


def test_independent_variables_are_counted(rng):
    """Variables of covariances with ranks from 0 to 6, and with variances below the limit."""
    factors = [rng.normal(size=(6, rank)) for rank in range(7)]
    covariances = np.stack([factor @ factor.T for factor in factors], axis=-1)
    found = count_independent(jnp.asarray(covariances), jnp.full((6, 7), 1e-9))
    np.testing.assert_array_equal(found, np.arange(7))
    sizes = np.diag([4.0, 1.0, 1e-3, 1e-5, 2.0, 0.0])
    assert count_independent(jnp.asarray(sizes), jnp.full(6, 1e-4)) == 4
    opposite = np.array([[1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, 0.5]])  # equal variances
    assert count_independent(jnp.asarray(opposite), jnp.full(3, 1e-4)) == 2
    assert count_independent(jnp.asarray(sizes), jnp.asarray([1e-4, 1e-4, 1e-2, 1e-4, 1e-4, 1e-4])) == 3


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

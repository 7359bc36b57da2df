"""The compression of a window: Sigma(p) from 60 numbers is the mean of u u^T over its samples."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from algebra import moments_of_maps
from hypothesis import given, settings
from hypothesis import strategies as st

from reframe_jax.geometry.symmetric import INDEX_PAIRS, to_matrix
from reframe_jax.objectives.moments import MONOMIALS, covariance_at

moments_of = jax.jit(moments_of_maps)


@jax.jit
def covariance(maps, position):
    """(..., 3, 3) at positions (..., 3)."""
    return covariance_from(moments_of_maps(maps), position)


@jax.jit
def covariance_from(moments, position):
    """(..., 3, 3) from moments of velocities, at positions (..., 3)."""
    return to_matrix(covariance_at(moments, tuple(jnp.moveaxis(position, -1, 0))))


def direct(maps, position):
    """The same by its definition."""
    u = maps[..., 0] + np.einsum("...kij,...j->...ki", maps[..., 1:], position)
    return np.einsum("...ki,...kj->...ij", u, u) / u.shape[-2]


def scale_of(maps, position):
    """Size of the terms that are summed, which is what rounding is relative to."""
    extended = np.concatenate([np.ones((*position.shape[:-1], 1)), np.abs(position)], axis=-1)
    return np.max(np.sum(np.max(np.abs(maps), axis=-3) * extended[..., None, :], axis=-1)) ** 2


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_covariance_is_the_mean_over_samples(dtype, rng):
    maps = rng.normal(size=(4, 2, 30, 3, 4)).astype(dtype)
    position = rng.uniform(-1, 1, size=(4, 2, 3)).astype(dtype)
    found = covariance(jnp.asarray(maps), jnp.asarray(position))
    assert found.dtype == dtype
    expected = direct(maps.astype(float), position.astype(float))
    tolerance = 4 * np.finfo(dtype).eps * scale_of(maps, position)
    np.testing.assert_allclose(found, expected, atol=tolerance)


@settings(max_examples=60)
@given(
    st.integers(0, 2**31),
    st.lists(st.floats(-3, 3), min_size=3, max_size=3),
    st.sampled_from([1e-4, 1.0, 1e3]),
)
def test_covariance_of_any_map_at_any_position(seed, position, size):
    rng = np.random.default_rng(seed)
    maps = size * rng.normal(size=(6, 3, 4)) * 10.0 ** rng.uniform(-3, 0, size=(3, 4))
    position = np.array(position)
    tolerance = 8 * np.finfo(float).eps * scale_of(maps, position)
    np.testing.assert_allclose(covariance(maps, position), direct(maps, position), atol=tolerance)


def test_shapes(rng):
    """Coefficients first, problems last; velocities without a position have one coefficient."""
    maps = rng.normal(size=(5, 4, 9, 3, 4))
    moments = np.asarray(moments_of(maps))
    assert moments.shape == (6, 10, 5, 4)
    np.testing.assert_allclose(moments[..., 3, 2], moments_of(maps[3, 2]), atol=1e-15)
    assert moments_of(maps[0, 0]).shape == (6, 10)
    rates = moments_of(maps[..., :1])
    assert rates.shape == (6, 1, 5, 4)
    rates = np.asarray(rates)
    np.testing.assert_allclose(rates[:, 0], moments[:, 0], atol=1e-15)
    anywhere = jax.jit(covariance_at)(rates, (7.0,) * 3)
    np.testing.assert_allclose(np.stack(anywhere), rates[:, 0])


def test_polynomial_layout(rng):
    """Component by monomial, as INDEX_PAIRS and MONOMIALS say."""
    maps = rng.normal(size=(7, 3, 4))
    moments = np.asarray(moments_of(maps))
    for row, (i, j) in zip(moments, INDEX_PAIRS, strict=True):
        for coefficient, (a, b) in zip(row, MONOMIALS, strict=True):
            product = maps[:, i, a] * maps[:, j, b]
            if a != b:
                product = product + maps[:, i, b] * maps[:, j, a]
            assert coefficient == pytest.approx(np.mean(product), abs=1e-14)

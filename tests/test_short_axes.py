"""Reductions written out are those of JAX, and leave nothing to be allocated."""

import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from reframe_jax.arrays import jnp as ours
from reframe_jax.compilation import with_kernels
from reframe_jax.short_axes import ShortAxes

SHORT = ShortAxes()
NUMBERS = np.random.default_rng(3).normal(size=(3, 2, 4, 5)).round(1)  # with ties


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("axis", [0, -1, (0, 1), (2, -1), None])
@pytest.mark.parametrize("keepdims", [False, True])
@pytest.mark.parametrize("name", ["sum", "mean", "max", "min"])
def test_numbers(name: str, keepdims: bool, axis: Any, dtype: np.dtype) -> None:
    x = jnp.asarray(NUMBERS, dtype)
    found = getattr(SHORT, name)(x, axis=axis, keepdims=keepdims)
    expected = getattr(jnp, name)(x, axis=axis, keepdims=keepdims)
    assert (found.shape, found.dtype) == (expected.shape, expected.dtype)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("axis", [0, 2, (0, 1), None])
@pytest.mark.parametrize("name", ["any", "all", "max", "sum"])
def test_truth_and_whole_numbers(name: str, axis: Any) -> None:
    for x in (NUMBERS > 0, NUMBERS > -9, NUMBERS > 9, (10 * NUMBERS).astype(np.int32)):
        found, expected = getattr(SHORT, name)(x, axis=axis), getattr(jnp, name)(x, axis=axis)
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected)
    for dtype in (jnp.float32, jnp.int32):
        for axis in (0, None):  # short and long
            counted = SHORT.sum(jnp.asarray(NUMBERS > 0), axis=axis, dtype=dtype)
            assert counted.dtype == dtype
            np.testing.assert_array_equal(counted, np.sum(NUMBERS > 0, axis=axis))


@pytest.mark.parametrize("name", ["argmax", "argmin"])
def test_places_are_the_first_of_the_best_or_of_nan(name: str) -> None:
    x = NUMBERS.copy()
    x[0, 0, 1], x[1, 1, :, 2:4], x[2, 0, 0] = np.nan, np.nan, np.inf
    for axis in (0, 1, -1, None):
        for values in (x, (x > 0).astype(np.int32)):
            found, expected = getattr(SHORT, name)(values, axis=axis), getattr(jnp, name)(values, axis=axis)
            assert found.dtype == expected.dtype
            np.testing.assert_array_equal(found, expected)


def test_nan_and_nothing_come_through() -> None:
    assert np.isnan(SHORT.max(jnp.asarray([1.0, np.nan, 2.0]), axis=0))
    assert SHORT.sum(jnp.zeros((0, 3)), axis=0).shape == (3,)
    assert SHORT.sum(jnp.float64(2.0)) == 2.0


def test_only_our_programs_write_them_out() -> None:
    def total(x: jax.Array) -> jax.Array:
        return ours.sum(x, axis=0)

    def reductions(function: Any, length: int) -> int:
        text = jax.jit(function).lower(jnp.ones((length, 5))).as_text()
        return len(re.findall(r"stablehlo\.reduce\b", text))

    assert reductions(total, 3) == 1
    assert reductions(with_kernels(total), 3) == 0
    assert reductions(with_kernels(total), 300) == 1
    gradient = jax.grad(lambda x: jnp.sum(total(x) ** 2))(jnp.ones((3, 5)))
    np.testing.assert_array_equal(gradient, 6.0)

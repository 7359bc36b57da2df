"""Eqs. 6-8: power means and norms against their definitions, and the elimination of the rotation."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from algebra import from_matrix, moments_of_maps
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.geometry.symmetric import to_matrix
from reframe_jax.objectives.norms import check_exponent, log_power_mean
from reframe_jax.objectives.velocity import FrameObjective, PositionObjective

EXPONENTS = (-math.inf, -3.0, -1.0, -1e-6, 0.0, 1e-6, 0.5, 1.0, 2.0)
SOME_EXPONENTS = (-math.inf, -3.0, 0.0, 1e-6, 2.0)  # where each takes long to compile

# one program each, instead of one for every operation
moments_of, turned = jax.jit(moments_of_maps), jax.jit(rotation_exp)
value_of = jax.jit(lambda objective, x: objective.value(x))
covariance_of = jax.jit(lambda objective, x: to_matrix(objective.covariance(x)))


def by_definition(values, exponent):
    if exponent == -math.inf:
        return np.min(values, axis=-1)
    if exponent == 0:
        return np.exp(np.mean(np.log(values), axis=-1))
    # around the first value, so that it is right for exponents near zero too
    ratios = np.log(values) - np.log(values[..., :1])
    return values[..., 0] * np.exp(np.log1p(np.mean(np.expm1(exponent * ratios), axis=-1)) / exponent)


def power_mean(values, exponent):
    """Of (..., 3), as the logarithm that the library computes."""
    return jnp.exp(log_power_mean(jnp.log(jnp.moveaxis(values, -1, 0)), exponent))


def norm_at(rotvec, position, maps, exponent):
    """Eqs. 7 and 8: the RMS along column n of the orientation, at the origin p, over the samples."""
    axes, norms = np.asarray(turned(rotvec)), []
    for w in range(len(maps)):
        velocities = [m if position is None else m[:, 0] + m[:, 1:] @ position[w] for m in maps[w]]
        norms.append(np.sqrt(np.mean(np.square(np.array(velocities) @ axes[w]), axis=0)))
    return by_definition(np.array(norms), exponent)


class TestPowerMean:
    @pytest.mark.parametrize("exponent", EXPONENTS)
    def test_definition(self, exponent, rng):
        values = rng.uniform(0.1, 3, size=(40, 3))
        found = power_mean(jnp.asarray(values), exponent)
        # log1p of XLA is good to 120 roundings
        np.testing.assert_allclose(found, by_definition(values, exponent), rtol=4e-14)
        if abs(exponent) >= 0.5 and math.isfinite(exponent):
            plain = np.mean(values**exponent, axis=-1) ** (1 / exponent)
            np.testing.assert_allclose(found, plain, rtol=1e-13)

    @pytest.mark.parametrize("exponent", SOME_EXPONENTS)
    def test_leading_axes_scaling_and_order(self, exponent, rng):
        values = rng.uniform(0.1, 3, size=(2, 5, 3))
        found = np.asarray(power_mean(jnp.asarray(values), exponent))
        assert found.shape == (2, 5)
        np.testing.assert_allclose(power_mean(jnp.asarray(7 * values), exponent), 7 * found, rtol=1e-14)
        turned = power_mean(jnp.asarray(values[..., ::-1].copy()), exponent)
        np.testing.assert_allclose(turned, found, rtol=1e-14)
        same = power_mean(jnp.full((3,), 0.7), exponent)
        assert same == pytest.approx(0.7, rel=1e-15)

    def test_rises_with_the_exponent_and_is_continuous_at_zero(self, rng):
        values = jnp.asarray(10 ** rng.uniform(-6, 0, size=(40, 3)))
        means = np.stack([power_mean(values, p) for p in EXPONENTS])
        assert np.all(np.diff(means, axis=0) > 0)
        for tiny in (1e-300, 1e-12, 1e-8):
            for sign in (1, -1):
                np.testing.assert_allclose(power_mean(values, sign * tiny), means[4], rtol=20 * tiny + 1e-14)

    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    @pytest.mark.parametrize("exponent", SOME_EXPONENTS)
    def test_extreme_values(self, exponent, dtype):
        """Nothing overflows on the way, in either precision."""
        values = np.array([[1e-30, 1e-30, 1e30], [1e-30, 1e30, 1e30], [1e-30, 2e-30, 3e-30]], dtype=dtype)
        found = power_mean(jnp.asarray(values), exponent)
        assert found.dtype == dtype
        expected = by_definition(values.astype(float), exponent)
        # the logarithms of such numbers are of size 70, and exp of them turns rounding into 70 roundings
        np.testing.assert_allclose(found, expected, rtol=200 * np.finfo(dtype).eps)

    @pytest.mark.parametrize("exponent", EXPONENTS)
    def test_gradients(self, exponent, rng):
        """dM/dv_n = (v_n / M)^(p - 1) / 3, and for the minimum 1 at the smallest."""
        values = rng.uniform(0.5, 2, size=(20, 3))
        slopes = jax.jit(jax.grad(lambda v: jnp.sum(power_mean(v, exponent))))(values)
        if exponent == -math.inf:
            expected = (values == values.min(axis=-1, keepdims=True)).astype(float)
        else:
            expected = (values / by_definition(values, exponent)[:, None]) ** (exponent - 1) / 3
        np.testing.assert_allclose(slopes, expected, rtol=1e-12)

    @pytest.mark.parametrize("exponent", [2.1, math.inf, math.nan])
    def test_exponents_that_are_no_use(self, exponent):
        with pytest.raises(ValueError, match=r"must lie in \[-inf, 2\]"):
            check_exponent(exponent)
        with pytest.raises(ValueError, match="must lie in"):
            power_mean(jnp.ones(3), exponent)

    @pytest.mark.parametrize("exponent", [True, 1j, np.complex128(1), np.timedelta64(1, "s"), "0", None])
    def test_exponents_that_are_no_numbers(self, exponent):
        with pytest.raises(ValueError, match="must be a plain number"):
            check_exponent(exponent)

    def test_exponents_too_large_for_a_float(self):
        with pytest.raises(ValueError, match="must lie in"):
            check_exponent(10**400)

    def test_exponents_that_are(self):
        for exponent in (*EXPONENTS, 1, np.float32(0.5)):
            assert isinstance(check_exponent(exponent), float)


class TestObjectives:
    @pytest.mark.parametrize("exponent", SOME_EXPONENTS)
    def test_value_is_the_logarithm_of_the_norm(self, exponent, rng):
        maps = rng.normal(size=(4, 20, 3, 4))
        x = rng.normal(size=(6, 4))
        objective = FrameObjective(moments_of(maps), exponent)
        norm = norm_at(x[:3].T, x[3:].T, maps, exponent)
        assert objective.dim == 6
        np.testing.assert_allclose(value_of(objective, x), np.log(norm), atol=1e-12)
        rates = FrameObjective(moments_of(maps[..., :1]), exponent)
        norm = norm_at(x[:3].T, None, maps[..., 0], exponent)
        assert rates.dim == 3
        np.testing.assert_allclose(value_of(rates, x[:3]), np.log(norm), atol=1e-12)

    @pytest.mark.parametrize("exponent", SOME_EXPONENTS)
    def test_eliminating_the_rotation(self, exponent, rng):
        """The value at an origin is that of the frame along the eigenvectors there."""
        maps = rng.normal(size=(20, 3, 4))
        moments = moments_of(maps)
        position = rng.normal(size=3)
        objective = PositionObjective(moments, exponent)
        covariance = np.asarray(covariance_of(objective, position))
        rms = np.sqrt(np.linalg.eigvalsh(covariance))
        expected = np.log(by_definition(rms[None], exponent)[0])
        assert value_of(objective, position) == pytest.approx(expected, abs=1e-13)
        if exponent == 0:
            assert expected == pytest.approx(np.log(np.linalg.det(covariance)) / 6, abs=1e-12)
        assert value_of(PositionObjective(moments_of(maps[..., :1]), exponent), position) < np.inf

    @pytest.mark.parametrize(
        ("kind", "exponent"), [(FrameObjective, -1.0), (PositionObjective, -1.0), (PositionObjective, 0.0)]
    )
    def test_derivatives(self, kind, exponent, rng):
        """Gradient and Hessian, which the local minimisers step on."""
        objective = kind(moments_of(rng.normal(size=(20, 3, 4))), exponent)
        x = rng.normal(size=objective.dim)
        step = 1e-5
        around = x + step * np.concatenate([np.eye(x.size), -np.eye(x.size), np.zeros((1, x.size))])
        values, slopes = (
            np.asarray(y) for y in jax.jit(jax.vmap(jax.value_and_grad(objective.value)))(around)
        )
        number = x.size
        np.testing.assert_allclose(slopes[-1], (values[:number] - values[number:-1]) / (2 * step), atol=1e-9)
        second = (slopes[:number] - slopes[number:-1]) / (2 * step)
        np.testing.assert_allclose(jax.jit(jax.hessian(objective.value))(x), second, atol=1e-8)

    @pytest.mark.parametrize("exponent", [-1.0, 0.0, 1.0])
    def test_not_positive_definite_counts_as_infinite(self, exponent):
        """Rounding may leave a negative variance, or two whose product is positive; the slope is 0."""
        moments = np.stack(jax.jit(jax.vmap(lambda d: from_matrix(jnp.diag(d))))(np.asarray(NEGATIVE)))
        objective = PositionObjective(jnp.asarray(moments[:, None]), exponent)
        x = np.zeros((3, len(NEGATIVE)))
        np.testing.assert_array_equal(value_of(objective, x), np.inf)
        np.testing.assert_array_equal(jax.jit(jax.grad(lambda x: jnp.sum(objective.value(x))))(x), 0)

    def test_single_precision_of_a_slow_window(self):
        """The determinant of small variances underflows in float32; its logarithm must not."""
        moments = 1e-14 * jnp.asarray([1, 0, 0, 2, 0, 3], dtype=jnp.float32)[:, None]
        value = PositionObjective(moments).value(jnp.zeros(3, dtype=jnp.float32))
        assert value == pytest.approx(np.log(6e-42) / 6, rel=1e-6)

    def test_objectives_are_pytrees(self, rng):
        moments = moments_of(rng.normal(size=(3, 20, 3, 4)))
        for kind in (FrameObjective, PositionObjective):
            objective = kind(moments, 1.0)
            assert [leaf.shape for leaf in jax.tree.leaves(objective)] == [(6, 10, 3)]
            one = jax.tree.map(lambda leaf: leaf[..., 1], objective)
            assert one.exponent == 1.0
            x = rng.normal(size=(objective.dim, 3))
            np.testing.assert_allclose(value_of(one, x[:, 1]), value_of(objective, x)[1], rtol=1e-12)


NEGATIVE = ([-1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [1.0, 1.0, -1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 0.0])


def exponents():
    return st.one_of(st.sampled_from(EXPONENTS), st.floats(-20, 2))


@settings(max_examples=200)
@given(
    st.integers(0, 2**31),
    st.lists(st.floats(-4, 0), min_size=3, max_size=3),
    st.lists(st.floats(-np.pi, np.pi), min_size=3, max_size=3),
    exponents(),
)
def test_no_rotation_beats_the_eigenvectors(seed, powers, rotvec, exponent):
    """For every power mean of exponent at most 2 (the claim on which PositionObjective rests)."""
    q = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    variances = 100.0 ** np.array(powers)
    covariance = (q * variances) @ q.T
    best = by_definition(np.sqrt(variances)[None], exponent)[0]
    axes = Rotation.from_rotvec(rotvec).as_matrix()
    rms = np.sqrt(np.maximum(np.sum(axes * (covariance @ axes), axis=0), 0))
    # variances below the rounding of the largest are not known to any digit
    slack = 1 + 1e-14 * variances.max() / variances.min()
    assert by_definition(rms[None], exponent)[0] * slack >= best

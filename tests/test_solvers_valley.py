"""Local steps of origins: closed derivatives, descent, and the optimum they reach."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from planted_problems import (
    KEY,
    NOISE,
    ORIGINS,
    POSITIONS,
    VALLEY,
    compiled,
    four_moments,
    planted,
    search_positions,
)

from reframe_jax.geometry.symmetric import to_matrix
from reframe_jax.objectives.moments import covariance_at, velocity_moments
from reframe_jax.objectives.norms import log_power_mean
from reframe_jax.objectives.velocity import PositionObjective
from reframe_jax.solvers import Box, ValleySteps
from reframe_jax.solvers.valley_steps import _expand


@pytest.fixture(scope="module")
def moments():
    """Of four problems, (6, 10, 4)."""
    return four_moments()


class TestValley:
    @pytest.mark.parametrize("exponent", [0.0, 0.5, 1.0, 2.0, -1.0, -np.inf])
    def test_derivatives(self, moments, exponent):
        """Gradient and Hessian of 6 log J are those of autodiff; the majorant is f's tangent in Sigma."""
        p = jnp.asarray([0.2, -0.1, 0.4])
        m = moments[..., 0]

        def f(p):
            return 6 * PositionObjective(m, exponent).value(p)

        found = compiled(_expand, static_argnums=2)(m, tuple(p), exponent)
        hessian = compiled(jax.hessian(f))(p)
        scale = np.max(np.abs(hessian))
        np.testing.assert_allclose(jnp.stack(found.gradient), compiled(jax.grad(f))(p), rtol=1e-10)
        np.testing.assert_allclose(to_matrix(found.hessian), hessian, rtol=0, atol=1e-9 * scale)

        def mean_of(sigma):
            log_rms = jnp.log(jnp.linalg.eigvalsh(sigma)) / 2
            return 6 * log_power_mean(log_rms, exponent)

        tangent = compiled(jax.grad(mean_of))(to_matrix(covariance_at(m, tuple(p))))

        def bound(q):
            return jnp.sum(tangent * to_matrix(covariance_at(m, tuple(q))))

        np.testing.assert_allclose(
            to_matrix(found.majorant), compiled(jax.hessian(bound))(p), rtol=0, atol=1e-9 * scale
        )
        below = compiled(lambda q: f(p) + bound(q) - bound(p) - f(q))
        for q in np.random.default_rng(2).uniform(-1, 1, size=(20, 3)):
            assert below(q) > -1e-9

    def test_derivatives_of_a_nearly_singular_covariance(self):
        """Two axes almost at rest beside a free one: cofactors would lose every digit of the Hessian."""
        maps, origin = planted(np.random.default_rng(3), (1, 0, 0), noise=1e-7)
        m = velocity_moments(jnp.asarray(maps))
        p = jnp.asarray(origin) + jnp.asarray([1e-6, -2e-6, 1e-6])
        found = compiled(_expand, static_argnums=2)(m, tuple(p), 0.0)
        hessian = compiled(jax.hessian(lambda p: 6 * PositionObjective(m).value(p)))(p)
        np.testing.assert_allclose(to_matrix(found.hessian), hessian, atol=1e-4 * np.max(np.abs(hessian)))

    @pytest.mark.parametrize("exponent", [1.0, -1.0, -np.inf])
    def test_other_means_never_rise(self, moments, exponent):
        objective = PositionObjective(moments, exponent)
        x = jnp.asarray(np.random.default_rng(7).uniform(-1, 1, size=(3, 4)))
        step = compiled(lambda x: ValleySteps(1)(objective, POSITIONS, x))
        best = start = np.asarray(objective.value(x))
        for _ in range(12):
            x, value = step(x)
            assert np.all(value <= best + 1e-10)
            assert np.all(np.abs(x) <= 1)
            best = np.asarray(value)
        assert np.all(best < start)

    def test_never_rises_and_stays_in_the_box(self, moments, rng):
        objective = PositionObjective(moments)
        x = jnp.asarray(rng.uniform(-1, 1, size=(3, 4)))
        step = compiled(lambda x: ValleySteps(1)(objective, POSITIONS, x))
        value_of = compiled(objective.value)
        best = np.asarray(value_of(x))
        for _ in range(15):
            x, value = step(x)
            assert np.all(value <= best + 1e-10)
            assert np.all(np.abs(x) <= 1)
            np.testing.assert_allclose(value, value_of(x), rtol=1e-11)
            best = np.asarray(value)

    def test_finds_the_planted_origin(self, moments):
        """To within the noise, where the constraint determines all of it."""
        found = search_positions(VALLEY, moments)
        for problem in (0, 2):
            np.testing.assert_allclose(found.x[:, problem], ORIGINS[problem], atol=NOISE)
        assert np.all(found.agreement > 0)

    def test_optimum_on_a_face(self, moments):
        """A box that leaves the optimum out: the answer is on its face, and best there."""
        free = np.asarray(search_positions(VALLEY, moments).x)[:, 0]
        axis = int(np.argmax(np.abs(free)))
        limit = free[axis] / 2
        low, high = np.full(3, -1.0), np.full(3, 1.0)
        (high if limit > 0 else low)[axis] = limit
        found = search_positions(VALLEY, moments, KEY, Box(jnp.asarray(low), jnp.asarray(high))).x
        assert found[axis, 0] == limit
        objective = PositionObjective(moments[..., 0])
        slope = np.asarray(compiled(jax.grad(objective.value))(found[:, 0]))
        assert slope[axis] * np.sign(limit) < 0
        held = (found[:, 0] <= low) | (found[:, 0] >= high)
        np.testing.assert_allclose(slope[~held], 0, atol=1e-5)

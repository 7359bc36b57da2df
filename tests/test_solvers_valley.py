"""Local steps of origins: the bound, descent, and the optimum they reach."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from algebra import moments_of_maps
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

from reframe_jax.objectives.velocity import PositionObjective, log_norm
from reframe_jax.solvers import Box, ValleySteps


@pytest.fixture(scope="module")
def moments():
    """Of four problems, (6, 10, 4)."""
    return four_moments()


class TestValley:
    @pytest.mark.parametrize("exponent", [0.0, 0.5, 1.0, 2.0, -1.0, -np.inf])
    def test_the_tangent_in_the_covariance_is_a_bound(self, moments, exponent):
        """f is concave in Sigma, on which the majorizing steps rest."""
        norm = PositionObjective(moments[..., 0], exponent)
        p = jnp.asarray([0.2, -0.1, 0.4])
        tangent = compiled(jax.grad(log_norm), static_argnums=1)(norm.covariance(p), exponent)

        def above(q):
            terms = zip(tangent, norm.covariance(q), norm.covariance(p), strict=True)
            return norm.value(p) + sum(t * (there - here) for t, there, here in terms) - norm.value(q)

        shifts = np.random.default_rng(2).uniform(-1, 1, size=(20, 3))
        assert np.all(compiled(jax.vmap(above))(shifts) > -1e-9)
        slope = compiled(jax.grad(norm.value))(p)
        np.testing.assert_allclose(compiled(jax.grad(above))(p), 0, atol=1e-9 * np.max(np.abs(slope)))

    def test_axes_almost_at_rest_beside_a_free_one(self):
        """Noise of 1e-7 of the motion: Newton's steps still end at the origin."""
        maps, origin = planted(np.random.default_rng(3), (1, 0, 0), noise=1e-7)
        norm = PositionObjective(moments_of_maps(jnp.asarray(maps)))
        start = jnp.asarray(origin) + jnp.asarray([1e-3, -2e-3, 1e-3])
        found, _ = compiled(lambda x: ValleySteps(8)(norm, POSITIONS, x))(start)
        np.testing.assert_allclose(found, origin, atol=1e-6)

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
        np.testing.assert_allclose(slope[~held], 0, atol=1e-4)  # the curvature is 1e5

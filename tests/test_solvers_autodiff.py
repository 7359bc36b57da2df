"""Local steps on any objective, by automatic differentiation: Newton and Optax."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from planted_problems import FRAMES, POSITIONS, VALLEY, compiled, four_moments, frame_value, search_positions
from scipy.spatial.transform import Rotation

from reframe_jax.geometry.symmetric import to_matrix
from reframe_jax.objectives.velocity import FrameObjective, PositionObjective
from reframe_jax.solvers import BasinHopping, NewtonSteps, OptaxSteps
from reframe_jax.solvers.newton_steps import newton_steps

NEWTON = BasinHopping(NewtonSteps(15), restarts=4, hops=0)


@pytest.fixture(scope="module")
def moments():
    """Of four problems, (6, 10, 4)."""
    return four_moments()


class TestNewton:
    def test_directions(self, rng):
        """Newton's step solves with H; the other descends whatever the signs of H's eigenvalues."""
        h = rng.normal(size=(50, 6, 6))
        h, g = h + np.swapaxes(h, 1, 2), rng.normal(size=(50, 6))
        steps = compiled(jax.vmap(newton_steps))
        found = np.asarray(steps(g, h))
        np.testing.assert_allclose(np.einsum("nij,nj->ni", h, found[:, 0]), g, atol=1e-5)
        assert np.all(np.sum(found[:, 5] * g, axis=1) > 0)
        found = np.asarray(steps(g, h @ h + 0.1 * np.eye(6)))
        np.testing.assert_allclose(found[:, 0], found[:, 5], rtol=1e-9)

    def test_agrees_with_the_valley(self, moments):
        """Two methods with nothing in common end at the same optimum."""
        valley = search_positions(VALLEY, moments)
        found = search_positions(NEWTON, moments)
        np.testing.assert_allclose(found.value, valley.value, atol=1e-8)
        np.testing.assert_allclose(found.x, valley.x, atol=1e-6)

    def test_a_start_without_a_value_is_no_trap_for_the_others(self, moments):
        spoilt = moments.at[..., 2].set(jnp.nan)
        good, bad = search_positions(NEWTON, moments), search_positions(NEWTON, spoilt)
        assert bad.value[2] == np.inf
        kept = np.array([0, 1, 3])
        np.testing.assert_array_equal(bad.x[:, kept], good.x[:, kept])
        np.testing.assert_array_equal(bad.value[kept], good.value[kept])


class TestOptax:
    @pytest.mark.parametrize(
        ("transformation", "steps"), [(optax.adam(0.02), 600), (optax.lbfgs(), 40)], ids=["adam", "lbfgs"]
    )
    def test_several_problems_at_once(self, transformation, steps, moments):
        """Orientation and origin by gradients alone, from beside the optimum that is known."""
        position = search_positions(VALLEY, moments)
        covariance = compiled(lambda m, x: to_matrix(PositionObjective(m).covariance(x)))(moments, position.x)
        axes = np.linalg.eigh(np.asarray(covariance))[1]
        axes = axes * np.sign(np.linalg.det(axes))[:, None, None]
        start = np.concatenate([Rotation.from_matrix(axes).as_rotvec().T + 0.05, position.x + 0.02])
        inner = OptaxSteps(transformation, steps)
        order = np.array([2, 0, 3, 1])
        minimise = compiled(lambda m, x: inner(FrameObjective(m), FRAMES, x))
        with jax.numpy_dtype_promotion("standard"):  # Optax mixes types of integers
            found, value = minimise(moments, start)
            turned, turned_value = minimise(moments[..., order], start[:, order])
        assert found.shape == (6, 4)
        np.testing.assert_allclose(value, frame_value(moments, found), rtol=1e-9)
        begun = np.asarray(frame_value(moments, start))
        assert np.all(value < begun - 0.7 * (begun - np.asarray(position.value)))
        assert np.all(value >= position.value - 1e-9)
        # every problem by itself, wherever it stands
        np.testing.assert_array_equal(turned, found[:, order])
        np.testing.assert_array_equal(turned_value, value[order])

    def test_keeps_the_best_point_it_meets(self, moments):
        """With steps that are far too long the result is still no worse than the start."""
        inner = OptaxSteps(optax.sgd(30.0), 7)
        x = jnp.asarray(np.random.default_rng(1).uniform(-0.5, 0.5, size=(3, 4)))
        objective = PositionObjective(moments)
        found, value = compiled(lambda x: inner(objective, POSITIONS, x))(x)
        value_of = compiled(objective.value)
        assert np.all(value <= value_of(x) + 1e-12)
        np.testing.assert_allclose(value, value_of(found), atol=1e-9)

"""Local steps of whole frames, and the search of origins that goes through them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from planted_problems import FRAMES, KEY, POSITIONS, VALLEY, compiled, four_moments, frame_value
from scipy.spatial.transform import Rotation

from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.geometry.small import rotate
from reframe_jax.geometry.symmetric import to_matrix
from reframe_jax.objectives.norms import log_power_mean
from reframe_jax.objectives.velocity import FrameObjective, PositionObjective
from reframe_jax.solvers import BasinHopping, Box, FrameSteps, JointSearch, ValleySteps, moments_steps


@pytest.fixture(scope="module")
def moments():
    """Of four problems, (6, 10, 4)."""
    return four_moments()


class TestFrameSteps:
    @pytest.mark.parametrize(("i", "j"), [(0, 1), (0, 2), (1, 2)])
    def test_aligning_turns(self, i, j):
        """In one plane the turn makes the matrix diagonal, by the smaller angle."""
        matrix = np.diag([1.0, 2.0, 4.0])
        matrix[i, j] = matrix[j, i] = 0.3
        turn = np.asarray(moments_steps._aligning_rotation(jnp.asarray(matrix)))
        assert np.count_nonzero(turn) == 1
        assert np.max(np.abs(turn)) < np.pi / 4
        axes = Rotation.from_rotvec(-turn).as_matrix()
        aligned = axes.T @ matrix @ axes
        np.testing.assert_allclose(aligned, np.diag(np.diag(aligned)), atol=1e-14)

    def test_turning_is_the_exponential_to_second_order(self, rng):
        axes = rotation_exp(jnp.asarray(rng.normal(size=3)))
        for size in (1e-3, 2.0):
            d = size * rng.normal(size=3)
            turned = np.asarray(rotate(-jnp.asarray(d), axes.T).T)
            np.testing.assert_allclose(turned.T @ turned, np.eye(3), atol=1e-14)
            exact = np.asarray(axes @ rotation_exp(jnp.asarray(d)))
            assert np.max(np.abs(turned - exact)) < np.linalg.norm(d) ** 3

    @pytest.mark.parametrize("exponent", [0.0, -1.0])
    def test_agrees_with_the_elimination_of_the_rotation(self, moments, exponent):
        """Six unknowns and three: the same optimum; and angular velocities, whose optimum is closed form."""
        solver = BasinHopping(FrameSteps(10), restarts=8, hops=2)

        @compiled()
        def norms(moments):
            return (
                solver.minimise(FrameObjective(moments, exponent), FRAMES, KEY),
                VALLEY.minimise(PositionObjective(moments, exponent), POSITIONS, KEY),
            )

        found, valley = norms(moments)
        assert found.x.shape == (6, 4)
        np.testing.assert_allclose(found.value, valley.value, atol=1e-8)
        # the valley of -1 is flat: rounding decides where in it a search ends
        np.testing.assert_allclose(found.x[3:], valley.x, atol=1e-5 if exponent < 0 else 1e-6)
        turns = Box(FRAMES.low[:3], FRAMES.high[:3])
        angular = compiled(lambda m: solver.minimise(FrameObjective(m, exponent), turns, KEY))(moments[:, :1])
        variances = np.linalg.eigvalsh(np.asarray(to_matrix(tuple(moments[:, 0]))))
        exact = compiled(lambda s: log_power_mean(jnp.log(s.T) / 2, exponent))(jnp.asarray(variances))
        np.testing.assert_allclose(angular.value, exact, atol=1e-9)

    def test_never_rises_and_stays_in_the_box(self, moments, rng):
        """Also where the optimum lies beyond a face."""
        objective = FrameObjective(moments)
        box = Box(FRAMES.low.at[3:].set(-0.1), FRAMES.high.at[3:].set(0.1))
        x = jnp.asarray(rng.uniform(-0.1, 0.1, size=(6, 4)))
        step = compiled(lambda x: FrameSteps(1)(objective, box, x))
        best = start = np.asarray(frame_value(moments, x))
        for _ in range(15):
            x, value = step(x)
            assert np.all(value <= best + 1e-10)
            assert np.all(np.abs(x[3:]) <= 0.1)
            np.testing.assert_allclose(value, frame_value(moments, x), rtol=1e-11)
            best = np.asarray(value)
        assert np.all(best < start - 0.1)
        assert np.any(np.abs(x[3:]) == 0.1)

    def test_a_problem_without_a_value_is_no_trap_for_the_others(self, moments):
        minimise = compiled(lambda m, x: FrameSteps(5)(FrameObjective(m), FRAMES, x))
        x = jnp.asarray(np.random.default_rng(1).uniform(-0.5, 0.5, size=(6, 4)))
        good, bad = minimise(moments, x)[1], minimise(moments.at[..., 2].set(jnp.nan), x)[1]
        kept = np.array([0, 1, 3])
        np.testing.assert_array_equal(bad[kept], good[kept])
        assert not np.isfinite(bad[2])

    def test_wants_a_frame_objective(self, moments):
        with pytest.raises(ValueError, match="FrameObjective"):
            FrameSteps(1)(PositionObjective(moments), POSITIONS, jnp.zeros((3, 4)))


class TestJointSearch:
    def test_finds_origins(self, moments):
        """Their norms are those with the best axes there."""
        solver = JointSearch(BasinHopping(FrameSteps(10), restarts=5, hops=2), refine=ValleySteps(4))
        objective = PositionObjective(moments, -1.0)
        found = compiled(lambda m: solver.minimise(PositionObjective(m, -1.0), POSITIONS, KEY))(moments)
        assert found.x.shape == (3, 4)
        assert np.all(np.abs(found.x) <= 1)
        np.testing.assert_allclose(found.value, compiled(objective.value)(found.x), rtol=1e-11)
        assert np.all(np.abs(found.x) < 0.99)
        gradient = jax.grad(lambda x: jnp.sum(objective.value(x)))
        slope, bend = (np.asarray(compiled(f)(found.x)) for f in (gradient, jax.jacfwd(gradient)))
        for number in range(4):
            # what a Newton step would still gain; the slope itself is steep in narrow valleys
            gain = slope[:, number] @ np.linalg.solve(bend[:, number, :, number], slope[:, number])
            assert 0 <= gain < 1e-11

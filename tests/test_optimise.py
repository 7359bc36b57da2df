"""The parts of the search one by one: starts, box, local minimisers, and stepping by hand."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.spatial.transform import Rotation

from reframe_jax.compilation import compiler_options
from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.geometry.symmetric import to_matrix
from reframe_jax.objectives.moments import covariance_at, velocity_moments
from reframe_jax.objectives.norms import log_power_mean
from reframe_jax.objectives.velocity import FrameObjective, PositionObjective
from reframe_jax.solvers import (
    BasinHopping,
    Box,
    FrameSteps,
    JointSearch,
    NewtonSteps,
    OptaxSteps,
    ValleySteps,
)
from reframe_jax.solvers import frame_steps as frame_steps
from reframe_jax.solvers.seeds import quasi_random
from reframe_jax.solvers.valley_steps import _expand


def compiled(function: Callable[..., Any] | None = None, **options: Any) -> Callable[..., Any]:
    """``jax.jit`` as ``identify`` calls it; searches compile in half the time."""
    if function is None:
        return lambda function: compiled(function, **options)
    return jax.jit(function, compiler_options=compiler_options(), **options)


KEY = jax.random.key(3)
POSITIONS = Box(jnp.asarray(np.full(3, -1.0)), jnp.asarray(np.full(3, 1.0)))
FRAMES = Box(jnp.asarray([-np.pi] * 3 + [-1.0] * 3), jnp.asarray([np.pi] * 3 + [1.0] * 3))
FREE = [(1, 0, 0), (1, 1, 0), (0, 0, 0), (1, 1, 0)]  # translations of the planted constraints
NOISE = 1e-3


def planted(rng, free, noise=NOISE, samples=40):
    """Velocity maps whose velocity at a known origin is noise except along the free axes."""
    w, origin = rng.normal(size=(samples, 3)), rng.uniform(-0.5, 0.5, size=3)
    axes = np.asarray(rotation_exp(jnp.asarray(rng.normal(size=3))))
    along = (0.3 * np.array(free) * rng.normal(size=(samples, 3))) @ axes.T
    turn = np.stack([np.cross(w, e) for e in np.eye(3)], axis=-1)
    a = along + noise * rng.normal(size=(samples, 3)) - np.cross(w, origin)
    return np.concatenate([a[..., None], turn], axis=-1), origin


RNG = np.random.default_rng(11)
WINDOWS, ORIGINS = zip(*(planted(RNG, free) for free in FREE), strict=True)


@pytest.fixture(scope="module")
def moments():
    """Of four problems, (6, 10, 4)."""
    return velocity_moments(jnp.asarray(np.stack(WINDOWS)))


VALLEY = BasinHopping(ValleySteps(10), restarts=4, hops=1)
NEWTON = BasinHopping(NewtonSteps(15), restarts=4, hops=0)


@compiled(static_argnums=0)
def search(solver, moments, key, box):
    return solver.minimise(PositionObjective(moments), box, key)


def search_positions(solver, moments, key=KEY, box=POSITIONS):
    return search(solver, moments, key, box)


class TestSeeds:
    def test_fill_the_cube(self):
        """In each coordinate no gap is much wider than even spacing, and every octant has its share."""
        for dim in (3, 6):
            points = np.asarray(quasi_random(KEY, 64, dim, jnp.float64))
            assert points.shape == (dim, 64)
            assert np.all((points >= 0) & (points < 1))
            for row in np.sort(points, axis=1):
                gaps = np.diff(np.append(row, row[0] + 1))
                assert np.max(gaps) < 4.5 / 64
        octants = np.zeros(8, dtype=int)
        np.add.at(octants, np.dot([1, 2, 4], (np.asarray(quasi_random(KEY, 64, 3, jnp.float64)) > 0.5)), 1)
        assert np.all((octants >= 5) & (octants <= 11))

    def test_keep_apart(self):
        """The nearest of 32 points are much farther apart than random ones would be."""
        points = np.asarray(quasi_random(KEY, 32, 3, jnp.float64)).T
        difference = np.abs(points[:, None] - points[None])
        distance = np.linalg.norm(np.minimum(difference, 1 - difference), axis=-1)
        assert np.min(distance + np.eye(32)) > 0.15

    def test_any_prefix_and_any_key(self):
        few, many = (quasi_random(KEY, n, 3, jnp.float32) for n in (5, 9))
        assert few.dtype == jnp.float32
        np.testing.assert_array_equal(few, many[:, :5])
        other = quasi_random(jax.random.key(4), 5, 3, jnp.float32)
        assert np.min(np.abs(np.asarray(few - other))) > 1e-3


class TestBox:
    def test_fold_and_unfold(self, rng):
        box = Box(jnp.asarray([-1.0, 0.0, -3.0]), jnp.asarray([1.0, 0.5, 7.0]))
        inside = box.scale(jnp.asarray(rng.uniform(size=(3, 30))))
        faces = box.scale(jnp.asarray(rng.integers(0, 2, size=(3, 30)).astype(float)))
        for points in (inside, faces):
            for x in points.T:
                np.testing.assert_allclose(box.fold(box.unfold(x)), x, atol=1e-14)
        anywhere = jax.vmap(box.fold)(jnp.asarray(rng.normal(scale=30, size=(200, 3))))
        assert np.all((anywhere >= box.low[None]) & (anywhere <= box.high[None]))
        assert np.all(np.isfinite(box.unfold(jnp.asarray([-9.0, 9.0, 9.0]))))
        # flat at the faces, so that a minimiser can end there, and smooth through them
        slope = jax.vmap(jax.grad(lambda z: jnp.sum(box.fold(z))))(jax.vmap(box.unfold)(faces.T))
        np.testing.assert_allclose(slope, 0, atol=1e-7)

    def test_clip_and_scale(self, rng):
        box = Box(jnp.asarray([-1.0, 0.0]), jnp.asarray([1.0, 0.5]))
        points = jnp.asarray(rng.normal(size=(2, 4, 5)))
        np.testing.assert_array_equal(box.clip(points), np.clip(points, [[[-1]], [[0]]], [[[1]], [[0.5]]]))
        np.testing.assert_array_equal(box.scale(jnp.asarray([0.5, 0.5])), [0, 0.25])
        np.testing.assert_array_equal(box.scale(jnp.asarray([[0.0, 1.0], [0.0, 1.0]])), [[-1, 1], [0, 0.5]])


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


def frame_of(x):
    """The frame at unknowns (6,) or (3,)."""
    axes = rotation_exp(x[:3])
    position = tuple(x[3:]) if len(x) == 6 else tuple(jnp.zeros(3))
    return frame_steps._Frame(tuple(tuple(axes[:, n]) for n in range(3)), position)


class TestFrameSteps:
    @pytest.mark.parametrize("dim", [3, 6])
    @pytest.mark.parametrize("exponent", [0.0, 0.5, 1.0, 2.0, -1.0, -np.inf])
    def test_derivatives(self, moments, exponent, dim):
        """With respect to a turn about the frame's own axes and a shift, as autodiff has them."""
        m = moments[:, : 10 if dim == 6 else 1, 0]
        x = jnp.asarray([0.4, -1.1, 0.7, 0.2, -0.1, 0.4])[:dim]

        def stepped(step):
            turned = rotation_exp(x[:3]) @ rotation_exp(step[:3])
            columns = tuple(tuple(turned[:, n]) for n in range(3))
            position = tuple((x + step)[3:]) if dim == 6 else tuple(jnp.zeros(3))
            return frame_steps._level(m, frame_steps._Frame(columns, position), exponent)

        zero = jnp.zeros(dim)
        np.testing.assert_allclose(stepped(zero), FrameObjective(m, exponent).value(x), rtol=1e-12)
        expand = compiled(lambda m: frame_steps._expand(m, frame_of(x), exponent))
        gradient, rows, covariance, _ = expand(m)
        axes = np.asarray(rotation_exp(x[:3]))
        sigma = to_matrix(FrameObjective(m, exponent).covariance(x))
        np.testing.assert_allclose(to_matrix(covariance), axes.T @ np.asarray(sigma) @ axes, atol=1e-12)
        hessian = compiled(jax.hessian(stepped))(zero)
        scale = np.max(np.abs(hessian))
        np.testing.assert_allclose(jnp.stack(gradient), compiled(jax.grad(stepped))(zero), atol=1e-11)
        for i, row in enumerate(rows):
            np.testing.assert_allclose(jnp.stack(row), hessian[i, : i + 1], rtol=0, atol=1e-9 * scale + 1e-12)

    def test_directions(self, rng):
        """Newton's step solves with H; the other descends whatever the signs of H's eigenvalues."""
        h = rng.normal(size=(6, 6, 50))
        h, g = h + np.swapaxes(h, 0, 1), rng.normal(size=(6, 50))
        rows = [[jnp.asarray(h[i, j]) for j in range(i + 1)] for i in range(6)]
        newton, descent = frame_steps._directions([jnp.asarray(row) for row in g], rows)
        np.testing.assert_allclose(np.einsum("ijn,jn->in", h, newton), g, atol=1e-5)
        assert np.all(np.sum(descent * g, axis=0) > 0)
        definite = np.einsum("ikn,jkn->ijn", h, h) + 0.1 * np.eye(6)[:, :, None]
        rows = [[jnp.asarray(definite[i, j]) for j in range(i + 1)] for i in range(6)]
        newton, descent = frame_steps._directions([jnp.asarray(row) for row in g], rows)
        np.testing.assert_allclose(newton, descent, rtol=1e-9)

    @pytest.mark.parametrize(("i", "j"), [(0, 1), (0, 2), (1, 2)])
    def test_aligning_turns(self, i, j):
        """In one plane the turn makes the matrix diagonal, by the smaller angle."""
        matrix = np.diag([1.0, 2.0, 4.0])
        matrix[i, j] = matrix[j, i] = 0.3
        turn = np.asarray(frame_steps._aligning(tuple(jnp.asarray(matrix[np.triu_indices(3)]))))
        assert np.count_nonzero(turn) == 1
        assert np.max(np.abs(turn)) < np.pi / 4
        axes = Rotation.from_rotvec(-turn).as_matrix()
        aligned = axes.T @ matrix @ axes
        np.testing.assert_allclose(aligned, np.diag(np.diag(aligned)), atol=1e-14)

    @pytest.mark.parametrize("exponent", [0.0, 1.0, -1.0, -np.inf])
    def test_majorant(self, moments, exponent):
        """With the axes kept, the quadratic touches log J and is nowhere below it."""
        m, x = moments[..., 0], jnp.asarray([0.4, -1.1, 0.7, 0.2, -0.1, 0.4])
        here = compiled(lambda m: frame_steps._expand(m, frame_of(x), exponent))(m)
        value_of = compiled(FrameObjective(m, exponent).value)
        slope, curvature = np.stack(here.gradient[3:]), np.asarray(to_matrix(here.majorant))
        for shift in np.random.default_rng(2).uniform(-1, 1, size=(20, 3)):
            bound = value_of(x) + slope @ shift + shift @ curvature @ shift / 2
            assert bound >= value_of(x.at[3:].add(shift)) - 1e-9

    def test_turning_is_the_exponential_to_second_order(self, rng):
        axes = rotation_exp(jnp.asarray(rng.normal(size=3)))
        columns = tuple(tuple(axes[:, n]) for n in range(3))
        for size in (1e-3, 2.0):
            d = size * rng.normal(size=3)
            turned = np.stack([np.stack(e) for e in frame_steps._turned(columns, tuple(d))], axis=-1)
            np.testing.assert_allclose(turned.T @ turned, np.eye(3), atol=1e-14)
            exact = np.asarray(axes @ rotation_exp(jnp.asarray(d)))
            assert np.max(np.abs(turned - exact)) < np.linalg.norm(d) ** 3

    @pytest.mark.parametrize("exponent", [0.0, 1.0, -1.0])
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
        """Their norms are those with the best axes there; every chain says where it ended."""
        solver = JointSearch(BasinHopping(FrameSteps(10), restarts=5, hops=2), refine=ValleySteps(4))
        objective = PositionObjective(moments, -1.0)
        found = compiled(lambda m: solver.minimise(PositionObjective(m, -1.0), POSITIONS, KEY))(moments)
        assert found.x.shape == (3, 4)
        assert found.ends.shape == (3, 5, 4)
        assert np.all(np.abs(found.x) <= 1)
        np.testing.assert_allclose(found.value, compiled(objective.value)(found.x), rtol=1e-11)
        assert np.all(found.value <= np.min(found.end_values, axis=0) + 1e-9)
        slope = compiled(jax.grad(lambda x: jnp.sum(objective.value(x))))(found.x)
        inside = np.abs(found.x) < 1
        np.testing.assert_allclose(np.asarray(slope)[inside], 0, atol=1e-5)


class TestNewton:
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


frame_value = compiled(lambda moments, x: FrameObjective(moments).value(x))


def slide(objective, box, x):
    """A cheap local minimiser: one short step down."""
    slope = jax.grad(lambda x: jnp.sum(objective.value(x)))(x)
    moved = box.clip(x - 0.01 * slope)
    better = objective.value(moved) < objective.value(x)
    x = jnp.where(better[None], moved, x)
    return x, objective.value(x)


def stay(objective, box, x):
    """A local minimiser that does nothing: what is left of basin hopping is Metropolis' walk."""
    return x, objective.value(x)


class TestBasinHopping:
    solver = BasinHopping(slide, restarts=3, hops=3, polish=1, refine=slide)

    def test_stepping_by_hand(self, moments):
        """init, step and finish are minimise; the best value of a chain never rises."""
        objective = PositionObjective(moments)
        value_of = compiled(objective.value)
        step = compiled(lambda state: self.solver.step(objective, POSITIONS, state))
        state = self.solver.init(objective, POSITIONS, KEY)
        assert state.x.shape == (3, 3, 4)
        assert np.all(np.asarray(state.value) == np.inf)
        for hop in range(1 + self.solver.hops + self.solver.polish):
            assert state.hop == hop
            before = np.asarray(state.best_value)
            state = step(state)
            assert np.all(state.best_value <= before)
            assert np.all(state.best_value <= state.value)
            met = np.stack([value_of(state.best_x[:, i]) for i in range(3)])
            np.testing.assert_allclose(state.best_value, met, rtol=1e-10)
            assert np.all(np.abs(state.x) <= 1)
        by_hand = compiled(lambda state: self.solver.finish(objective, POSITIONS, state))(state)
        gain = np.min(state.best_value, axis=0) - np.asarray(by_hand.value)
        assert np.min(gain) >= 0
        assert np.max(gain) > 0.01
        np.testing.assert_allclose(by_hand.value, value_of(by_hand.x), rtol=1e-10)
        at_once = search_positions(self.solver, moments)
        np.testing.assert_allclose(at_once.x, by_hand.x, atol=1e-9)
        np.testing.assert_allclose(at_once.value, by_hand.value, atol=1e-10)
        np.testing.assert_array_equal(at_once.agreement, by_hand.agreement)

    def test_settled_problems_stop(self):
        """Where the chains met they stop after one step, and nowhere else; whatever block they are in."""
        rng = np.random.default_rng(5)
        maps = np.stack([planted(rng, FREE[i % 4])[0] for i in range(37)])
        objective = PositionObjective(velocity_moments(jnp.asarray(maps)))
        solver = BasinHopping(ValleySteps(3), restarts=3, hops=2, polish=1, settled=0)
        step = compiled(lambda state: solver.step(objective, POSITIONS, state))
        first = step(solver.init(objective, POSITIONS, KEY))
        last = first
        for _ in range(3):
            last = step(last)
        spread = np.ptp(np.asarray(first.value), axis=0)
        limit = float(np.median(spread))
        settled = spread < limit
        assert 10 < np.sum(settled) < 27
        found = search(dataclasses.replace(solver, settled=limit), objective.moments, KEY, POSITIONS)
        expected = np.where(settled, np.min(first.best_value, axis=0), np.min(last.best_value, axis=0))
        np.testing.assert_allclose(found.value, expected, atol=1e-9)
        assert np.any(np.min(last.best_value, axis=0) < np.min(first.best_value, axis=0) - 1e-3)
        # nothing is settled: the same as by hand for all
        found = search(solver, objective.moments, KEY, POSITIONS)
        np.testing.assert_allclose(found.value, np.min(last.best_value, axis=0), atol=1e-9)

    def test_one_chain_meets_nobody(self, moments):
        """A single chain takes all its hops."""
        one = BasinHopping(ValleySteps(2), restarts=1, hops=0, polish=0)
        more = dataclasses.replace(one, polish=8, settled=1e9)
        gain = search_positions(one, moments).value - search_positions(more, moments).value
        assert np.max(gain) > 1e-3

    def test_chains_move_uphill_only_when_warm(self, moments):
        """At temperature 0 a chain's value never rises; at a high one every jump is taken."""
        objective = PositionObjective(moments)

        def values(temperature):
            solver = dataclasses.replace(self.solver, inner=stay, hops=6, temperature=temperature)
            step = compiled(lambda state: solver.step(objective, POSITIONS, state))
            state, seen = solver.init(objective, POSITIONS, KEY), []
            for _ in range(6):
                state = step(state)
                seen.append(np.asarray(state.value))
            return np.diff(seen, axis=0)

        assert np.all(values(0.0) <= 0)
        assert np.mean(values(1e9) > 0) > 0.3

    def test_agreement(self, moments):
        """The share of chains within 0.1 % of the best, counted on chains of known values."""
        state = self.solver.init(PositionObjective(moments), POSITIONS, KEY)
        ends = jnp.asarray([[-5, -5, -5, 0.0], [-4.9995, -4, -4.9985, 1], [-4, -4, -4.9995, jnp.inf]])
        state = dataclasses.replace(state, best_value=ends)
        found = dataclasses.replace(self.solver, refine=None).finish(
            PositionObjective(moments), POSITIONS, state
        )
        np.testing.assert_array_equal(found.value, [-5, -5, -5, 0])
        np.testing.assert_allclose(found.agreement, [2 / 3, 1 / 3, 2 / 3, 1 / 3])
        np.testing.assert_array_equal(found.x, state.best_x[:, 0])

    def test_nan_counts_as_infinite(self, moments):
        """A local minimiser that fails on some chains: the others decide."""

        def fails_on_the_left(objective, box, x):
            value = objective.value(x)
            return x, jnp.where(x[0] < 0, jnp.nan, value)

        solver = BasinHopping(fails_on_the_left, restarts=8, hops=1)
        found = search_positions(solver, moments)
        assert np.all(np.isfinite(found.value))
        assert np.all(found.x[0] >= 0)
        always = BasinHopping(lambda o, b, x: (x, jnp.full(x.shape[1:], jnp.nan)), restarts=2, hops=1)
        assert np.all(np.asarray(search_positions(always, moments).value) == np.inf)

    def test_key(self, moments):
        """The same key gives the same answer, bit for bit; another key the same optimum."""
        one, same = search_positions(VALLEY, moments), search_positions(VALLEY, moments)
        np.testing.assert_array_equal(one.x, same.x)
        other = search_positions(VALLEY, moments, jax.random.key(99))
        assert np.any(np.asarray(one.x) != np.asarray(other.x))
        np.testing.assert_allclose(other.value, one.value, atol=1e-6)

    def test_place_in_the_batch(self, moments):
        """A problem's answer depends on its data and the key, not on its neighbours or its place."""
        order = np.array([2, 0, 3, 1])
        together, turned = search_positions(VALLEY, moments), search_positions(VALLEY, moments[..., order])
        np.testing.assert_array_equal(turned.x, together.x[:, order])
        np.testing.assert_array_equal(turned.value, together.value[order])
        together = search_positions(self.solver, moments)
        alone = search_positions(self.solver, moments[..., 2])
        assert alone.x.shape == (3,)
        np.testing.assert_allclose(alone.x, together.x[:, 2], atol=1e-9)
        folded = search_positions(self.solver, moments.reshape(6, 10, 2, 2))
        np.testing.assert_allclose(folded.x.reshape(3, 4), together.x, atol=1e-9)

    def test_solvers_are_static_and_states_are_trees(self, moments):
        assert hash(VALLEY) == hash(dataclasses.replace(VALLEY))
        assert dataclasses.replace(VALLEY, hops=2) != VALLEY
        state = VALLEY.init(PositionObjective(moments), POSITIONS, KEY)
        again = jax.tree.map(lambda leaf: leaf, state)
        assert type(again) is type(state)
        assert len(jax.tree.leaves(state)) == 6

    @pytest.mark.parametrize(
        "inner", [ValleySteps(6), FrameSteps(6), NewtonSteps(6), OptaxSteps(optax.sgd(0.1), 6)]
    )
    def test_single_precision_stays_single(self, inner, moments):
        kind, box = (
            (FrameObjective, FRAMES) if isinstance(inner, FrameSteps) else (PositionObjective, POSITIONS)
        )
        box = Box(box.low.astype(jnp.float32), box.high.astype(jnp.float32))
        solver = BasinHopping(inner, restarts=2, hops=1, refine=inner)
        found = jax.eval_shape(lambda m: solver.minimise(kind(m), box, KEY), moments.astype(jnp.float32))
        assert found.x.dtype == found.value.dtype == found.agreement.dtype == jnp.float32

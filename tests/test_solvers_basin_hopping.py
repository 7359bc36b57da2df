"""The search around the local steps: chains, acceptance, settling, agreement."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from algebra import moments_of_maps
from planted_problems import (
    FRAMES,
    FREE,
    KEY,
    POSITIONS,
    VALLEY,
    compiled,
    four_moments,
    planted,
    search,
    search_positions,
)

from reframe_jax.objectives.velocity import FrameObjective, PositionObjective
from reframe_jax.solvers import BasinHopping, Box, FrameSteps, NewtonSteps, OptaxSteps, ValleySteps
from reframe_jax.solvers.basin_hopping import suggested_starts


@pytest.fixture(scope="module")
def moments():
    """Of four problems, (6, 10, 4)."""
    return four_moments()


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
            reached = np.stack([value_of(state.best_x[:, i]) for i in range(3)])
            np.testing.assert_allclose(state.best_value, reached, rtol=1e-10)
            assert np.all(np.abs(state.x) <= 1)
        by_hand = compiled(lambda state: self.solver.finish(objective, POSITIONS, state))(state)
        gain = np.min(state.best_value, axis=0) - np.asarray(by_hand.value)
        assert np.min(gain) >= 0
        assert np.max(gain) > 0.01
        np.testing.assert_allclose(by_hand.value, value_of(by_hand.x), rtol=1e-10)
        in_one_call = search_positions(self.solver, moments)
        np.testing.assert_allclose(in_one_call.x, by_hand.x, atol=1e-9)
        np.testing.assert_allclose(in_one_call.value, by_hand.value, atol=1e-10)
        np.testing.assert_array_equal(in_one_call.agreement, by_hand.agreement)

    def test_settled_problems_stop(self):
        """Where the chains met they stop after one step, and nowhere else; whatever block they are in."""
        rng = np.random.default_rng(5)
        maps = np.stack([planted(rng, FREE[i % 4])[0] for i in range(37)])
        objective = PositionObjective(moments_of_maps(jnp.asarray(maps)))
        solver = BasinHopping(slide, restarts=3, hops=2, polish=1, tolerance=0)
        step = compiled(lambda state: solver.step(objective, POSITIONS, state))
        first = step(solver.init(objective, POSITIONS, KEY))
        last = first
        for _ in range(3):
            last = step(last)
        spread = np.ptp(np.asarray(first.value), axis=0)
        limit = float(np.median(spread))
        tolerance = spread < limit
        assert 10 < np.sum(tolerance) < 27
        found = search(dataclasses.replace(solver, tolerance=limit), objective.moments, KEY, POSITIONS)
        expected = np.where(tolerance, np.min(first.best_value, axis=0), np.min(last.best_value, axis=0))
        np.testing.assert_allclose(found.value, expected, atol=1e-9)
        assert np.any(np.min(last.best_value, axis=0) < np.min(first.best_value, axis=0) - 1e-3)
        # nothing is settled: the same as by hand for all
        found = search(solver, objective.moments, KEY, POSITIONS)
        np.testing.assert_allclose(found.value, np.min(last.best_value, axis=0), atol=1e-9)

    def test_rounds(self):
        """They lower what did not settle, alone as in a batch, and leave what did as it is."""
        rng = np.random.default_rng(5)
        maps = np.stack([planted(rng, FREE[i % 4])[0] for i in range(24)])
        moments = moments_of_maps(jnp.asarray(maps))
        objective = PositionObjective(moments)
        rounds = BasinHopping(slide, restarts=3, hops=1, polish=0, rounds=4)
        first = compiled(lambda state: rounds.step(objective, POSITIONS, state))(
            rounds.init(objective, POSITIONS, KEY)
        )
        spread = np.ptp(np.asarray(first.value), axis=0)
        rounds = dataclasses.replace(rounds, tolerance=float(np.median(spread)))
        tolerance = spread < rounds.tolerance
        short = search(dataclasses.replace(rounds, rounds=1), moments, KEY, POSITIONS)
        found = search(rounds, moments, KEY, POSITIONS)
        gain = np.min(np.asarray(first.value), axis=0) - np.asarray(found.value)
        assert np.all(gain > -1e-6)  # two programs round differently
        np.testing.assert_allclose(gain[tolerance], 0, atol=1e-6)
        assert np.max(gain) > 0.1
        assert np.max(np.asarray(short.value - found.value)) > 0.1
        for i in (0, 3, 11):
            single = search(rounds, moments[..., i : i + 1], KEY, POSITIONS)
            np.testing.assert_allclose(single.value, found.value[i : i + 1], atol=1e-6)

    def test_suggested_starts_are_the_stillest_origins_along_their_directions(self, moments):
        """No other origin moves less along the direction that the key draws; all lie in the box."""
        objective, wide = PositionObjective(moments), Box(jnp.full(3, -1e3), jnp.full(3, 1e3))
        points = np.asarray(suggested_starts(objective, wide, KEY, 3, 1))
        assert points.shape == (3, 3, 4)
        directions = np.asarray(jax.random.normal(KEY, (3, 3)))

        def along(points):
            """Mean square along each direction of the velocity of its own point, (3, 4)."""
            means = []
            for d, p in zip(directions.T, np.moveaxis(points, 1, 0), strict=True):
                xx, xy, xz, yy, yz, zz = objective.covariance(jnp.asarray(p))
                sigma = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
                means.append(np.einsum("i,ijn,j->n", d, sigma, d))
            return np.array(means)

        least = along(points)
        for step in 0.01 * np.concatenate([np.eye(3), -np.eye(3)]):
            assert np.all(along(points + step[:, None, None]) >= least - 1e-12)
        near = suggested_starts(objective, POSITIONS, KEY, 3, 1)
        np.testing.assert_allclose(near, np.clip(points, -1, 1), atol=1e-12)
        anywhere = suggested_starts(FrameObjective(moments), FRAMES, KEY, 3, 1)
        assert anywhere.shape == (6, 3, 4)

    def test_one_chain_meets_nobody(self, moments):
        """A single chain takes all its hops."""
        one = BasinHopping(ValleySteps(2), restarts=1, hops=0, polish=0)
        more = dataclasses.replace(one, polish=8, tolerance=1e9)
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
        single = search_positions(self.solver, moments[..., 2])
        assert single.x.shape == (3,)
        np.testing.assert_allclose(single.x, together.x[:, 2], atol=1e-9)
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

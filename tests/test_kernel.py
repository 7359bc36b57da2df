"""The GPU kernels, interpreted: the search is that of the steps outside, the sums are means."""

from functools import partial
from importlib.metadata import version

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.identification.floored_moments import window_moments
from reframe_jax.objectives import moments
from reframe_jax.objectives.moments_kernel import mean_products
from reframe_jax.objectives.velocity import PositionObjective
from reframe_jax.simulation import synthetic
from reframe_jax.solvers import Box

BOX = Box(-jnp.ones(3), jnp.ones(3))


@pytest.fixture(scope="module")
def objective():
    """Of 3 windows and 4 types each."""
    keys = jax.random.split(jax.random.key(0), 3)
    poses = jax.vmap(lambda key: synthetic.simulate("K", key, noise=1e-3).poses)(keys)
    return PositionObjective(jax.jit(window_moments)(poses, jnp.full(50, 0.1))[1])


def in_the_kernel(solver, objective, state, count):
    return solver._in_a_kernel(solver.inner, objective, BOX, state, count, interpret=True)


def assert_same_state(one, other, of_values, of_unknowns):
    """Every chain of every problem, where it is and the best it has met."""
    assert int(one.hop) == int(other.hop)
    assert jax.random.key_data(one.key).tolist() == jax.random.key_data(other.key).tolist()
    for name, atol in (("value", of_values), ("x", of_unknowns)):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0, atol=atol)
        best = f"best_{name}"
        np.testing.assert_allclose(getattr(one, best), getattr(other, best), rtol=0, atol=atol)


def test_each_transition_in_the_kernel_is_that_of_the_search(objective):
    """From the same state, for a first minimisation, two hops and two polishings.

    The two compute the same in a different order of rounding. Where the data hardly determine the origin,
    candidates of one value to 15 digits lie apart, so an origin agrees to the root of the rounding only.
    Over several transitions that difference would grow: a jump from beside ends elsewhere.
    """
    solver = rf.BasinHopping(rf.ValleySteps(4), restarts=2, hops=2, polish=2)
    state = solver.init(objective, BOX, jax.random.key(4))
    step = jax.jit(lambda state: solver.step(objective, BOX, state))
    kernel = jax.jit(lambda state: in_the_kernel(solver, objective, state, 1))
    for hop in range(1 + solver.hops + solver.polish):
        expected, found = step(state), kernel(state)
        assert found.best_x.shape == (3, 2, 3, 4)
        assert int(found.hop) == hop + 1
        assert_same_state(found, expected, of_values=1e-12, of_unknowns=1e-6)
        state = expected


def test_all_transitions_in_one_kernel_are_those_of_the_search(objective, rng):
    """Chains that walk without descending, which no rounding drives apart; problems for two blocks."""
    solver = rf.BasinHopping(rf.ValleySteps(0), restarts=3, hops=6, polish=2, temperature=0.5)
    many = PositionObjective(jnp.tile(objective.moments, (1, 1, 44, 1))[:, :, :33])
    starts = jnp.asarray(rng.uniform(-1, 1, size=(3, 3, 33, 4)))  # of every problem's own
    start = solver.init(many, BOX, jax.random.key(4), starts)
    expected = jax.jit(lambda state: solver._advance(many, BOX, state, 9))(start)
    first = jax.jit(lambda state: in_the_kernel(solver, many, state, 5))(start)
    found = jax.jit(lambda state: in_the_kernel(solver, many, state, 4))(first)
    assert_same_state(found, expected, of_values=1e-12, of_unknowns=1e-12)
    uphill = np.asarray(first.value > first.best_value)
    assert 0.1 < np.mean(uphill) < 0.9  # of the hops some were accepted, some were not


def test_the_kernel_compiles_for_a_gpu(objective):
    """As far as Triton's own language, which says what Triton lacks; jax 0.10 needs no GPU for that."""
    if version("jax") >= "0.11" and jax.default_backend() != "gpu":
        pytest.skip("jax 0.11 lowers to Triton only where there is a GPU")
    solver = rf.BasinHopping(rf.ValleySteps(1), restarts=2, hops=1)
    start = solver.init(objective, BOX, jax.random.key(4))
    program = jax.jit(lambda state: solver._in_a_kernel(solver.inner, objective, BOX, state, 3))
    assert "triton" in program.trace(start).lower(lowering_platforms=("cuda",)).as_text()


def test_mean_products(rng):
    entries = rng.normal(size=(3, 7, 130))  # one block of problems, and two more
    rows = mean_products(jnp.asarray(entries), interpret=True)
    for i, row in enumerate(rows):
        expected = np.mean(entries[i, None] * entries[i:], axis=1)
        np.testing.assert_allclose(row, expected, atol=1e-15)


def test_mean_products_inside_transformations(monkeypatch, rng):
    """The kernel has the derivatives, forward and reverse, of what it stands for, and batches."""
    monkeypatch.setattr(moments, "mean_products", partial(mean_products, interpret=True))
    entries, change = jnp.asarray(rng.normal(size=(2, 3, 5, 4, 2)))

    def results(products):
        def total(entries):
            return sum(jnp.sum(jnp.sin(row)) for row in products(entries))

        along = jax.jvp(jax.grad(total), (entries,), (change,))
        rows = jax.vmap(products, in_axes=2, out_axes=1)(entries)
        return jax.tree.map(np.asarray, (along, rows))

    expected, found = results(moments._products), results(moments._products_in_a_kernel)
    jax.tree.map(lambda e, f: np.testing.assert_allclose(f, e, atol=1e-14), expected, found)

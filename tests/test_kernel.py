"""The GPU kernels, interpreted: the search is the search step by step, the sums are means."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import reframe_jax as rf
from reframe_jax.identification.pipeline import window_moments
from reframe_jax.objectives import moments
from reframe_jax.objectives.moments_kernel import mean_products
from reframe_jax.objectives.velocity import PositionObjective
from reframe_jax.simulation import synthetic
from reframe_jax.solvers import Box


def test_the_kernel_finds_what_the_steps_find():
    keys = jax.random.split(jax.random.key(0), 3)
    poses = jax.vmap(lambda key: synthetic.simulate("K", key, noise=1e-3).poses)(keys)
    objective = PositionObjective(jax.jit(window_moments)(poses, jnp.full(50, 0.1))[1])
    box, key = Box(-jnp.ones(3), jnp.ones(3)), jax.random.key(4)
    solver = rf.BasinHopping(rf.ValleySteps(4), restarts=2, hops=2, polish=2)
    start = solver.init(objective, box, key)
    steps = jax.jit(lambda state: solver._advance(objective, box, state, 5))(start)
    first = solver._in_a_kernel(solver.inner, objective, box, start, 1, interpret=True)
    kernel = solver._in_a_kernel(solver.inner, objective, box, first, 4, interpret=True)
    assert kernel.best_x.shape == (3, 2, 3, 4)
    assert int(kernel.hop) == 5
    assert jax.random.key_data(kernel.key).tolist() == jax.random.key_data(steps.key).tolist()
    # rounding differs, and a step that hangs on it may choose otherwise: most problems agree
    for name in ("value", "best_value"):
        agree = np.abs(np.asarray(getattr(kernel, name) - getattr(steps, name))) < 1e-9
        assert np.mean(agree) > 0.7
    np.testing.assert_allclose(objective.value(kernel.best_x[:, 1]), kernel.best_value[1], rtol=1e-9)


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

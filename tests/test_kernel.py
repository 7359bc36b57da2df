"""Functions that become GPU kernels: by components they give the same numbers, and Mosaic takes them."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from reframe_jax.geometry import components, kernel
from reframe_jax.geometry.small import invert_symmetric, pick, solve_positive
from reframe_jax.geometry.symmetric import INDEX_PAIRS
from reframe_jax.model import amplitudes, crossed, rows, search, steps, table
from reframe_jax.objectives.moments import MONOMIALS

SCALES, PROBLEMS = 3, 4


def moments(rng, *shape, size=7):
    """Second moments (..., ..., S, 1, N) of random vectors (...)."""
    values = rng.normal(size=(*shape, size, SCALES, 1, PROBLEMS))
    return np.einsum("a...fskn,b...fskn->ab...skn", values, values) / size


def search_problem(rng):
    square = moments(rng, 12).reshape(3, 4, 3, 4, SCALES, 1, 1, PROBLEMS)
    coefficients = [
        [square[i, a, j, b] if a == b else square[i, a, j, b] + square[i, b, j, a] for a, b in MONOMIALS]
        for i, j in INDEX_PAIRS
    ]
    counts = rng.uniform(5, 50, (SCALES, 1, 1, PROBLEMS))
    return np.array(coefficients), counts, np.full((1, 1, PROBLEMS), 2.0)


def fit_problem(rng):
    whole = moments(rng, 21)
    held = rng.uniform(size=(9, 1, PROBLEMS)) < 0.6
    problem = steps.Problem(
        turns=whole[18:, 18:],
        paths=whole[:12, :12].reshape(3, 4, 3, 4, SCALES, 1, PROBLEMS),
        rows=whole[12:18, 12:18],
        held_turns=held[:3],
        held_paths=held[3:6],
        held_row=held[6],
        pitch=held[7],
        tilted=held[8],
        tie=held[8],
        details=rng.uniform(5, 50, (SCALES, 1, PROBLEMS)),
        scale=np.full((1, PROBLEMS), 0.1),
        box=np.full((1, PROBLEMS), 2.0),
    )
    frame = np.broadcast_to(np.eye(3)[:, :, None, None], (3, 3, 1, PROBLEMS))
    zeros = np.zeros((3, 1, PROBLEMS))
    return problem, steps.Unknowns(frame, zeros + 0.1, zeros[:2] + 0.01, zeros[0])


def pair_problem(rng):
    forms = moments(rng, 9).reshape(3, 3, 3, 3, SCALES, 1, PROBLEMS)
    a, b = (v / np.linalg.norm(v, axis=0) for v in rng.normal(size=(2, 3, 2, PROBLEMS)))
    return forms, np.full((SCALES, 1, PROBLEMS), 20.0), rng.normal(size=(3, 3, 1, PROBLEMS)) / 3, a, b


def amplitude_problem(rng):
    form, levers = moments(rng, 12), moments(rng, 3)[:, :, 0]
    entry = table.entries_at(np.arange(2 * PROBLEMS).reshape(2, PROBLEMS) % len(table.ENTRIES))
    frame = np.linalg.qr(rng.normal(size=(2, PROBLEMS, 3, 3)))[0].transpose(2, 3, 0, 1)
    at = steps.Unknowns(frame, *rng.normal(size=(3, 3, 2, PROBLEMS))[:2] / 9, rng.normal(size=(2, PROBLEMS)))
    at = at._replace(tilt=at.tilt[:2])
    spectra = amplitudes.Spectra(
        rng.uniform(5, 50, (SCALES, 1, PROBLEMS)),
        rng.uniform(0.1, 1, (SCALES, 1, PROBLEMS)),
        rng.uniform(0.1, 1, (SCALES, 1, PROBLEMS)),
        rng.uniform(0, 0.1, (2, 1, PROBLEMS)),
    )
    forms = rows.Forms(form[:3, :3], form[3:9, 3:9], form[:3, 3:9])
    sine = rng.uniform(0.5, 1, (1, PROBLEMS))
    return forms, form[9:, 9:], at, entry, levers, sine, spectra


CASES = {
    "amplitudes": (amplitudes.amplitudes_of, 2, amplitude_problem),
    "tangent": (search._tangent_steps, 3, lambda r: (*search_problem(r), r.normal(size=(3, 1, 2, PROBLEMS)))),
    "newton": (search._newton_steps, 3, lambda r: (*search_problem(r), r.normal(size=(3, 1, 1, PROBLEMS)))),
    "fit": (steps.descend, 2, lambda r: (*fit_problem(r), np.int32(4))),
    "pair": (partial(crossed.crossed_axes, steps=4), 2, pair_problem),
}


def by_components(function, axes, *arguments):
    """Compute a function as a kernel does, on any processor."""
    leaves = jax.tree.leaves(arguments)
    problems = np.broadcast_shapes(*(leaf.shape[-axes:] for leaf in leaves if leaf.ndim))
    program, results = kernel.trace_for_one(function, axes, *arguments)

    def inputs(leaf):
        whole = leaf
        if leaf.ndim:
            whole = jnp.broadcast_to(leaf, leaf.shape[:-axes] + problems).reshape(*leaf.shape[:-axes], -1)
        load = (lambda index: whole[tuple(index[:-axes])]) if leaf.ndim else (lambda _: whole)
        return components.components(kernel._of_one(leaf, axes), load)

    own = components.Components((int(np.prod(problems)),))
    found = own.run(program, [inputs(leaf) for leaf in leaves])
    flat, structure = jax.tree.flatten(results)
    values = [
        jnp.stack([own.vector(own.loaded(c), shape.dtype) for c in value.flat]).reshape(
            shape.shape[:-axes] + problems
        )
        for value, shape in zip(found, flat, strict=True)
    ]
    return jax.tree.unflatten(structure, values)


@pytest.fixture(autouse=True)
def on_a_gpu(monkeypatch):
    """Trace functions as on a GPU, without what only processors need."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")


@pytest.mark.parametrize("name", CASES)
def test_components_give_the_same_numbers(name):
    function, axes, make = CASES[name]
    arguments = jax.tree.map(jnp.asarray, make(np.random.default_rng(0)))
    expected, found = jax.jit(function)(*arguments), by_components(function, axes, *arguments)
    for one, other in zip(jax.tree.leaves(expected), jax.tree.leaves(found), strict=True):
        np.testing.assert_allclose(other, one, atol=1e-5 * (1 + np.max(np.abs(one))))


@pytest.mark.parametrize("name", CASES)
def test_mosaic_takes_the_functions(name):
    function, axes, make = CASES[name]

    def wide(leaf):
        leaf = np.asarray(leaf)
        return jax.ShapeDtypeStruct((*leaf.shape[:-1], 256) if leaf.ndim else (), leaf.dtype)

    shapes = jax.tree.map(wide, make(np.random.default_rng(0)))
    traced = jax.jit(partial(kernel.call_kernel, function, axes)).trace(*shapes)
    assert "mosaic_gpu" in traced.lower(lowering_platforms=("cuda",)).as_text()


def test_moves_constants_and_choices():
    """Operations that the model does not use in kernels now, but functions of the same kind may."""

    def function(x, index, flags):
        table = jnp.asarray(np.arange(12.0).reshape(4, 3)[:, :, None])
        parts = jnp.concatenate([x[::2], table[:, 0] * x[0]])
        chosen = pick(parts, index, 0)[0]
        low = jnp.argmin(parts, axis=0)
        inverse, det = invert_symmetric([x[0] + 3, 0 * x[1], x[2] * 0.1, x[1] ** 2 + 2, x[3], 4 + 0 * x[0]])
        return jnp.where(flags, chosen, -chosen), low, inverse.transpose(1, 0, 2), det

    rng = np.random.default_rng(1)
    x, index = jnp.asarray(rng.uniform(0, 1, (5, PROBLEMS))), jnp.asarray(rng.integers(0, 7, (1, PROBLEMS)))
    flags = jnp.asarray(rng.uniform(size=PROBLEMS) < 0.5)
    expected, found = function(x, index, flags), by_components(function, 1, x, index, flags)
    for one, other in zip(expected, found, strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-6)


def test_other_processors_compute_functions_as_they_are():
    x = jnp.ones((3, 128))
    assert solve_positive(jnp.eye(3)[:, :, None] * x, x).shape == x.shape
    found = kernel.in_registers(lambda a: 2 * a, 1)(x)
    np.testing.assert_array_equal(found, 2 * x)

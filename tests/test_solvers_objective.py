"""Objectives of one's own: what a solver needs of them, and what it says of those that lack it."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from planted_problems import FRAMES, KEY, POSITIONS, compiled, four_moments

from reframe_jax import objectives, solvers
from reframe_jax.objectives import FrameObjective, MomentsObjective, Objective, PositionObjective
from reframe_jax.solvers import (
    BasinHopping,
    Box,
    FrameSteps,
    JointSearch,
    NewtonSteps,
    OptaxSteps,
    ValleySteps,
)

SQUARE = Box(jnp.asarray([-2.0, -2.0]), jnp.asarray([2.0, 2.0]))
BOTTOMS = np.array([[0.5, -1.2, 1.1], [-0.3, 0.7, 1.4]])  # (2, 3), of three problems
DEPTHS = np.array([1e-4, 1e-2, 1.0])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Bowls:
    """log of (depth + |x - bottom|^2), and a shallower bowl at the opposite point."""

    bottom: jax.Array  # (2, ...)
    depth: jax.Array  # (...)
    dim = 2

    @property
    def batch(self):
        return self.depth.shape

    @property
    def dtype(self):
        return self.depth.dtype

    def value(self, x):
        here, opposite = (jnp.sum((x + sign * self.bottom) ** 2, axis=0) for sign in (-1, 1))
        return jnp.log(self.depth + jnp.minimum(here, 0.5 + opposite))


BOWLS = Bowls(jnp.asarray(BOTTOMS), jnp.asarray(DEPTHS))


@pytest.mark.parametrize(
    ("inner", "atol"),
    [(NewtonSteps(12), 1e-6), (OptaxSteps(optax.adam(0.05), 200), 0.03)],
    ids=["newton", "adam"],
)
def test_any_objective_is_minimised(inner, atol):
    """Without moments, with two leaves of different rank: the deeper of two bowls, problem by problem."""
    solver = BasinHopping(inner, restarts=4, hops=1)
    with jax.numpy_dtype_promotion("standard"):  # Optax mixes types of integers
        found = compiled(solver.minimise)(BOWLS, SQUARE, KEY)
    np.testing.assert_allclose(found.x, BOTTOMS, atol=atol)
    np.testing.assert_allclose(found.value, np.log(DEPTHS), atol=atol if inner == NewtonSteps(12) else 3)


def test_any_shape_of_problems():
    """One problem, and a grid of them, are found as in a row."""
    solver = BasinHopping(NewtonSteps(12), restarts=4, hops=0, polish=0)
    search = compiled(solver.minimise)
    single = search(jax.tree.map(lambda a: a[..., 1], BOWLS), SQUARE, KEY)
    assert single.x.shape == (2,)
    np.testing.assert_allclose(single.x, BOTTOMS[:, 1], atol=1e-6)
    grid = jax.tree.map(lambda a: jnp.stack([a, a[..., ::-1]], axis=-2), BOWLS)
    found = search(grid, SQUARE, KEY)
    assert found.value.shape == (2, 3)
    np.testing.assert_allclose(found.x, np.stack([BOTTOMS, BOTTOMS[:, ::-1]], axis=1), atol=1e-6)


def test_a_norm_of_ones_own_gets_the_steps_of_moments():
    """Not the class decides but the moments, the exponent and the unknowns."""

    @jax.tree_util.register_dataclass
    @dataclass(frozen=True)
    class Norm:
        moments: jax.Array
        exponent = 0.0
        unknowns = "position"
        dim = 3
        batch = property(lambda self: self.moments.shape[2:])
        dtype = property(lambda self: self.moments.dtype)

        def value(self, x):
            return PositionObjective(self.moments).value(x)

    def program(kind):
        return str(jax.make_jaxpr(lambda m, x: ValleySteps(2)(kind(m), POSITIONS, x))(four_moments(), x))

    x = jnp.zeros((3, 4))
    assert program(Norm) == program(PositionObjective)


def test_steps_that_want_moments():
    frames = FrameObjective(four_moments())
    for objective in (frames, FrameObjective(four_moments()[:, :1]), BOWLS):
        with pytest.raises(ValueError, match=f"PositionObjective.*not a {type(objective).__name__}"):
            ValleySteps(1)(objective, POSITIONS, jnp.zeros((3, 4)))
        with pytest.raises(ValueError, match=f"not a {type(objective).__name__}"):
            JointSearch(BasinHopping(FrameSteps(1)), ValleySteps(1)).minimise(objective, POSITIONS, KEY)
    for objective in (PositionObjective(four_moments()), BOWLS):
        with pytest.raises(ValueError, match=f"FrameObjective.*not a {type(objective).__name__}"):
            FrameSteps(1)(objective, FRAMES, jnp.zeros((6, 4)))
    with pytest.raises(ValueError, match="not a Bowls"):
        BasinHopping(ValleySteps(1)).minimise(BOWLS, SQUARE, KEY)


def start(objective):
    return BasinHopping(NewtonSteps(1)).init(objective, SQUARE, KEY)


def test_what_is_no_objective_is_named():
    class Half:
        dim = 2

        def value(self, x):
            return jnp.sum(x**2, axis=0)

    with pytest.raises(ValueError, match="Half has no batch, dtype"):
        start(Half())

    class Whole(Half):
        batch, dtype = (), jnp.dtype("float64")

    with pytest.raises(ValueError, match="register Whole"):
        start(Whole())
    with pytest.raises(ValueError, match=r"here \(3,\); Bowls.bottom has the shape \(2,\)"):
        start(Bowls(jnp.zeros(2), jnp.zeros(3)))
    with pytest.raises(ValueError, match=r"here \(2, 3\); Bowls.bottom has the shape \(3,\)"):
        start(Bowls(jnp.zeros(3), jnp.zeros((2, 3))))


def test_the_protocol_is_public():
    assert solvers.Objective is objectives.Objective is Objective
    for objective in (FrameObjective(four_moments()), PositionObjective(four_moments())):
        assert isinstance(objective, Objective)
        assert isinstance(objective, MomentsObjective)
    assert isinstance(BOWLS, Objective)
    assert not isinstance(BOWLS, MomentsObjective)

"""A local minimizer of any objective by Newton steps, with derivatives by automatic differentiation."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import jax
import jax.numpy as jnp

from reframe_jax.objectives.protocol import Objective
from reframe_jax.solvers.protocol import BatchSteps, Box

_POWERS = (0.0, 1.0, 2.0, 3.0, 6.0)  # exponents s of the Newton steps on J^s
_PARTS = (1.0, 0.25, 0.05)  # fractions of the descent step for an indefinite Hessian
_RIDGE = 1e-11  # added to the diagonal, as a fraction of the row sum, for directions without curvature

_Point = TypeVar("_Point")


def newton_steps(gradient: jax.Array, hessian: jax.Array) -> jax.Array:
    """Return eight candidate steps (8, dim) to lower f = log J; subtract a step from the unknowns.

    With the gradient g and the Hessian H of f, the Newton step on J^s is H^-1 g / (1 + s g.H^-1 g); only its
    length depends on s. The steps with s = 6, 3 and 2 are exact if one, two or three axes of the geometric
    mean are constrained; the step with s = 1 is exact if a single axis dominates. Far from the optimum, H = L
    D L^T is indefinite; the last three candidates descend with L |D| L^T instead.
    """
    dim = gradient.shape[0]
    ridge = _RIDGE * jnp.sum(jnp.abs(hessian), axis=1)
    rows = jnp.concatenate([hessian, gradient[:, None]], axis=1)
    for j in range(dim):
        pivot = rows[j, j] + ridge[j]
        rows = rows.at[j, j].set(jnp.where(pivot == 0, 1, pivot))
        rows = rows.at[j + 1 :].add(-(rows[j + 1 :, j] / rows[j, j])[:, None] * rows[j][None])
    pivots = jnp.diagonal(rows)
    solved = rows[:, -1][None] / jnp.stack([pivots, jnp.abs(pivots)])
    for j in reversed(range(dim)):
        solved = solved.at[:, :j].add(-solved[:, j, None] * (rows[:j, j] / pivots[:j])[None])
    newton, descent = solved
    slope = jnp.sum(newton * gradient)
    return jnp.stack([*(newton / (1 + s * slope) for s in _POWERS), *(part * descent for part in _PARTS)])


def derivatives(value: Callable[[jax.Array], jax.Array], x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the gradient (dim,) and the Hessian (dim, dim) at x, (dim,); zero if any entry is not finite."""
    gradient, hessian = jax.grad(value)(x), jax.hessian(value)(x)
    finite = jnp.all(jnp.isfinite(hessian)) & jnp.all(jnp.isfinite(gradient))
    return jnp.where(finite, gradient, 0), jnp.where(finite, hessian, 0)


def steps_in_box(
    x: jax.Array, low: jax.Array, high: jax.Array, gradient: jax.Array, hessian: jax.Array
) -> jax.Array:
    """Return :func:`newton_steps` in which a coordinate on a face of the box does not leave the box.

    Such a coordinate is held constant if the gradient points out of the box, or if the Newton step does.
    The unknowns x and the bounds are (dim,); the gradient and the Hessian are those of f at x.
    """
    unit = jnp.eye(len(x), dtype=x.dtype)
    out = gradient
    for _ in range(2):
        held = ((x <= low) & (out > 0)) | ((x >= high) & (out < 0))
        gradient = jnp.where(held, 0, gradient)
        hessian = jnp.where(held[:, None] | held[None, :], unit, hessian)
        steps = newton_steps(gradient, hessian)
        out = steps[0]
    return steps


def take_best_steps(
    start: _Point,
    value_of: Callable[[_Point], jax.Array],
    steps_at: Callable[[_Point], jax.Array],
    move: Callable[[_Point, jax.Array], _Point],
    count: int,
) -> tuple[_Point, jax.Array]:
    """Repeat: try candidate steps, and take the step with the lowest value; stay if no step lowers the value.

    A point is a pytree. ``steps_at`` maps a point to candidate steps (C, dim); ``move`` maps a point and a
    step (dim,) to the next point. The result is the last point and its value.
    """

    def advance(_: int, carry: tuple[_Point, jax.Array]) -> tuple[_Point, jax.Array]:
        here, best = carry
        points = jax.vmap(lambda step: move(here, step))(steps_at(here))
        values = jax.vmap(value_of)(points)
        values = jnp.where(jnp.isnan(values), jnp.inf, values)
        lowest = jnp.argmin(values)
        better = values[lowest] < best
        there = jax.tree.map(lambda new, old: jnp.where(better, new[lowest], old), points, here)
        return there, jnp.where(better, values[lowest], best)

    return jax.lax.fori_loop(0, count, advance, (start, value_of(start)))


@dataclass(frozen=True)
class NewtonSteps(BatchSteps):
    """Local minimizer of any :class:`Objective`, by Newton steps over all unknowns together.

    Attributes:
        steps: number of steps, equal for all problems of a batch.
    """

    steps: int = 30

    def _minimise_one(self, objective: Objective, box: Box, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        def steps_at(x: jax.Array) -> jax.Array:
            return steps_in_box(x, box.low, box.high, *derivatives(objective.value, x))

        return take_best_steps(x, objective.value, steps_at, lambda x, step: box.clip(x - step), self.steps)

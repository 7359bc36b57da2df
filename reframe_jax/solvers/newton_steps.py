"""Second-order local steps on any objective, with derivatives by automatic differentiation."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from reframe_jax.geometry.products import apply
from reframe_jax.objectives.protocol import Objective
from reframe_jax.solvers.box import Box
from reframe_jax.solvers.problems import minimise_each

__all__ = ["NewtonSteps"]

_FLAT = 1e-9  # curvature below this share of the largest counts as this share: a free direction


@dataclass(frozen=True)
class NewtonSteps:
    """Local minimizer by Newton steps on powers of the norm, orientation and origin together.

    The idea of :class:`ValleySteps` and :class:`FrameSteps` without their closed forms: with H and g of
    f = log J, the Newton step on J^s is H^-1 g / (1 + s g.H^-1 g), one direction for every s; s = 6, 3
    and 2 are exact where one, two or three axes of the geometric mean are constrained, s = 1 where a
    single axis dominates. Far from the optimum H is indefinite and the step on ``|H|`` descends. The best
    of all is kept.

    Attributes:
        steps: number of steps; fixed, so that no problem waits for another.
    """

    steps: int = 30

    def __call__(self, objective: Objective, box: Box, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Improve the unknowns x, (dim, ...), every problem by itself.

        Returns:
            The new unknowns and their values, (...).
        """
        return minimise_each(self._minimise_one, objective, box, x)

    def _minimise_one(self, objective: Objective, box: Box, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        def step(carry: tuple[jax.Array, jax.Array], _: None) -> tuple[tuple[jax.Array, jax.Array], None]:
            x, best = carry
            gradient = jax.grad(objective.value)(x)
            hessian = jax.hessian(objective.value)(x)
            held = ((x <= box.low) & (gradient > 0)) | ((x >= box.high) & (gradient < 0))
            gradient = jnp.where(held, 0, gradient)
            hessian = jnp.where(held[:, None] | held[None, :], 0, hessian)
            finite = jnp.all(jnp.isfinite(hessian)) & jnp.all(jnp.isfinite(gradient))
            hessian, gradient = jnp.where(finite, hessian, 0), jnp.where(finite, gradient, 0)
            curvature, axes = jnp.linalg.eigh(hessian)
            largest = jnp.max(jnp.abs(curvature))
            floor = jnp.maximum(_FLAT * largest, jnp.finfo(x.dtype).tiny)
            strength = jnp.maximum(jnp.abs(curvature), floor)
            along = apply(axes.T, gradient)
            newton = apply(axes, jnp.where(curvature < 0, -along, along) / strength)
            descent = apply(axes, along / strength)
            slope = jnp.sum(newton * gradient)
            directions: list[tuple[jax.Array, Any]] = [(descent, s) for s in (1.0, 0.25, 0.05)]
            directions += [(newton, 1 / (1 + s * slope)) for s in (0.0, 1.0, 2.0, 3.0, 6.0)]
            trials = jnp.stack([x - length * direction for direction, length in directions])
            trials = jnp.clip(trials, box.low[None], box.high[None])
            values = jax.vmap(objective.value)(trials)
            values = jnp.where(jnp.isnan(values), jnp.inf, values)
            i = jnp.argmin(values)
            better = values[i] < best
            return (jnp.where(better, trials[i], x), jnp.where(better, values[i], best)), None

        (x, value), _ = jax.lax.scan(step, (x, objective.value(x)), length=self.steps)
        return x, value

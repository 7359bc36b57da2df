"""A local minimizer of any objective by an Optax gradient transformation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from reframe_jax.objectives.protocol import Objective
from reframe_jax.solvers.protocol import BatchSteps, Box

if TYPE_CHECKING:
    import optax


@dataclass(frozen=True)
class OptaxSteps(BatchSteps):
    """Local minimizer of any :class:`Objective`, by the updates of an Optax gradient transformation.

    The unknowns stay in the box, because the updates act on :meth:`Box.unfold` of the unknowns.

    Attributes:
        transformation: any ``optax.GradientTransformation``. L-BFGS and line searches receive the value and
            the value function. Reuse one instance: JAX compiles a program for every new instance.
        steps: number of updates, equal for all problems of a batch.
    """

    transformation: optax.GradientTransformation
    steps: int = 60

    def _minimise_one(self, objective: Objective, box: Box, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        import optax  # takes a tenth of the time of importing this package

        transformation = optax.with_extra_args_support(self.transformation)

        def value_of(z: jax.Array) -> jax.Array:
            value = objective.value(box.fold(z))
            return jnp.where(jnp.isnan(value), jnp.inf, value)

        def step(carry: tuple[Any, ...], _: None) -> tuple[tuple[Any, ...], None]:
            z, state, best_z, best = carry
            value, gradient = jax.value_and_grad(value_of)(z)
            gradient = jnp.where(jnp.isfinite(gradient), gradient, 0)
            better = value < best
            best_z, best = jnp.where(better, z, best_z), jnp.where(better, value, best)
            extra = {"value": value, "grad": gradient, "value_fn": value_of}
            updates, state = transformation.update(gradient, state, z, **extra)
            moved = z + updates
            return (jnp.where(jnp.isfinite(moved), moved, best_z), state, best_z, best), None

        z = box.unfold(x)
        start = (z, transformation.init(z), z, value_of(z))
        (z, _, best_z, best), _ = jax.lax.scan(step, start, length=self.steps)
        value = value_of(z)
        better = value < best
        return box.fold(jnp.where(better, z, best_z)), jnp.where(better, value, best)

"""Derivatives of an optimum, from the implicit function theorem instead of the search."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import custom_jvp

from reframe_jax.geometry.products import apply
from reframe_jax.objectives.protocol import Objective
from reframe_jax.solvers.box import Box
from reframe_jax.solvers.problems import flatten_problems

__all__ = ["attach_derivative"]

_FLAT = 1e-9  # curvature below this share of the largest: the direction is free and contributes nothing


@custom_jvp
def attach_derivative(x: jax.Array, objective: Objective, box: Box) -> jax.Array:
    """The optimum x, (dim, ...), as a differentiable function of the objective's data.

    Where the gradient g(x, data) vanishes, dx = -H^-1 (dg/d data) d data. Unknowns on the bounds stay
    there, and directions in which the objective is flat contribute nothing. How x was found does not matter:
    its own derivative is ignored. Supports derivatives of any order, forward and reverse.
    """
    return x


@attach_derivative.defjvp
def _attach_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[jax.Array, jax.Array]:
    x, objective, box = primals
    x = attach_derivative(x, objective, box)
    low, high = box.bounds(x)

    def one(x: jax.Array, inside: jax.Array, objective: Objective, change: Objective) -> jax.Array:
        def gradient(objective: Objective) -> jax.Array:
            return jax.grad(objective.value)(x)

        _, rate = jax.jvp(gradient, (objective,), (change,))
        hessian = jax.hessian(objective.value)(x)
        hessian = jnp.where(inside[:, None] & inside[None, :], hessian, 0)
        curvature, axes = jnp.linalg.eigh(hessian)
        stiff = curvature > _FLAT * jnp.max(curvature)
        along = apply(axes.T, jnp.where(inside, rate, 0))
        return -apply(axes, jnp.where(stiff, along / jnp.where(stiff, curvature, 1), 0))

    of_problems = x, (x > low) & (x < high), objective, tangents[1]
    flat = flatten_problems(of_problems, x.ndim - 1)
    change = jax.vmap(one, in_axes=(-1, -1, -1, -1), out_axes=-1)(*flat)
    return x, change.reshape(x.shape)

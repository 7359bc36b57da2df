"""Repeat problems, and apply a function to each problem, where the trailing axes of arrays are problems."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from reframe_jax.objectives.protocol import Objective
from reframe_jax.solvers.box import Box

_T = TypeVar("_T")


def repeat_problems(tree: _T, axes: int, count: int) -> _T:
    """Repeat every problem along a new axis before the axes of the problems.

    Args:
        tree: pytree of arrays whose last ``axes`` axes are problems.
        axes: number of problem axes.
        count: number of repetitions.
    """

    def repeat(a: jax.Array) -> jax.Array:
        place = a.ndim - axes
        shape = (*a.shape[:place], count, *a.shape[place:])
        return jnp.broadcast_to(jnp.expand_dims(a, place), shape)

    return jax.tree.map(repeat, tree)


def minimise_each(
    minimise_one: Callable[[Any, Box, jax.Array], tuple[jax.Array, jax.Array]],
    objective: Objective,
    box: Box,
    x: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Apply a minimizer of one problem to every problem of a batch.

    Args:
        minimise_one: function from an objective, a box and a start (dim,) to unknowns (dim,) and their value.
        objective: the problems.
        box: bounds of the search.
        x: (dim, ...) starts.

    Returns:
        Unknowns (dim, ...) and their values (...).
    """
    batch = x.shape[1:]
    flat = jax.tree.map(lambda a: a.reshape(*a.shape[: a.ndim - len(batch)], -1), (objective, x))
    found, values = jax.vmap(minimise_one, in_axes=(-1, None, -1), out_axes=-1)(flat[0], box, flat[1])
    return found.reshape(x.shape), values.reshape(batch)

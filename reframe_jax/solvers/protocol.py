"""The protocol of solvers for ``identify``, their box, and helpers of solvers for batches of problems."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import jax
import jax.numpy as jnp

from reframe_jax.objectives.protocol import Objective

_T = TypeVar("_T")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Box:
    """Lower and upper bounds of the unknowns of a search.

    Attributes:
        low, high: (dim,) bounds of all problems, in the units of the unknowns: rad for rotation vectors, m
            for positions.
    """

    low: jax.Array
    high: jax.Array

    def bounds(self, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the lower and the upper bounds, reshaped for operations with unknowns x, (dim, ...)."""
        shape = (-1, *([1] * (x.ndim - 1)))
        return self.low.reshape(shape), self.high.reshape(shape)

    def clip(self, x: jax.Array) -> jax.Array:
        """Move unknowns (dim, ...) outside the box to the nearest point of the box."""
        return jnp.clip(x, *self.bounds(x))

    def scale(self, unit: jax.Array) -> jax.Array:
        """Map points (dim, ...) of the unit cube to the box."""
        low, high = self.bounds(unit)
        return low + (high - low) * unit

    def fold(self, z: jax.Array) -> jax.Array:
        """Map any vector z (dim,) to a point of the box, by a sine per component.

        A minimizer without bounds can search over z: the map is smooth and reaches every point of the box,
        also on its faces, where the slope is zero.
        """
        return (self.high + self.low) / 2 + (self.high - self.low) / 2 * jnp.sin(z)

    def unfold(self, x: jax.Array) -> jax.Array:
        """Return a vector z (dim,) that :meth:`fold` maps to a point x of the box."""
        return jnp.arcsin(jnp.clip((2 * x - self.high - self.low) / (self.high - self.low), -1, 1))


LocalMinimiser = Callable[[Objective, Box, jax.Array], tuple[jax.Array, jax.Array]]
"""A local minimizer of every problem: ``minimise(objective, box, x)`` with starts x, (dim, ...).

It returns the best unknowns (dim, ...) and their values (...), and must treat the problems independently.
"""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Solution:
    """Result of a global search.

    Attributes:
        x: (dim, ...) best unknowns of every problem.
        value: (...) objective at ``x``; for a norm, log J.
        agreement: (...) fraction of the chains that ended within 0.001 of the best value (0.1 % of the norm).
            A low fraction means that the search may have missed the optimum.
    """

    x: jax.Array
    value: jax.Array
    agreement: jax.Array


class Solver(Protocol):
    """The method that ``identify`` calls. Solvers must be hashable: they are static in compiled programs."""

    def minimise(self, objective: Objective, box: Box, key: jax.Array) -> Solution:
        """Find the global minimum of every problem in the box.

        Args:
            objective: the problems.
            box: bounds of the search.
            key: JAX random key.
        """


def repeat_problems(tree: _T, axes: int, count: int) -> _T:
    """Repeat the problems, the last ``axes`` axes of every array, along a new axis before these axes."""

    def repeat(a: jax.Array) -> jax.Array:
        place = a.ndim - axes
        return jnp.broadcast_to(jnp.expand_dims(a, place), (*a.shape[:place], count, *a.shape[place:]))

    return jax.tree.map(repeat, tree)


class BatchSteps:
    """Base of the local minimizers: apply the method for one problem to every problem of a batch."""

    def __call__(self, objective: Objective, box: Box, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Minimize every problem from starts x, (dim, ...); see :data:`LocalMinimiser`."""
        batch = x.shape[1:]
        flat = jax.tree.map(lambda a: a.reshape(*a.shape[: a.ndim - len(batch)], -1), (objective, x))
        one = jax.vmap(self._minimise_one, in_axes=(-1, None, -1), out_axes=-1)
        found, values = one(flat[0], box, flat[1])
        return found.reshape(x.shape), values.reshape(batch)

    def _minimise_one(self, objective: Any, box: Box, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Minimize one problem from a start x, (dim,)."""
        raise NotImplementedError

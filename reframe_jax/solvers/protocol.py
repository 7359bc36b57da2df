"""The protocols of solvers, and their result."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import jax

from reframe_jax.objectives.protocol import Objective
from reframe_jax.solvers.box import Box

__all__ = ["LocalMinimiser", "Solution", "Solver"]

LocalMinimiser = Callable[[Objective, Box, jax.Array], tuple[jax.Array, jax.Array]]
"""(objective, box, x (dim, ...)) -> (x, value): an improvement of every problem by itself."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Solution:
    """Result of a global search.

    Attributes:
        x: (dim, ...) best unknowns of every problem.
        value: (...) objective there; for a norm, log J.
        agreement: (...) share of the restarts that ended within 0.1 % of the best norm, 0.001 of its value.
    """

    x: jax.Array
    value: jax.Array
    agreement: jax.Array


class Solver(Protocol):
    """The protocol that ``identify`` expects of a solver. Solvers are static arguments: make them hashable.

    You can step the search of :class:`BasinHopping` by hand: ``init`` makes a state, ``step`` advances it,
    and ``finish`` turns it into a :class:`Solution`.
    """

    def minimise(self, objective: Objective, box: Box, key: jax.Array) -> Solution:
        """Search every problem of the objective.

        Args:
            objective: the problems.
            box: where to search.
            key: JAX random key.
        """
        ...

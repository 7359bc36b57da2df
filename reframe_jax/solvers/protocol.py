"""The protocols of solvers, and their result."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import jax

from reframe_jax.objectives.protocol import Objective
from reframe_jax.solvers.box import Box

__all__ = ["LocalMinimiser", "Solution", "Solver"]

LocalMinimiser = Callable[[Objective, Box, jax.Array], tuple[jax.Array, jax.Array]]
"""(objective, box, x (dim, ...)) -> (x, value): a local minimizer that treats problems independently."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Solution:
    """Result of a global search.

    Attributes:
        x: (dim, ...) best unknowns of every problem.
        value: (...) objective at ``x``; for a norm, log J.
        agreement: (...) fraction of the restarts that ended within 0.001 of the best value (0.1 % of the
            norm).
    """

    x: jax.Array
    value: jax.Array
    agreement: jax.Array


class Solver(Protocol):
    """The protocol of solvers for ``identify``. Solvers are static arguments and must be hashable.

    :class:`BasinHopping` also offers single steps: ``init`` makes a state, ``step`` advances the state, and
    ``finish`` converts the state to a :class:`Solution`.
    """

    def minimise(self, objective: Objective, box: Box, key: jax.Array) -> Solution:
        """Search every problem of the objective.

        Args:
            objective: the problems.
            box: bounds of the search.
            key: JAX random key.
        """
        ...

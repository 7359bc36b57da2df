"""What a solver is for ``identify``: its methods, and the result that it returns."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import jax

from reframe_jax.objectives.protocol import Objective
from reframe_jax.solvers.box import Box

LocalMinimiser = Callable[[Objective, Box, jax.Array], tuple[jax.Array, jax.Array]]
"""A local minimizer: a function from an objective, a box and starts (dim, ...) to unknowns and their values.

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
        ...

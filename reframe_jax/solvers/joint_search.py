"""Search origins by a search over whole frames."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from reframe_jax.objectives.protocol import Objective
from reframe_jax.objectives.velocity import FrameObjective
from reframe_jax.solvers.basin_hopping import BasinHopping
from reframe_jax.solvers.box import Box
from reframe_jax.solvers.protocol import Solution
from reframe_jax.solvers.valley_steps import ValleySteps

__all__ = ["JointSearch"]


@dataclass(frozen=True)
class JointSearch:
    """Search of a :class:`PositionObjective` through the :class:`FrameObjective` with the same moments.

    With a negative exponent, the axis with the least motion dominates J. If the rotation is eliminated, each
    chain falls into the nearest of many narrow minima, where some axis does not move. Chains over whole
    frames start with different axes, reach different minima, and miss fewer optima in less time.

    Attributes:
        search: solver over orientation and origin together, with :class:`FrameSteps` as local minimizer.
        refine: local minimizer for the origin of the best frame, with the best axes at every point.
    """

    search: BasinHopping
    refine: ValleySteps

    def minimise(self, objective: Objective, box: Box, key: jax.Array) -> Solution:
        """Search every problem of the objective.

        Raises:
            ValueError: unless :class:`ValleySteps` can minimize the objective.
        """
        known = self.refine.check(objective)
        turn = jnp.full_like(box.low, jnp.pi)
        frames = Box(jnp.concatenate([-turn, box.low]), jnp.concatenate([turn, box.high]))
        found = self.search.minimise(FrameObjective(known.moments, known.exponent), frames, key)
        x, value = self.refine(objective, box, found.x[3:])
        return Solution(x, value, found.agreement)

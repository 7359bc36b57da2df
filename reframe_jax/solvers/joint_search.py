"""Find the origin of a frame by a search over orientation and origin together."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from reframe_jax.objectives.protocol import Objective
from reframe_jax.objectives.velocity import FrameObjective
from reframe_jax.solvers.basin_hopping import BasinHopping
from reframe_jax.solvers.box import Box
from reframe_jax.solvers.protocol import Solution
from reframe_jax.solvers.valley_steps import ValleySteps


@dataclass(frozen=True)
class JointSearch:
    """Global search of a :class:`PositionObjective`, over the :class:`FrameObjective` with the same moments.

    With a negative exponent, the axis with the least motion dominates the norm. The norm then has many narrow
    minima over the origin, and a chain over origins ends in the nearest minimum. Chains over orientation and
    origin start with different axes and reach different minima, so they miss fewer optima in less time.

    Attributes:
        search: global search over orientation and origin, with :class:`FrameSteps` as local minimizer.
        refine: local minimizer for the origin of the best frame.
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

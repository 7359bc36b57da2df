"""Origins farther away than the box of the search: where its optimum points outwards, search a larger box.

At a face of the box, log J may still fall outwards. Along a direction that the motion leaves free it is flat
there, and nothing needs to be done. Where it is steep, the true origin may lie outside, and an optimum of
another type inside may be none. Those windows, and no others, are searched again in a larger box. Its optima
replace the former ones only if they are clearly likelier: noise has optima everywhere.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from reframe_jax.compilation import update_marked
from reframe_jax.objectives.velocity import PositionObjective
from reframe_jax.solvers import BasinHopping, Box, Solution, ValleySteps
from reframe_jax.solvers.valley_steps import slope_and_curvature

__all__ = ["SearchSpace", "is_steep", "widen_search"]

_STEEP = 5e-3  # fall of log J over half a width of the box, outwards
_LEAST = 1.0  # m, half a width that it is judged over at least: over a tiny box everything looks flat
_FEWEST = 12  # starts in the larger box
_EVIDENCE = 12.0  # of the far optimum against the near one, in the logarithm of their likelihoods


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SearchSpace:
    """Where origins are searched: first in one box, then, where that is too small, in a larger one.

    Attributes:
        near, far: m; equal where the user gave the bounds.
    """

    near: Box
    far: Box


def is_steep(objective: PositionObjective, box: Box, x: jax.Array) -> jax.Array:
    """Whether log J falls outwards from an origin (3, ...) on the faces of a box, (...) bool."""
    low, high = box.bounds(x)
    slope, _ = slope_and_curvature(objective, x)
    points = jnp.moveaxis(x, 0, -1)
    on_face = jnp.moveaxis(box.at_face(points), -1, 0)
    outwards = jnp.where(x > (low + high) / 2, -slope, slope) * jnp.maximum((high - low) / 2, _LEAST)
    return jnp.any(on_face & (outwards > _STEEP), axis=0)


def widen_search(
    objective: PositionObjective, space: SearchSpace, solution: Solution, samples: jax.Array, key: jax.Array
) -> tuple[Solution, Box, jax.Array]:
    """The optima of windows whose origins may lie outside the near box, from the far one.

    Args:
        objective: moments (6, 10, N, T), of all types.
        space: where to search.
        solution: of the search in the near box.
        samples: (N,) independent velocities.
        key: of the starts.

    Returns:
        The solutions, the box of every problem, and (N,) bool, whose optima are those of the far box.
    """
    near, far = space.near, space.far
    larger = jnp.any((far.low < near.low) | (far.high > near.high))
    steep = jnp.any(is_steep(objective, near, solution.x), axis=-1) & larger
    chains = 0 if solution.ends is None else solution.ends.shape[1]
    search = BasinHopping(ValleySteps(16), restarts=max(_FEWEST, chains), hops=0, polish=0)
    # with Gaussian velocities the logarithm of the likelihood is -3 log J for every sample
    margin = _EVIDENCE / (3 * samples)

    def look(block: tuple[jax.Array, Solution, jax.Array]) -> tuple[Solution, jax.Array]:
        moments, before, margin = block
        found = search.minimise(PositionObjective(moments, objective.exponent), far, key)
        gain = before.value - found.value
        widened = jnp.any(gain > margin[None], axis=0)
        found = _lowest_ends(found, chains)
        better = widened[None] & (gain > 0)
        return jax.tree.map(lambda new, old: jnp.where(better, new, old), found, before), widened

    # windows last
    inputs = jax.tree.map(lambda a: jnp.swapaxes(a, -1, -2), (objective.moments, solution))
    solution_so_far = inputs[1], jnp.zeros_like(steep)
    found, widened = update_marked(look, steep, (*inputs, margin), solution_so_far)
    found = jax.tree.map(lambda a: jnp.swapaxes(a, -1, -2), found)
    low, high = (
        jnp.where(widened[None, :, None], a[:, None, None], b[:, None, None])
        for a, b in ((far.low, near.low), (far.high, near.high))
    )
    shape = found.x.shape
    return found, Box(jnp.broadcast_to(low, shape), jnp.broadcast_to(high, shape)), widened


def _lowest_ends(found: Solution, chains: int) -> Solution:
    """The solution with so many ends, the lowest; none if there were none before."""
    if chains == 0 or found.ends is None or found.end_values is None:
        return Solution(found.x, found.value, found.agreement)
    order = jnp.argsort(found.end_values, axis=0)[:chains]
    ends = jnp.take_along_axis(found.ends, order[None], axis=1)
    return Solution(
        found.x, found.value, found.agreement, ends, jnp.take_along_axis(found.end_values, order, axis=0)
    )

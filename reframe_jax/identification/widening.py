"""Origins farther away than the box of the search: where its optimum points outwards, search a larger box.

At a face of the box, log J may still fall outwards. Along a direction that the motion leaves free it is flat
there, and nothing needs to be done. Where it is steep, the true origin may lie outside, and an optimum of
another type inside may be none.

Two kinds of motion have an optimum inside whatever they obey. A body that moves in a plane and turns has the
one of bodies that do nothing but that: a narrow valley outside may hold an origin that obeys more, and a few
starts find it. A body on a far hinge moves along one of its own axes, as along a contour: the origin that
moves least is compared.

Those windows, and no others, are searched again in a larger box. Its optima replace the former ones only if
they are clearly likelier: noise has optima everywhere.
"""

from dataclasses import dataclass

import jax

from reframe_jax.arrays import jnp
from reframe_jax.compilation import update_marked
from reframe_jax.geometry import symmetric
from reframe_jax.identification.floored_moments import FLOOR
from reframe_jax.objectives.velocity import PositionObjective
from reframe_jax.solvers import BasinHopping, Box, Solution, ValleySteps
from reframe_jax.solvers.seeds import stillest_origins
from reframe_jax.solvers.valley_steps import slope

__all__ = ["SearchSpace", "clear_gain", "is_steep", "widen_search"]

_STEEP = 5e-3  # fall of log J over half a width of the box, outwards
_LEAST = 1.0  # m, half a width that it is judged over at least: over a tiny box everything looks flat
_FEWEST = 12  # starts in the larger box
_PROBE = BasinHopping(ValleySteps(8), restarts=4, hops=0, polish=0)  # whether there is anything
_PLANE = 16.0  # of the motion of a planar origin: a square ratio, see _moves_in_plane
_ROUNDINGS = 1e4  # of the fastest axis' square, which that of the second exceeds
_EVIDENCE = 12.0  # of the far optimum against the near one, in the logarithm of their likelihoods
_MOST_SAMPLES = 15.0  # that count as independent where errors may be slow


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SearchSpace:
    """Where origins are searched: first in one box, then, where that is too small, in a larger one.

    Attributes:
        near, far: m; equal where the user gave the bounds.
    """

    near: Box
    far: Box

    @property
    def widens(self) -> jax.Array:
        """Whether there is a larger box to search, a bool."""
        return jnp.any((self.far.low < self.near.low) | (self.far.high > self.near.high))


def clear_gain(samples: jax.Array, slow_errors: bool) -> jax.Array:
    """How much lower log J is, (N,), at an origin that is clearly likelier than another one.

    With Gaussian velocities the logarithm of the likelihood is -3 log J for every independent sample.

    Args:
        samples: (N,) velocities that are independent if noise is all there is.
        slow_errors: whether there may be others. They change with the pose of the body as its motion does,
            and an origin far away, where they move it most, turns them into whatever is needed.
    """
    return _EVIDENCE / 3 * (1 / samples + (1 / _MOST_SAMPLES if slow_errors else 0))


def is_steep(objective: PositionObjective, box: Box, x: jax.Array, least: jax.Array) -> jax.Array:
    """Whether log J falls outwards from an origin (3, N, T) on the faces of a box, (N, T) bool.

    By more than ``least``, (N,), over half a width of the box.
    """
    low, high = box.bounds(x)
    points = jnp.moveaxis(x, 0, -1)
    on_face = jnp.moveaxis(box.at_face(points), -1, 0)
    fall = jnp.where(x > (low + high) / 2, -1, 1) * slope(objective, x)  # outwards, 1/m
    fall = fall * jnp.maximum((high - low) / 2, _LEAST)
    return jnp.any(on_face & (fall > jnp.maximum(least, _STEEP)[None, :, None]), axis=0)


def _slowest_origin(objective: PositionObjective, box: Box) -> jax.Array:
    """The origins (3, ...) of the box whose root mean square velocity is least, m: minima of the trace."""
    rounding = FLOOR * float(jnp.finfo(objective.dtype).eps)
    return stillest_origins(symmetric.trace(objective.moments), box, rounding)


def _moves_in_plane(objective: PositionObjective, solution: Solution) -> jax.Array:
    """Whether the origin of the best type moves along two axes, and much less along the third, (N,) bool.

    With squares a << b <= c of the velocities along the axes, the determinant of their covariance is abc, its
    trace c, and the sum of its principal minors bc. Where rounding makes b, it says nothing.
    """
    covariance = objective.covariance(solution.x)
    minors, trace = (symmetric.trace(m) for m in (symmetric.adjugate(covariance), covariance))
    flat = minors**2 > _PLANE * symmetric.determinant(covariance) * trace
    flat = flat & (minors > _ROUNDINGS * float(jnp.finfo(trace.dtype).eps) * trace**2)
    return jnp.take_along_axis(flat, jnp.argmin(solution.value, axis=-1)[:, None], axis=-1)[:, 0]


def _points_outside(
    objective: PositionObjective, space: SearchSpace, solution: Solution, margin: jax.Array
) -> jax.Array:
    """Whether log J falls outwards at a face of the near box, or is lower at an origin outside, (N,) bool."""
    steep = is_steep(objective, space.near, solution.x, jnp.zeros_like(margin))
    slowest = _slowest_origin(objective, space.far)
    low, high = space.near.bounds(slowest)
    elsewhere = jnp.any((slowest < low) | (slowest > high), axis=0)
    lower = solution.value - objective.value(slowest) > margin[:, None]
    return jnp.any(steep | (elsewhere & lower), axis=-1)


def widen_search(
    objective: PositionObjective,
    space: SearchSpace,
    solution: Solution,
    margin: jax.Array,
    turning: jax.Array,
    key: jax.Array,
) -> tuple[Solution, Box, jax.Array]:
    """The optima of windows whose origins may lie outside the near box, from the far one.

    Args:
        objective: moments (6, 10, N, T), of all types.
        space: where to search.
        solution: of the search in the near box.
        margin: (N,) see :func:`clear_gain`.
        turning: (N,) bool, windows whose body turns about a single axis.
        key: of the starts.

    Returns:
        The solutions, the box of every problem, and (N,) bool, whose optima are those of the far box.
    """
    near, far = space.near, space.far
    larger = space.widens
    chains = 0 if solution.ends is None else solution.ends.shape[1]
    outside = _points_outside(objective, space, solution, margin) & larger
    planar = turning & _moves_in_plane(objective, solution) & larger

    def probe(block: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        moments, value, margin = block
        found = _PROBE.minimise(PositionObjective(moments, objective.exponent), far, key)
        return jnp.any(value - found.value > margin[None], axis=0)

    search = BasinHopping(ValleySteps(16), restarts=max(_FEWEST, chains), hops=0, polish=0)

    def look(block: tuple[jax.Array, Solution, jax.Array]) -> tuple[Solution, jax.Array]:
        moments, before, margin = block
        found = search.minimise(PositionObjective(moments, objective.exponent), far, key)
        gain = before.value - found.value
        widened = jnp.any(gain > margin[None], axis=0)
        found = _lowest_ends(found, chains)
        better = widened[None] & (gain > 0)
        return jax.tree.map(lambda new, old: jnp.where(better, new, old), found, before), widened

    # windows last
    moments, before = jax.tree.map(lambda a: jnp.swapaxes(a, -1, -2), (objective.moments, solution))
    outside = update_marked(probe, planar & ~outside, (moments, before.value, margin), outside)
    unchanged = before, jnp.zeros_like(outside)
    found, widened = update_marked(look, outside, (moments, before, margin), unchanged)
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

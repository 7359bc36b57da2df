"""Twins: a second origin that explains a window as well as the optimum, with a barrier between the two.

The chains of a search end in several places. Most of these are worse, or are the optimum itself, moved
along a direction that is free. A twin is neither: its axes are as still as the winner's to within
sampling error, those of the point halfway are clearly not, and no bound of the search holds it.
"""

import jax

from reframe_jax.arrays import jnp
from reframe_jax.compilation import update_marked
from reframe_jax.identification.classify import excess_over, nearest_origin, tie_margin
from reframe_jax.objectives.norms import principal_axes
from reframe_jax.objectives.velocity import PositionObjective
from reframe_jax.solvers import Box, Solution, ValleySteps

__all__ = ["find_twins"]

_BARRIER = 0.02  # in log J: what an end must have between itself and the optimum to be looked at
_LOCAL = ValleySteps(12)  # brings it to its own optimum


def find_twins(
    objective: PositionObjective,
    box: Box,
    solution: Solution,
    dof: jax.Array,
    noise: jax.Array,
    samples: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """The twin of every optimum, as far as a chain of the search has met it.

    Args:
        objective: moments (6, 10, N), of one frame type each.
        box: where each position was searched, m.
        solution: of N searches, with C ends each.
        dof: (N, 3) degrees of freedom at the optimum.
        noise: (N,) rad/s, RMS of what counts as no rotation.
        samples: (N,) independent velocities.

    Returns:
        (N, 3) m, and (N,) bool, whether it is one.
    """
    if solution.ends is None or solution.end_values is None:
        return solution.x.T, jnp.zeros(solution.value.shape, dtype=bool)
    rival, beyond = _rival(objective, solution.x, solution.value, solution.ends, solution.end_values)
    constrained = (dof == 0).T.astype(rival.dtype)
    margin = tie_margin(constrained.T, samples)

    def look(block: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
        moments, low, high, rival, optimum, constrained, margin, noise = block
        box_here, constrained = Box(low, high), constrained.T
        objective_here = PositionObjective(moments, objective.exponent)
        x, _ = _LOCAL(objective_here, box_here, rival)
        twice, both = jnp.concatenate([moments, moments], axis=-1), jnp.concatenate([optimum, x], axis=-1)
        free = jnp.tile(1 - constrained, (2, 1))
        frames = _frame(PositionObjective(twice, objective.exponent), both, free, jnp.tile(noise, 2))
        (first, twin), (rms, twin_rms) = (jnp.split(a, 2) for a in frames)
        middle_rms, _ = principal_axes(objective_here.covariance((first + twin).T / 2))
        excess = excess_over(rms, twin_rms, constrained)
        barrier = excess_over(rms, middle_rms, constrained) - jnp.maximum(excess, 0)
        on_bounds = jnp.any(box_here.at_face(twin), axis=-1)
        as_good = (excess < margin) & jnp.any(constrained > 0, axis=-1)
        return twin.T, as_good & (barrier > margin) & ~on_bounds

    inputs = objective.moments, *box.bounds(rival), rival, solution.x, constrained, margin, noise
    # on exciting motion hardly a chain ends beyond a barrier
    twin, found = update_marked(look, beyond, inputs, (rival, jnp.zeros_like(beyond)))
    return twin.T, found


def _rival(
    objective: PositionObjective, x: jax.Array, value: jax.Array, ends: jax.Array, end_values: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The lowest of the ends beyond a barrier, (3, N) m, and whether there is any, (N,)."""
    of_chains = PositionObjective(objective.moments[:, :, None], objective.exponent)
    middle = of_chains.value((ends + x[:, None]) / 2)
    beyond = middle - jnp.maximum(end_values, value[None]) > _BARRIER
    lowest = jnp.argmin(jnp.where(beyond, end_values, jnp.inf), axis=0)
    return jnp.take_along_axis(ends, lowest[None, None], axis=1)[:, 0], jnp.any(beyond, axis=0)


def _frame(
    objective: PositionObjective, x: jax.Array, dof: jax.Array, noise: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The origin as it is reported, (N, 3) m, and the RMS along its axes, (N, 3) m/s."""
    rms, axes = principal_axes(objective.covariance(x))
    _, position = nearest_origin(objective.moments, axes, dof, rms, x.T, noise)
    return position, rms

"""The search of the paper: norms of the velocities of single steps, for any exponent and any solver."""

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry.symmetric import INDEX_PAIRS
from reframe_jax.identification.preparation import Prepared
from reframe_jax.model import features as z
from reframe_jax.model.search import lowest_origins, polynomials, unexplained_covariance
from reframe_jax.model.table import LINEAR_KINDS, ROWS
from reframe_jax.motion import kinematics
from reframe_jax.motion.kinematics import Discretization
from reframe_jax.objectives.moments import add_variance, velocity_moments
from reframe_jax.objectives.velocity import PositionObjective
from reframe_jax.solvers import BasinHopping, Box, FrameSteps, JointSearch, Solver, ValleySteps

_FLOOR = 16  # rounding errors added to a covariance, so that it is positive definite without noise

_VALLEY = BasinHopping(ValleySteps(6), restarts=7, hops=2, polish=1, rounds=8)
_POSITIVE = BasinHopping(ValleySteps(8), restarts=8, hops=4, polish=2)
_NEGATIVE = JointSearch(BasinHopping(FrameSteps(10), restarts=16, hops=3, polish=2), refine=ValleySteps(4))


def default_solver(norm: float = 0.0) -> BasinHopping | JointSearch:
    """Return a solver for the norm of velocities between consecutive poses (``scales=1``).

    ``identify`` uses it for exponents other than 0. For 0, it is independent of the search of ``identify``,
    which is faster, and misses the optimum more often in short windows.

    Args:
        norm: exponent of the power mean over the axes, in [-inf, 2].
    """
    return _VALLEY if norm == 0 else _POSITIVE if norm > 0 else _NEGATIVE


def step_moments(window: Prepared, discretization: Discretization) -> tuple[jax.Array, jax.Array]:
    """Compute the second moments of the velocities of single steps.

    The moments of angular velocities are (6, 1, N, 2), those of linear velocities (6, 10, N, 4); the last
    axis lists the frame types.
    """
    if discretization != "chord":
        return velocity_map_moments(window.poses, window.steps, discretization)
    # the velocities are those of the features
    rates = jnp.diff(window.features.values, axis=2) / window.steps[:, None]
    products = jnp.einsum("nfk,ngk->fgn", rates, rates, precision="highest") / rates.shape[2]
    one, other = np.array(INDEX_PAIRS, np.int32).T
    turns = jnp.stack([products[rows, rows][one, other] for rows in (z.TURN_GROUND, z.TURN_BODY)], axis=-1)
    linear = polynomials(products[:, :, None], ROWS[LINEAR_KINDS])[:, :, 0, :, 0]
    return _positive(turns[:, None]), _positive(jnp.swapaxes(linear, 2, 3))


def velocity_map_moments(
    poses: jax.Array, steps: jax.Array, discretization: Discretization
) -> tuple[jax.Array, jax.Array]:
    """Compute the moments of :func:`step_moments` from poses (N, K+1, 4, 4), m, and steps (1 or N, K), s."""
    maps = kinematics.velocity_components(poses, steps, discretization)
    angular, linear = (_positive(jnp.moveaxis(velocity_moments(each), 2, -1)) for each in maps)
    return angular, linear


def _positive(moments: jax.Array) -> jax.Array:
    """Add rounding errors to moments (6, 1 or 10, ...), so that covariances are positive definite."""
    columns = (0,) if moments.shape[1] == 1 else (0, 4, 7, 9)
    squares = [moments[i, j] for i in (0, 3, 5) for j in columns]
    floor = _FLOOR * float(jnp.finfo(moments.dtype).eps) * jnp.sum(jnp.stack(squares), axis=0)
    return add_variance(moments, jax.lax.stop_gradient(floor))


def paper_origins(
    window: Prepared, linear: jax.Array, exponent: float, solver: Solver | None, key: jax.Array
) -> jax.Array:
    """Find the origins (N, 4, 3), m, with the lowest norm of the paper, for every linear type.

    ``linear`` has the moments of the linear velocities of :func:`step_moments`, and the exponent is that of
    the power mean over the axes. If the solver is None, the origins are those of :func:`.lowest_origins` for
    an exponent of 0, otherwise of :func:`default_solver`; ``key`` is the JAX random key of the solver.
    """
    if exponent == 0 and solver is None:
        coefficients = jnp.moveaxis(linear, -1, 2)[:, :, None, :, None]
        of_steps = jnp.moveaxis(window.moments.products[:, 0], 0, -1)
        unexplained = unexplained_covariance(of_steps, ROWS[LINEAR_KINDS])
        single = jnp.ones((1, len(window.box)), linear.dtype)
        place, _ = lowest_origins(coefficients, single, window.box, unexplained)
        return jnp.moveaxis(place, (2, 1), (0, 1))
    solver = default_solver(exponent) if solver is None else solver
    half = jnp.broadcast_to(jnp.max(window.box), (3,))
    return jnp.moveaxis(solver.minimise(PositionObjective(linear, exponent), Box(-half, half), key).x, 0, -1)

"""Origins that can move if the axes turn along: families of frames that explain a window equally well.

A direction is free if the origin moves along it while the axes stay (:func:`.classify.free_positions`). There
are also motions for which another origin needs other axes: on a screw, every point of the nut moves along a
line of its own. With the axes eliminated, the constrained axes of such a family stay as still.
"""

import jax

from reframe_jax.arrays import jnp
from reframe_jax.geometry import symmetric
from reframe_jax.geometry.products import matmul3
from reframe_jax.geometry.symmetric import INDEX_PAIRS
from reframe_jax.identification.classify import excess_over, tie_margin
from reframe_jax.objectives.norms import principal_axes
from reframe_jax.objectives.velocity import PositionObjective
from reframe_jax.solvers.valley_steps import slope_and_curvature

__all__ = ["coupled_positions"]

_APART = 0.05  # m, between origins that are compared
_AS_STILL = 0.2  # in the logarithm of their RMS; few samples alone make nothing coupled


def coupled_positions(
    objective: PositionObjective,
    x: jax.Array,
    free: jax.Array,
    dof: jax.Array,
    samples: jax.Array,
) -> jax.Array:
    """Directions in which other origins, each with its own axes, explain a window as well.

    Along the principal curvatures of log J, origins 5 cm away on both sides are compared with the optimum:
    are as many axes as still, to within sampling error and 20 %?

    Args:
        objective: of one type for each window.
        x: (3, N) m, the optima.
        free: (N, 3, 3) projectors onto the directions in which the origin moves by itself.
        dof: (N, 3) degrees of freedom; a window without constrained axes has no such directions.
        samples: (N,) independent velocities.

    Returns:
        (N, 3, 3) projectors, perpendicular to the free directions.
    """
    basis, others = _principal_directions(objective, x, free)
    held = (dof == 0).astype(x.dtype)
    reference, _ = principal_axes(objective.covariance(x))
    margin = jnp.minimum(tie_margin(held, samples), _AS_STILL)
    ends = jnp.stack([x + sign * _APART * basis[:, :, i].T for i in range(3) for sign in (1.0, -1.0)], axis=1)
    at_ends = PositionObjective(objective.moments[:, :, None], objective.exponent)
    rms, _ = principal_axes(at_ends.covariance(ends))  # (6, N, 3)
    still = excess_over(reference[None], rms, held[None]) < margin[None]
    as_still = others & jnp.all(still.reshape(3, 2, -1), axis=1).T
    as_still = as_still & jnp.any(held > 0, axis=1)[:, None]
    return matmul3(basis * as_still[:, None, :].astype(x.dtype), basis.swapaxes(-1, -2))


def _principal_directions(
    objective: PositionObjective, x: jax.Array, free: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Directions of the principal curvatures, (N, 3, 3) columns, and which are not free, (N, 3) bool."""
    eye = jnp.eye(3, dtype=x.dtype)
    curvature = symmetric.to_matrix(slope_and_curvature(objective, x)[1])
    others = eye[None] - free
    curvature = matmul3(others, matmul3(curvature, others))
    # free directions come last, and do not mix with the others
    size = 1 + 2 * jnp.sum(jnp.abs(curvature), axis=(-2, -1))
    curvature = (curvature + curvature.swapaxes(-1, -2)) / 2 + size[:, None, None] * free
    _, vectors = symmetric.eigh(tuple(curvature[:, i, j] for i, j in INDEX_PAIRS))  # type: ignore[arg-type]
    basis = jnp.stack([jnp.stack(vector, axis=-1) for vector in vectors], axis=-1)
    number = jnp.round(jnp.trace(others, axis1=-2, axis2=-1))
    return basis, jnp.arange(3, dtype=x.dtype)[None] < number[:, None]

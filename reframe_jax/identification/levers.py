"""The levers through which noise of the orientation acts on the origin of a frame."""

import jax
import numpy as np

from reframe_jax.arrays import jnp
from reframe_jax.constraints.types import ORIENTATION_BODIES, POSITION_BODIES, LinearType
from reframe_jax.geometry.symmetric import INDEX_PAIRS
from reframe_jax.identification.evidence import IN_BODY, IN_GROUND, Evidence
from reframe_jax.objectives.moments import MONOMIALS, add_covariance

__all__ = ["lever_moments", "noise_moments"]


def lever_moments(evidence: Evidence) -> jax.Array:
    """Second moments of the lever from the origin of {b} to that of a frame, in the body of its axes.

    For BB it is p itself and for GB R p; for GG, from the mean position, and for BG it is p - x and
    R^T (p - x), with x the position of {b}.

    Returns:
        (6, 10, N, 4), coefficients of polynomials in the origin p, as moments of velocities are.
    """
    dtype, count = evidence.linear_spread.dtype, evidence.linear_spread.shape[2]
    unit = jnp.concatenate([jnp.zeros((3, 1), dtype), jnp.eye(3, dtype=dtype)], axis=1)
    itself = jnp.broadcast_to(_square(unit)[..., None], (6, 10, count))
    # without the position of {b}, which is the first column
    turns = np.asarray([a > 0 for a, _ in MONOMIALS])[None, :, None]
    turning = jnp.where(turns, evidence.linear_spread[..., IN_BODY], 0)
    turning = turning + _square(jnp.where((np.arange(4) > 0)[None, :, None], evidence.mean_paths[..., 0], 0))
    passing = evidence.linear_spread[..., IN_GROUND] + _square(evidence.mean_paths[..., 1])
    of_types = {
        LinearType.BB: itself,
        LinearType.GB: turning,
        LinearType.GG: add_covariance(itself, evidence.positions),
        LinearType.BG: passing,
    }
    return jnp.stack([of_types[kind] for kind in LinearType], axis=-1)


def _square(path: jax.Array) -> jax.Array:
    """Moments (6, 10, ...) of a single sample, (3, 4, ...)."""
    (i, j), (a, b) = np.transpose(INDEX_PAIRS), np.transpose(MONOMIALS)
    straight, crossed = path[i][:, a] * path[j][:, b], path[i][:, b] * path[j][:, a]
    twice = (a != b).reshape(1, -1, *([1] * (path.ndim - 2)))
    return straight + jnp.where(twice, crossed, 0)


def noise_moments(evidence: Evidence) -> jax.Array:
    """What noise of the orientation adds to the moments of the paths of GB and BG, (6, 10, N, 4).

    A turn e of every pose moves the end of a lever l by e x l: with a variance s^2 of every component of e,
    that adds s^2 (tr S - S), S being the second moments of l. Zero for the other types, whose paths are
    summed up, and where what leads away from a single axis was taken out.
    """
    xx, xy, xz, yy, yz, zz = lever_moments(evidence)
    across = jnp.stack([yy + zz, -xy, -xz, xx + zz, -yz, xx + yy])
    variance = jnp.square(evidence.share * evidence.noise.rotation)
    variance = jnp.where(evidence.alone, 0, variance)
    followed = jnp.asarray(ORIENTATION_BODIES != POSITION_BODIES)
    of_types = jnp.where(followed[None], variance[:, None], 0)
    return across * of_types[None, None]

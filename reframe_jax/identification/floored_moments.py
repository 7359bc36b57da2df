"""Moments of a window's velocities and paths, with a floor where rounding hides everything."""

import jax

from reframe_jax.arrays import jnp, lax
from reframe_jax.compilation import once
from reframe_jax.motion import kinematics
from reframe_jax.motion.kinematics import Discretization
from reframe_jax.objectives.moments import add_variance, component_moments

__all__ = ["FLOOR", "covariance_moments", "rounding_of", "usable_moments", "window_moments"]

FLOOR = 16  # of the covariance, in units of rounding: keeps noise-free windows positive definite


def window_moments(
    poses: jax.Array, steps: jax.Array, discretization: Discretization = "chord"
) -> tuple[jax.Array, jax.Array]:
    """What a window leaves for the search: moments of its angular and linear velocities.

    Args:
        poses: (..., K+1, 4, 4), m.
        steps: (K,) or (..., K) sample times, s.
        discretization: see :func:`reframe_jax.motion.kinematics.linear_velocity_maps`.

    Returns:
        Angular moments (6, 1, ..., 2) and linear moments (6, 10, ..., 4), the last axis over frame
        types. A floor of a few roundings is added to the covariance, below which nothing can be told.
    """
    rates, maps = kinematics.velocity_components(poses, steps, discretization)
    return covariance_moments(rates), covariance_moments(maps)


def covariance_moments(maps: jax.Array, power: int = 1) -> jax.Array:
    """Moments, the types last, of maps (3, columns, K, types, ...), with a floor: rounding ** power."""
    moments = jnp.moveaxis(component_moments(maps), 2, -1)
    return add_variance(moments, rounding_of(moments, power))


def rounding_of(moments: jax.Array, power: int = 1) -> jax.Array:
    """Part of a covariance that is lost in rounding, (N, types), from the moments (6, columns, N, types).

    A few roundings ** power of the squares of all that the maps hold. These are not small where the velocity
    is small: at the origin of a hinge nothing moves, as the difference of what does.
    """
    squares = [moments[i, j] for i in (0, 3, 5) for j in ((0,) if moments.shape[1] == 1 else (0, 4, 7, 9))]
    rounding = (FLOOR * float(jnp.finfo(moments.dtype).eps)) ** power
    return rounding * lax.stop_gradient(jnp.sum(jnp.stack(squares), axis=0))


def usable_moments(
    failed: jax.Array, maps: jax.Array, power: int = 1, floor: jax.Array | None = None
) -> jax.Array:
    """Moments of maps, see :func:`covariance_moments`; harmless ones for the windows (N,) that failed.

    A floor (N,) is added to the covariance in every direction.
    """
    unit = jnp.asarray([1, 0, 0, 1, 0, 1], dtype=maps.dtype)[:, None, None, None]
    moments = covariance_moments(maps, power)
    if floor is not None:
        moments = add_variance(moments, floor[:, None])
    return once(jnp.where(failed[:, None], unit, moments))

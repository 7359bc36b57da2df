"""The norms that a constraint frame minimizes: Eqs. 6-8 of the paper as pure functions.

For axes E (columns, in the body that the type's first letter names) and an origin p,

    lambda_n = rms over k of (E^T u(k; p))_n,        J = power mean over n of lambda_n.

E = exp(rotvec) is the orientation of the frame. The paper's R^psi is its transpose, which maps velocities to
the frame. The paper uses the power mean with exponent 0, which is the geometric mean.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from reframe_jax.geometry import rotations
from reframe_jax.geometry.products import matmul

__all__ = [
    "axis_rms",
    "check_exponent",
    "frame_norm",
    "log_power_mean",
    "power_mean",
]


def check_exponent(exponent: float) -> float:
    """Check the exponent of a power mean over the axes, and return it as a float.

    Raises:
        ValueError: unless -inf <= exponent <= 2. Above 2, the norm prefers equal axes to small axes.
    """
    real = isinstance(exponent, (int, float, np.integer, np.floating))
    if not real or isinstance(exponent, (bool, np.timedelta64)):  # NumPy treats timedelta64 as an integer
        raise ValueError(f"The exponent of the norm must be a plain number, not {exponent!r}.")
    try:
        value = float(exponent)
    except OverflowError:
        value = math.nan
    if not -math.inf <= value <= 2:
        raise ValueError(f"The exponent of the norm over axes must lie in [-inf, 2], not {exponent}.")
    return value


def log_power_mean(log_values: jax.Array, exponent: float) -> jax.Array:
    """Logarithm of the power mean from logarithms, numerically stable for every exponent.

    ``log1p(mean(expm1(p x))) / p`` has the geometric mean as its limit p -> 0 without cancellation.

    Args:
        log_values: (3, ...) logarithms of positive numbers.
        exponent: p in [-inf, 2], a Python number.

    Returns:
        (...).
    """
    exponent = check_exponent(exponent)
    if exponent == -math.inf:
        return jnp.min(log_values, axis=0)
    if exponent == 0:
        return jnp.mean(log_values, axis=0)
    extreme = jnp.min if exponent < 0 else jnp.max
    top = lax.stop_gradient(extreme(log_values, axis=0))
    excess = jnp.mean(jnp.expm1(exponent * (log_values - top[None])), axis=0)
    return top + jnp.log1p(excess) / exponent


def power_mean(values: jax.Array, exponent: float = 0.0) -> jax.Array:
    """Power mean of non-negative values over the last axis.

    Args:
        values: (..., 3).
        exponent: p in [-inf, 2]: -inf is the minimum, 0 the geometric and 1 the arithmetic mean.

    Returns:
        (...). If a value is zero and the exponent is not positive, the mean is zero, and its derivative is
        set to zero, because the true derivative is infinite.
    """
    exponent = check_exponent(exponent)
    positive = values > 0
    logs = jnp.log(jnp.where(positive, values, 1))
    if exponent > 0:
        logs = jnp.where(positive, logs, -jnp.inf)
        anything = jnp.any(positive, axis=-1)
        logs = jnp.where(anything[..., None], logs, 0)
    else:
        anything = jnp.all(positive, axis=-1)
    mean = jnp.exp(log_power_mean(jnp.moveaxis(logs, -1, 0), exponent))
    return jnp.where(anything, mean, 0)


def _safe_sqrt(x: jax.Array) -> jax.Array:
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


def axis_rms(rotvec: jax.Array, position: jax.Array | None, maps: jax.Array) -> jax.Array:
    """RMS velocity along each axis of a frame, from samples.

    Args:
        rotvec: (..., 3) rad, orientation of the frame.
        position: (..., 3) m, origin of the frame; None for angular velocities.
        maps: (..., K, 3, 4) affine velocity maps, or (..., K, 3) velocities if position is None.

    Returns:
        (..., 3), in the unit of the velocities.
    """
    if position is None:
        velocity = maps
    else:
        velocity = maps[..., 0] + jnp.sum(maps[..., 1:] * position[..., None, None, :], axis=-1)
    in_frame = matmul(velocity, rotations.rotation_exp(rotvec))
    return _safe_sqrt(jnp.mean(in_frame**2, axis=-2))


def frame_norm(
    rotvec: jax.Array, position: jax.Array | None, maps: jax.Array, exponent: float = 0.0
) -> jax.Array:
    """The objective: Eq. 7 for angular velocities (``position=None``), Eq. 8 for linear velocities.

    Arguments as in :func:`axis_rms` and :func:`power_mean`; returns (...).
    """
    return power_mean(axis_rms(rotvec, position, maps), exponent)

"""The norms of the paper, Eqs. 6-8: a constraint frame is the frame with the lowest norm of velocities.

A frame has axes E (columns, fixed in the body that the type's first letter names) and an origin p, whose
velocity in sample k is u(k; p). Its norm J combines the RMS velocities lambda_n along the three axes:

    lambda_n = rms over k of (E^T u(k; p))_n,        J = power mean over n of lambda_n.

The paper uses the exponent 0, the geometric mean. The paper's matrix R^psi, which maps velocities to the
frame, is the transpose of E.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax


def check_exponent(exponent: float) -> float:
    """Check the exponent of a power mean over the axes, and return it as a float.

    Raises:
        ValueError: unless -inf <= exponent <= 2. With an exponent above 2, frames with three equal RMS
            velocities have the lowest norm, not frames with constrained axes.
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
    """Return the logarithm (...) of the power mean of three positive numbers.

    The function computes ``log1p(mean(expm1(p x))) / p``, which tends to the geometric mean for p -> 0
    without cancellation.

    Args:
        log_values: (3, ...) logarithms of the numbers.
        exponent: exponent p of the mean, in [-inf, 2].

    Raises:
        ValueError: for another exponent.
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

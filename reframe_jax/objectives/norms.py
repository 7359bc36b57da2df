"""The norms that a constraint frame minimizes: Eqs. 6-8 of the paper.

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

__all__ = ["check_exponent", "log_power_mean"]


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
    """Logarithm (...) of the power mean from logarithms (3, ...), numerically stable for every exponent.

    ``log1p(mean(expm1(p x))) / p`` has the geometric mean as its limit p -> 0 without cancellation.
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

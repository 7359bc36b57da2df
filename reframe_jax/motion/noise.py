"""Estimate the white noise of measured poses from their differences.

All arrays have components first, then samples, then windows.
"""

from math import comb

import jax
import jax.numpy as jnp
from jax import lax

__all__ = ["constant_components", "estimate_noise", "masked_median", "unit_of_rounding"]

_ORDERS = (2, 4, 6)  # orders of the differences for the noise estimate
_GAUSSIAN = 0.6745  # median of the absolute value of a standard normal variable
_OFF_GRID = (
    0.05  # largest mean distance of steps from multiples of the smallest step; random steps have a quarter
)
_BISECTIONS, _OCTAVES = 14, 40  # bisections of a median: 0.2 % accuracy over twelve decades


def masked_median(values: jax.Array, counted: jax.Array) -> jax.Array:
    """Median of the counted non-negative values (M, ...) over the first axis; 0 if no value counts.

    The function bisects the logarithm in elementwise passes, because sorting many short rows is slow.
    """
    top = jnp.maximum(jnp.max(jnp.where(counted, values, 0), axis=0), jnp.finfo(values.dtype).tiny)
    # relative to the largest value, float32 is accurate enough and twice as fast to compare
    shares = jnp.where(counted, values / top[None], jnp.inf).astype(jnp.float32)
    half = jnp.sum(counted, axis=0, dtype=jnp.float32) / 2
    low, high = _bisect(shares, half)
    median = top * jnp.exp2(high.astype(top.dtype))
    return jnp.where((half > 0) & (low > -_OCTAVES), median, 0)


def _bisect(shares: jax.Array, half: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Lower and upper bounds (...) of the logarithm of the median; ``half`` of the values are below."""

    def halve(_: int, ends: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = ends
        middle = (low + high) / 2
        enough = jnp.sum(shares <= jnp.exp2(middle)[None], axis=0, dtype=jnp.float32) >= half
        return jnp.where(enough, low, middle), jnp.where(enough, middle, high)

    end = jnp.zeros(half.shape, jnp.float32)
    low, high = lax.fori_loop(0, _BISECTIONS, halve, (end - _OCTAVES, end))
    return low, high


def estimate_noise(position: jax.Array, turns: jax.Array, counted: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Estimate the standard deviation of the white noise in each component of position and orientation.

    Uses the median absolute differences of order 2, 4 and 6, and returns the smallest estimate, because
    smooth motion vanishes from high differences. A few jumps have no effect. Slow errors (drift) are not
    included. Components that never change, such as the components that a planar tracker does not measure, are
    ignored. Rounded positions have at least the noise of their rounding.

    Args:
        position: (3, K+1, N) m.
        turns: (3, K, N) rad, rotation vector of every step.
        counted: (K+1, N) bool, False for poses to ignore.

    Returns:
        Standard deviations (N,) m and (N,) rad.
    """
    poses = counted.shape[0]
    rows, masks, scales = [], [], []
    orders = [m for m in _ORDERS if m < poses - 1] or [2]
    changing = [
        ~constant_components(position, counted),
        ~constant_components(turns, counted[1:] & counted[:-1], 1),
    ]
    for order in orders:
        whole = counted[: poses - order]
        for shift in range(1, order + 1):
            whole = whole & counted[shift : shift + poses - order]
        for values, first, changes in ((position, 0, changing[0]), (turns, 1, changing[1])):
            difference = jnp.abs(jnp.diff(values, order - first, axis=1))
            rows.append(jnp.pad(difference, ((0, 0), (0, order), (0, 0))))
            masks.append(jnp.pad(whole[None] & changes[:, None], ((0, 0), (0, order), (0, 0))))
            scales.append(_GAUSSIAN * comb(2 * order, order) ** 0.5)
    shape = (-1, len(rows), counted.shape[1])
    stacked, mask = jnp.stack(rows, axis=2).reshape(shape), jnp.stack(masks, axis=2)
    deviation = masked_median(stacked, mask.reshape(shape))
    deviation = deviation / jnp.asarray(scales, position.dtype)[:, None]
    enough = jnp.max(jnp.sum(mask, axis=1), axis=0) >= 4
    deviation = jnp.where(enough, deviation, jnp.inf)
    best = jnp.min(deviation.reshape(len(orders), 2, -1), axis=0)
    rounding = jnp.stack([jnp.max(jnp.abs(values), axis=(0, 1)) for values in (position, turns)])
    rounding = 4 * float(jnp.finfo(position.dtype).eps) * rounding
    spreads = jnp.maximum(jnp.where(jnp.isfinite(best), best, 0), rounding)
    rounded = unit_of_rounding(position, counted) / 12**0.5
    return jnp.maximum(spreads[0], rounded), spreads[1]


def constant_components(values: jax.Array, counted: jax.Array, least: float = 0.0) -> jax.Array:
    """Find components of values (3, M, N) that are constant up to rounding errors, (3, N) bool.

    Args:
        values: (3, M, N).
        counted: (M, N) bool, False for values to ignore.
        least: lower bound on the size of the numbers from which the values were computed.
    """
    low = jnp.min(jnp.where(counted[None], values, jnp.inf), axis=1)
    high = jnp.max(jnp.where(counted[None], values, -jnp.inf), axis=1)
    largest = jnp.max(jnp.where(counted[None], jnp.abs(values), 0), axis=(0, 1))
    rounding = 4 * float(jnp.finfo(values.dtype).eps) * jnp.maximum(largest, least)
    return high - low <= rounding[None]


def unit_of_rounding(position: jax.Array, counted: jax.Array) -> jax.Array:
    """Rounding unit of positions, (N,) m: all steps are multiples of the smallest step; zero if they are not.

    Steps of a single size mean uniform motion, not rounding. Numbers with a fixed number of digits have a
    coarser rounding in large coordinates. A coordinate that mostly repeats its value while other coordinates
    change therefore has a separate unit, its smallest step.

    Args:
        position: (3, K+1, N) m.
        counted: (K+1, N) bool, False for poses to ignore.
    """
    steps = jnp.abs(jnp.diff(position, axis=1))
    both = (counted[1:] & counted[:-1])[None]
    moved = both & (steps > 0)
    smallest = jnp.min(jnp.where(moved, steps, jnp.inf), axis=(0, 1))
    unit = jnp.where(jnp.isfinite(smallest), smallest, 1)
    multiples = steps / unit[None, None]
    off = jnp.where(moved, jnp.abs(multiples - jnp.round(multiples)), 0)
    number = jnp.maximum(jnp.sum(moved, axis=(0, 1), dtype=position.dtype), 1)
    least = jnp.min(jnp.where(both, steps, jnp.inf), axis=1)
    most = jnp.max(jnp.where(both, steps, 0), axis=1)
    uneven = jnp.any(most > least + unit[None] / 2, axis=0)
    rounded = uneven & (jnp.sum(off, axis=(0, 1)) < _OFF_GRID * number)
    common = jnp.where(jnp.isfinite(smallest) & rounded, unit, 0)
    anywhere = jnp.any(moved, axis=0)
    repeats = jnp.sum(anywhere[None] & ~moved, axis=1) * 2 > jnp.sum(anywhere, axis=0)[None]
    own = jnp.min(jnp.where(moved, steps, jnp.inf), axis=1)
    return jnp.maximum(common, jnp.max(jnp.where(repeats & jnp.isfinite(own), own, 0), axis=0))

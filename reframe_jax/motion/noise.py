"""Estimate the white noise of measured poses.

White noise is independent from sample to sample. A high-order difference of consecutive poses contains this
noise and hardly any of the smooth motion. All arrays have components first, then samples, then windows.
"""

from math import comb

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

_ORDERS = (4, 6)  # orders of the differences; those of order 2 contain the motion of few poses
_MEDIAN_LENGTHS = (1.0, 0.6745, 1.1774, 1.5382)  # of standard normal vectors with 0, 1, 2 and 3 components
_OFF_GRID = 0.05  # mean distance of steps from multiples of the smallest step; 0.25 without rounding
_SMOOTHER = 0.5  # noise for equal steps over noise for the times, below which the times jitter
_BISECTIONS, _OCTAVES = 14, 40  # steps and range of the bisection of a median: 0.2 % over twelve decades


def masked_median(values: jax.Array, counted: jax.Array) -> jax.Array:
    """Return the median of selected values over the first axis, with a relative error of 0.2 %.

    The function bisects the logarithm in elementwise passes, because sorting many short rows is slow.

    The values (M, ...) are not negative, and ``counted`` (M, ...) bool selects them; a median (...) without
    any is 0.
    """
    top = jnp.maximum(jnp.max(jnp.where(counted, values, 0), axis=0), jnp.finfo(values.dtype).tiny)
    # relative to the largest value, float32 is exact enough, and comparisons are twice as fast
    fractions = jnp.where(counted, values / top[None], jnp.inf).astype(jnp.float32)
    half = jnp.sum(counted, axis=0, dtype=jnp.float32) / 2

    def halve(_: int, ends: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = ends  # log2 of a value below which less, and at least, half of the fractions lie
        middle = (low + high) / 2
        enough = jnp.sum(fractions <= jnp.exp2(middle)[None], axis=0, dtype=jnp.float32) >= half
        return jnp.where(enough, low, middle), jnp.where(enough, middle, high)

    end = jnp.zeros(half.shape, jnp.float32)
    low, high = lax.fori_loop(0, _BISECTIONS, halve, (end - _OCTAVES, end))
    median = top * jnp.exp2(high.astype(top.dtype))
    return jnp.where((half > 0) & (low > -_OCTAVES), median, 0)


def estimate_noise(
    position: jax.Array, turns: jax.Array, times: jax.Array, counted: jax.Array, unit: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Estimate the standard deviation of the white noise in each component of position and orientation.

    The function computes estimates from the median length of the differences of order 4 and 6, and returns
    the lowest one, or the rounding error for fewer than eight poses. Differences for the given times are
    right if poses are missing; those for equal steps, if only the times jitter. Constant components, as of a
    planar tracker, are ignored. The noise of rounded positions is at least their rounding error.

    Args:
        position: (3, K+1, N) m.
        turns: (3, K, N) rad, rotation vectors of the steps between consecutive poses.
        times: (K+1, N) s, increasing.
        counted: (K+1, N) bool, the poses to use.
        unit: (N,) m, unit to which the positions are rounded, or 0; see :func:`unit_of_rounding`.

    Returns:
        Standard deviations of position, m, and of orientation, rad, (2, N); and whether the times jitter: the
        poses are smooth for equal steps, (N,) bool, but not for the times.
    """
    both = counted[1:] & counted[:-1]
    constant = constant_components(position, counted), constant_components(turns, both, 1)
    changes = ~jnp.stack(constant)  # (2, 3, N)
    median = jnp.asarray(_MEDIAN_LENGTHS, position.dtype)[jnp.sum(changes, axis=1)]
    path = jnp.stack([position, jnp.pad(jnp.cumsum(turns, axis=1), ((0, 0), (1, 0), (0, 0)))])
    rounding = 4 * float(jnp.finfo(path.dtype).eps) * jnp.max(jnp.abs(path), axis=(1, 2))
    # differences that contain a pose that is not counted, such as padding, are NaN
    path = jnp.where(counted, jnp.where(changes[:, :, None], path, 0), jnp.nan)
    sizes = []
    for order in [order for order in _ORDERS if order < len(counted)]:
        length = jnp.sqrt(jnp.sum(jnp.square(_unit_differences(path, times, order)), axis=2))
        sizes.append(jnp.pad(length, ((0, 0), (0, 0), (0, order), (0, 0)), constant_values=jnp.nan))
    size = jnp.moveaxis(jnp.stack(sizes), 3, 0)  # (M, orders, 2 clocks, 2, N)
    deviation = masked_median(size, jnp.isfinite(size)) / median
    enough = jnp.sum(jnp.isfinite(size), axis=0) >= 4
    clocks = jnp.min(jnp.where(enough, deviation, jnp.inf), axis=0)  # (2 clocks, 2, N)
    best = jnp.min(clocks, axis=0)
    spreads = jnp.maximum(jnp.where(jnp.isfinite(best), best, 0), rounding)
    spreads = spreads.at[0].max(unit / 12**0.5)
    return spreads, jnp.all(clocks[0] < _SMOOTHER * clocks[1], axis=0)


def _unit_differences(values: jax.Array, times: jax.Array, order: int) -> jax.Array:
    """Divided differences of values (2, 3, P, N), with the size of noise, for equal steps and for the times.

    The result has the shape (2, 2, 3, P - order, N).
    """
    at = jnp.stack([times[j : len(times) - order + j] for j in range(order + 1)])
    gaps = (at[:, None] - at) / (at[-1] - at[0])
    weights = 1 / jnp.prod(jnp.where(gaps == 0, 1, gaps), axis=1)
    weights = weights / jnp.sqrt(jnp.sum(weights * weights, axis=0))
    equal = np.array([(-1) ** j * comb(order, j) / comb(2 * order, order) ** 0.5 for j in range(order + 1)])
    each = jnp.broadcast_to(jnp.asarray(equal, weights.dtype)[:, None, None], weights.shape)
    weights = jnp.stack([each, weights], axis=1)[:, :, None, None]
    terms = [weight * values[:, :, j : len(times) - order + j] for j, weight in enumerate(weights)]
    return sum(terms[1:], terms[0])


def constant_components(values: jax.Array, counted: jax.Array, least: float = 0.0) -> jax.Array:
    """Return which components of vectors are constant, up to rounding errors of floating-point numbers.

    Args:
        values: (F, M, N) in any unit.
        counted: (M, N) bool, the values to use.
        least: magnitude of the numbers from which the values were computed, if that is more than the values;
            the rounding error is relative to it.

    Returns:
        (F, N) bool.
    """
    # one reduction compiles in half the time of two
    high, minus_low = jnp.max(jnp.where(counted, jnp.stack([values, -values]), -jnp.inf), axis=2)
    largest = jnp.max(jnp.maximum(high, minus_low), axis=0)
    rounding = 4 * float(jnp.finfo(values.dtype).eps) * jnp.maximum(largest, least)
    return high + minus_low <= rounding


def unit_of_rounding(position: jax.Array, counted: jax.Array) -> jax.Array:
    """Find the unit to which positions are rounded, such as 0.1 mm.

    Rounded positions change by multiples of the unit; the unit is then the smallest step. Steps of a single
    size come from uniform motion, not from rounding. Numbers with a fixed number of digits have a larger unit
    in large coordinates. Therefore a coordinate that mostly repeats its value while other coordinates change
    has a separate unit, its smallest step; the result is the largest unit.

    Args:
        position: (3, K+1, N) m.
        counted: (K+1, N) bool, the poses to use.

    Returns:
        (N,) m; 0 for positions that are not rounded.
    """
    steps = jnp.abs(jnp.diff(position, axis=1))
    both = (counted[1:] & counted[:-1])[None]
    moved = both & (steps > 0)
    ranges = [jnp.where(both, steps, jnp.inf), jnp.where(both, -steps, 0), jnp.where(moved, steps, jnp.inf)]
    least, minus_most, own = jnp.min(jnp.stack(ranges), axis=2)  # (3, N) each
    smallest = jnp.min(own, axis=0)
    unit = jnp.where(jnp.isfinite(smallest), smallest, 1)
    multiples = steps / unit
    off = jnp.where(moved, jnp.abs(multiples - jnp.round(multiples)), 0)
    sums = jnp.sum(jnp.concatenate([off, moved, jnp.any(moved, axis=0)[None]]), axis=1)
    off, number, anywhere = sums[:3], sums[3:6], sums[6]
    uneven = jnp.any(-minus_most > least + unit / 2, axis=0)
    rounded = uneven & (jnp.sum(off, axis=0) < _OFF_GRID * jnp.maximum(jnp.sum(number, axis=0), 1))
    common = jnp.where(jnp.isfinite(smallest) & rounded, unit, 0)
    repeats = (anywhere - number) * 2 > anywhere
    return jnp.maximum(common, jnp.max(jnp.where(repeats & jnp.isfinite(own), own, 0), axis=0))

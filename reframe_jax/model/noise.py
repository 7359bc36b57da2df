"""White noise of measured poses, from differences in which smooth motion vanishes.

Arrays have components first, then samples, and windows last.
"""

from math import comb

import jax
import jax.numpy as jnp

__all__ = ["estimate_noise", "masked_median", "unit_of_rounding"]

Array = jax.Array
_ORDERS = (2, 4, 6)  # of the differences
_GAUSSIAN = 0.6745  # median of the absolute value of a standard normal variable
_FEWEST = 4  # differences of an order
_OFF_GRID = 0.05  # mean distance of steps from multiples of the smallest; a quarter if they are none
_BISECTIONS, _OCTAVES = 14, 40  # of a median: to 0.2 % over twelve decades


def masked_median(values: Array, counted: Array) -> Array:
    """Return the median of the non-negative values (M, ...) that count, over the first axis; 0 if none.

    Bisects the logarithm in elementwise passes, because sorting many short rows is slow.
    """
    top = jnp.maximum(jnp.max(jnp.where(counted, values, 0), axis=0), jnp.finfo(values.dtype).tiny)
    # as fractions of the largest, float32 is exact enough
    fractions = jnp.where(counted, values / top, jnp.inf).astype(jnp.float32)
    fractions = jax.lax.optimization_barrier(fractions.reshape(len(values), -1))
    half = jnp.sum(counted, axis=0, dtype=jnp.float32) / 2
    ones = jnp.ones(len(values), jnp.float32)

    def halve(_: int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = (low + high) / 2
        # a product with ones: on a CPU, faster than a reduction over the first axis
        below = (ones @ (fractions <= jnp.exp2(middle).reshape(-1)).astype(jnp.float32)).reshape(middle.shape)
        return jnp.where(below >= half, low, middle), jnp.where(below >= half, middle, high)

    end = jnp.zeros(half.shape, jnp.float32)
    low, high = jax.lax.fori_loop(0, _BISECTIONS, halve, (end - _OCTAVES, end))
    return jnp.where((half > 0) & (low > -_OCTAVES), top * jnp.exp2(high.astype(top.dtype)), 0)


def estimate_noise(position: Array, turns: Array, counted: Array) -> tuple[Array, Array]:
    """Estimate the standard deviation of the white noise in each component of position and orientation.

    Uses the median absolute differences of order 2, 4 and 6, and returns the smallest estimate, because
    smooth motion vanishes from high differences. A few jumps do not matter. Errors that change slowly are not
    included. Components that never change, as those that a planar tracker does not measure, say nothing about
    the noise of the others. Rounded positions have at least the noise of their rounding.

    Args:
        position: (3, K+1, N) m.
        turns: (3, K, N) rad, rotation vector of every step.
        counted: (K+1, N) bool, poses that count.

    Returns:
        (N,) m and (N,) rad.
    """
    poses, windows = counted.shape
    orders = [m for m in _ORDERS if m < poses - 1] or [2]
    both = counted[1:] & counted[:-1]
    changing = jnp.stack([_changes(position, counted, 0.0), _changes(turns, both, 1.0)])  # (2, 3, N)
    # the rotation between poses is a difference already
    turned = jnp.pad(turns, ((0, 0), (0, 1), (0, 0)))
    rows, masks, whole = [], [], counted
    of_position, of_turns, size = position, turned, poses
    for order in range(1, orders[-1] + 1):
        size -= 1
        of_position = of_position[:, 1:] - of_position[:, :-1]
        of_turns = of_turns[:, :-1] if order == 1 else of_turns[:, 1 : size + 1] - of_turns[:, :size]
        whole = whole[1:] & whole[:-1]
        if order in orders:
            pad = ((0, 0), (0, 0), (0, order), (0, 0))
            scale = _GAUSSIAN * comb(2 * order, order) ** 0.5
            rows.append(jnp.pad(jnp.abs(jnp.stack([of_position, of_turns])) / scale, pad))
            masks.append(jnp.pad(whole[None, None] & changing[:, :, None], pad))
    values, mask = (jnp.stack(leaf).transpose(2, 3, 0, 1, 4) for leaf in (rows, masks))
    shape = 3 * poses, len(orders), 2, windows
    deviation = masked_median(values.reshape(shape), mask.reshape(shape))
    enough = jnp.max(jnp.sum(mask, axis=1), axis=0) >= _FEWEST
    best = jnp.min(jnp.where(enough, deviation, jnp.inf), axis=0)
    rounding = jnp.stack([jnp.max(jnp.abs(part), axis=(0, 1)) for part in (position, turns)])
    spread = jnp.maximum(jnp.where(jnp.isfinite(best), best, 0), 4 * jnp.finfo(position.dtype).eps * rounding)
    return jnp.maximum(spread[0], unit_of_rounding(position, counted) / 12**0.5), spread[1]


def _changes(values: Array, counted: Array, least: float) -> Array:
    """Which components of values (3, M, N) change by more than the rounding of numbers of a size, (3, N)."""
    low = jnp.min(jnp.where(counted, values, jnp.inf), axis=1)
    high = jnp.max(jnp.where(counted, values, -jnp.inf), axis=1)
    size = jnp.max(jnp.maximum(jnp.abs(low), jnp.abs(high)), axis=0)
    return high - low > 4 * jnp.finfo(values.dtype).eps * jnp.maximum(
        jnp.where(jnp.isfinite(size), size, 0), least
    )


def unit_of_rounding(position: Array, counted: Array) -> Array:
    """The unit that positions are rounded to, (N,) m: all steps are multiples of the smallest; else zero.

    Steps of one size only are those of even motion, not of rounding. Where numbers have a fixed count of
    digits, large coordinates are rounded more than small ones. So a coordinate that mostly repeats its value
    while others change has a unit of its own, its smallest step.

    Args:
        position: (3, K+1, N) m.
        counted: (K+1, N) bool, poses that count.
    """
    steps = jnp.abs(position[:, 1:] - position[:, :-1])
    both = counted[1:] & counted[:-1]
    moved = both & (steps > 0)
    own = jnp.min(jnp.where(moved, steps, jnp.inf), axis=1)
    smallest = jnp.min(own, axis=0)
    unit = jnp.where(jnp.isfinite(smallest), smallest, 1)
    multiples = steps / unit
    off = jnp.where(moved, jnp.abs(multiples - jnp.round(multiples)), 0)
    number = jnp.maximum(jnp.sum(moved, axis=(0, 1), dtype=position.dtype), 1)
    least = jnp.min(jnp.where(both, steps, jnp.inf), axis=1)
    most = jnp.max(jnp.where(both, steps, 0), axis=1)
    uneven = jnp.any(most > least + unit / 2, axis=0)
    rounded = uneven & (jnp.sum(off, axis=(0, 1)) < _OFF_GRID * number)
    common = jnp.where(jnp.isfinite(smallest) & rounded, unit, 0)
    anywhere = jnp.any(moved, axis=0)
    repeats = jnp.sum(anywhere & ~moved, axis=1) * 2 > jnp.sum(anywhere, axis=0)
    return jnp.maximum(common, jnp.max(jnp.where(repeats & jnp.isfinite(own), own, 0), axis=0))

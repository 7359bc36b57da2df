"""Noise of measured poses, and the chord length that it requires.

The velocity between two poses is their difference over the time between them. For consecutive poses of a
camera, it is mostly noise. A longer chord divides the same noise by a longer time, and overlapping chords use
every pose. However, a chord cuts corners, so it should be no longer than the noise requires. For the noise of
an encoder it is a single step, and the velocities are those of the paper.

All arrays have components first, then samples, then windows.
"""

from math import comb, radians

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

__all__ = ["choose_lag", "constant_components", "estimate_noise", "masked_median", "unit_of_rounding"]

_ORDERS = (2, 4, 6)  # of the differences from which noise is told
_GAUSSIAN = 0.6745  # median of the absolute value of a standard normal variable
_CHORD = 70.0  # noises that the median chord should be long
_LONG_CHORD, _PART = 1000.0, 0.05  # more where that is so much of the longest, for axes that move slowly
_TURN = radians(20.0)  # that it should turn at most
_SHARE = 6  # chords that fit a window, at least
_GROWS = 2.0  # motion of a chord over that of one a quarter as long, below which it is drift
_SATURATED = 0.8  # share of the longest chord from which on longer lags bring nothing
_OF_NOISE = 2.17  # median length of a chord that is noise alone, in noises of a component
_OFF_GRID = 0.05  # mean distance of steps from multiples of the smallest; a quarter if they are none
_BISECTIONS, _OCTAVES = 14, 40  # of a median: to 0.2 % over twelve decades


def masked_median(values: jax.Array, counted: jax.Array) -> jax.Array:
    """Return the median of the non-negative values (M, ...) that count, over the first axis; 0 if none.

    Bisects the logarithm in elementwise passes, because sorting many short rows is slow.
    """
    top = jnp.maximum(jnp.max(jnp.where(counted, values, 0), axis=0), jnp.finfo(values.dtype).tiny)
    # as shares of the largest, float32 is exact enough: a processor compares twice as many at a time
    shares = jnp.where(counted, values / top[None], jnp.inf).astype(jnp.float32)
    half = jnp.sum(counted, axis=0, dtype=jnp.float32) / 2
    low, high = _bisect(shares, half)
    median = top * jnp.exp2(high.astype(top.dtype))
    return jnp.where((half > 0) & (low > -_OCTAVES), median, 0)


def _bisect(shares: jax.Array, half: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Two logarithms, (...), between which that of the value lies that ``half`` of the shares are below."""

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
    """Which components of values (3, M, N) stay the same to the last digit, (3, N) bool.

    Args:
        values: (3, M, N).
        counted: (M, N) bool, which count.
        least: size of the numbers that the values were computed from, at least.
    """
    low = jnp.min(jnp.where(counted[None], values, jnp.inf), axis=1)
    high = jnp.max(jnp.where(counted[None], values, -jnp.inf), axis=1)
    largest = jnp.max(jnp.where(counted[None], jnp.abs(values), 0), axis=(0, 1))
    rounding = 4 * float(jnp.finfo(values.dtype).eps) * jnp.maximum(largest, least)
    return high - low <= rounding[None]


def unit_of_rounding(position: jax.Array, counted: jax.Array) -> jax.Array:
    """The unit that positions are rounded to, (N,) m: all steps are multiples of the smallest; else zero.

    Steps of one size only are those of even motion, not of rounding. Where numbers have a fixed count of
    digits, large coordinates are rounded more than small ones. So a coordinate that mostly repeats its value
    while others change has a unit of its own, its smallest step.

    Args:
        position: (3, K+1, N) m.
        counted: (K+1, N) bool, poses that count.
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


def _candidates(poses: int) -> list[int]:
    """Lags to choose from, 1, 2, 3, 4, 6, 8, 12, ..., for windows of so many poses."""
    longest = max(1, (poses - 1) // _SHARE)
    lags = sorted({lag for n in range(32) for lag in (2**n, 3 * 2 ** (n - 1) if n else 1)})
    return [lag for lag in lags if lag <= longest]


def choose_lag(
    rotation: jax.Array,
    position: jax.Array,
    counted: jax.Array,
    noise: tuple[jax.Array, jax.Array],
    count: jax.Array,
) -> jax.Array:
    """Choose the lag: the fewest samples at which the median chord is long compared with the noise.

    The median chord should be 70 times the noise in position and in orientation; or more, up to 1000 times,
    until it is 5 % of the longest that the motion makes, because some axis may move far less than the body
    does; or 80 % of the longest. It should turn by no more than 20 degrees, and at least six chords must fit
    in the window. A group (position or orientation) whose motion hardly grows with the lag does not count.

    Args:
        rotation: (3, 3, K+1, N) rotation matrices.
        position: (3, K+1, N) m.
        counted: (K+1, N) bool, which poses count.
        noise: as :func:`estimate_noise` returns it.
        count: (N,) number of poses in each window, padding left out.

    Returns:
        (N,) int32, samples between the two poses of a chord.
    """
    lags = _candidates(counted.shape[0])
    chords, masks = [], []
    for lag in lags:
        shift = jnp.sum(jnp.square(position[:, lag:] - position[:, :-lag]), axis=0)
        turn = jnp.sum(jnp.square(rotation[:, :, lag:] - rotation[:, :, :-lag]), axis=(0, 1)) / 2
        chords.append(jnp.pad(jnp.sqrt(jnp.stack([shift, turn], axis=1)), ((0, lag - 1), (0, 0), (0, 0))))
        masks.append(jnp.pad(counted[lag:] & counted[:-lag], ((0, lag - 1), (0, 0))))
    mask = jnp.stack(masks, axis=1)[:, :, None]
    sizes = jnp.stack(chords, axis=1)
    sizes = masked_median(sizes, jnp.broadcast_to(mask, sizes.shape))  # (lags, 2, N)
    allowed = jnp.stack([(lag == 1) | (lag * _SHARE <= count - 1) for lag in lags])
    wanted = jnp.zeros(count.shape, jnp.int32)
    for group in range(2):
        wanted = jnp.maximum(wanted, _needed(sizes[:, group] / noise[group][None], allowed, lags))
    within = jnp.cumsum((allowed & (sizes[:, 1] <= _TURN)).astype(jnp.int32), axis=0, dtype=jnp.int32)
    # the last of those before which all turn less
    so_far = within == 1 + np.arange(len(lags), dtype=np.int32)[:, None]
    longest = jnp.maximum(jnp.sum(so_far, axis=0, dtype=jnp.int32) - 1, 0)
    return jnp.asarray(lags, jnp.int32)[jnp.minimum(wanted, longest)]


def _needed(size: jax.Array, allowed: jax.Array, lags: list[int]) -> jax.Array:
    """Index of the lag that a group needs, (N,), from the chords (lags, N) in units of their noise."""
    size = jnp.where(allowed, size, 0)
    largest = jnp.max(size, axis=0)
    goal = jnp.maximum(_CHORD, jnp.minimum(_LONG_CHORD, _PART * largest))
    goal = jnp.minimum(goal, _SATURATED * largest)
    found = jnp.argmax(size >= goal[None], axis=0).astype(jnp.int32)
    quarter = [max(i for i, other in enumerate(lags) if other * 4 <= max(lag, 4)) for lag in lags]
    before = jnp.take_along_axis(size, jnp.asarray(quarter, jnp.int32)[found][None], axis=0)[0]
    here = jnp.take_along_axis(size, found[None], axis=0)[0]
    before, here = (jnp.sqrt(jnp.maximum(jnp.square(x) - _OF_NOISE**2, 0)) for x in (before, here))
    drifts = (jnp.asarray(lags, jnp.int32)[found] >= 4) & (here < _GROWS * before)
    return jnp.where(drifts, 0, found)

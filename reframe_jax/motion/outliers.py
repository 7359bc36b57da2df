"""Find outliers: poses that jump away and return, for example when a tracker flips an axis or swaps markers.

The search predicts each pose five times, by interpolation between a pose one to five strides before and the
pose as many strides after. A pose is an outlier under four conditions: its distance from the median
prediction is large compared with usual distances; the five predictions agree with each other; the pose also
lies far from the extrapolated motion before it and from that after it; and the path has a corner nearby. In
fast smooth motion and at a single corner, the predictions do not agree. A body that jumps and stays at its
new place agrees with the motion after the jump. A short fast motion between two rests has no corner.

An outlier does not enter the moments. Between the poses beside it, the twist is constant.
Arrays have components first, then samples, and windows last.
"""

import jax
import jax.numpy as jnp
from jax import lax

from reframe_jax.geometry.small import pick, total
from reframe_jax.motion.noise import masked_median
from reframe_jax.motion.paths import move_along, twist_between

__all__ = ["repair_poses"]

Array = jax.Array
_REACH = 5  # number of predictions, and of neighbours on either side
_STRIDES = 1, 2, 4  # samples between neighbours; together they find runs of up to 10 outliers
_OUTLIER = 7.0  # smallest distance from the prediction, in medians of all distances: five standard deviations
_AGREE = 3.0  # the same, in medians of the distances of the five predictions from their median
_MOST = 0.3  # largest fraction of outliers; with more, no pose is an outlier
_APART = 0.5  # smallest distance from the extrapolated motion, as a fraction of that from the prediction
_CORNER = 0.35  # smallest corner near an outlier, as the same fraction; the ends of a run have 0.5
_NEAR = 6  # samples from an outlier to the corner, at most: runs may be twice as long
_JUMP = 4.0  # ratio of a fourth difference to the median, above which the search for outliers starts
_PASSES = 6  # largest number of searches: each search shortens long runs of outliers from their ends


def repair_poses(
    rotation: Array, position: Array, times: Array, count: Array, unit: Array
) -> tuple[Array, Array, Array]:
    """Find outliers, and replace them by interpolation between the poses beside them.

    Args:
        rotation: (3, 3, P, N).
        position: (3, P, N) m.
        times: (P, N) s.
        count: (N,) number of poses in each window; the poses after them are padding.
        unit: (N,) m, unit to which the positions are rounded, or 0.

    Returns:
        Rotations and positions with the shapes of the input, and (P, N) bool: which poses are measured, that
        is, neither outliers nor padding.
    """
    own = jnp.arange(position.shape[1], dtype=jnp.int32)[:, None] < count
    if position.shape[1] <= 2 * _REACH:
        return rotation, position, own
    measured: Array = lax.stop_gradient(jnp.concatenate([position, rotation[:, :2].reshape(6, *own.shape)]))
    # the size of a jump is not a unit of rounding: rounded positions also have steps of one unit
    step = jnp.abs(jnp.diff(measured[:3], axis=1))
    unit = jnp.minimum(unit, jnp.min(jnp.where((step > 0) & own[1:], step, jnp.inf), axis=(0, 1)))
    strides = jnp.asarray([stride for stride in _STRIDES if stride == 1 or len(own) > 2 * _REACH * stride])

    def search(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        counted, _, passes = carry
        filled = _interpolate(measured, times, counted)
        found = lax.map(lambda stride: _find(filled, corner, times, own, count, unit, stride), strides)
        # a window without a jump is not searched, whatever the other windows of the batch contain
        found = counted & ~(jnp.any(found, axis=0) & jumps)
        return found, jnp.any(found != counted), passes + 1

    jumps, corner = _has_jumps(measured, own), _corners(measured, times, own)
    start = own, jnp.any(jumps), jnp.int32(0)
    counted, _, _ = lax.while_loop(lambda c: c[1] & (c[2] < _PASSES), search, start)
    fraction = jnp.sum(own & ~counted, axis=0, dtype=position.dtype) / count.astype(position.dtype)
    counted = jnp.where(fraction <= _MOST, counted, own)

    def fill(_: None) -> tuple[Array, Array]:
        before, after, part = _beside(times, counted)
        first, second = ((pick(rotation, place, 2), pick(position, place, 1)) for place in (before, after))
        w, v = twist_between(first, second)
        turned, moved = move_along(first, part * w, part * v)
        return jnp.where(counted, rotation, turned), jnp.where(counted, position, moved)

    fixed = lax.cond(jnp.any(counted != own), fill, lambda _: (rotation, position), None)
    return *fixed, counted


def _has_jumps(x: Array, own: Array) -> Array:
    """Whether a fourth difference of poses x (9, P, N) is large, (N,): a fast test before the search."""
    whole = jnp.broadcast_to((own[:-4] & own[4:])[:, None], (x.shape[1] - 4, 2, own.shape[1]))
    size = jnp.swapaxes(_lengths(jnp.diff(x, n=4, axis=1)), 0, 1)
    rounding = 64 * jnp.finfo(x.dtype).eps * (1 + jnp.max(jnp.abs(x), axis=(0, 1)))
    return jnp.any(whole & (size > _JUMP * masked_median(size, whole) + rounding), axis=(0, 1))


def _corners(x: Array, times: Array, own: Array) -> Array:
    """Largest corner (2, P, N) of paths x (9, P, N) near every pose; a single outlier has its distance."""
    part = (times[1:-1] - times[:-2]) / (times[2:] - times[:-2])
    bend = x[:, 1:-1] - x[:, :-2] - part * (x[:, 2:] - x[:, :-2])
    size = jnp.where(own[4:], _lengths((2 * bend[:, 1:-1] - bend[:, :-2] - bend[:, 2:]) / 3), 0)
    around, zero = [(0, 0), (_NEAR + 2, _NEAR + 2), (0, 0)], jnp.zeros((), size.dtype)
    return lax.reduce_window(size, zero, lax.max, (1, 2 * _NEAR + 1, 1), (1, 1, 1), around)


def _find(
    x: Array, corner: Array, times: Array, own: Array, count: Array, unit: Array, stride: Array
) -> Array:
    """Return which poses x (9, P, N), position and two columns of the rotation, are outliers, (P, N) bool."""
    number, last = x.shape[1], count - 1
    whole = jnp.concatenate([x, times[None]])
    # the path is extended at both ends by reflection in its first and in its last pose
    reach = 2 * _REACH * max(_STRIDES)
    each = jnp.arange(-reach, number + reach, dtype=jnp.int32)[:, None]
    inside = jnp.clip(jnp.abs(jnp.where(each > last, 2 * last - each, each)), 0, number - 1)
    path = pick(whole, inside, 1)
    end = pick(whole, last[None], 1)
    path = jnp.where(each < 0, 2 * whole[:, :1] - path, path)
    path = lax.optimization_barrier(jnp.where(each > last, 2 * end - path, path))

    def beside(samples: Array) -> Array:
        """Return the poses and times (10, 5, P, N) at 1 to 5 times ``samples`` after every pose."""
        starts = [reach + k * samples for k in range(1, _REACH + 1)]
        parts = [
            lax.dynamic_slice_in_dim(path, start, number, 1, allow_negative_indices=False) for start in starts
        ]
        return jnp.stack(parts, axis=1)

    before, after = beside(-stride), beside(stride)
    part = (times - before[9]) / (after[9] - before[9])
    before, after = before[:9], after[:9]
    guesses = before + part * (after - before)
    middle = _median_of_five(guesses)
    # after a jump to another place, the path continues from the poses on one side
    behind, ahead = (
        _median_of_five(2 * near - beside(2 * side * stride)[:9]) for side, near in ((-1, before), (1, after))
    )
    distance, spread = _lengths(x - middle), _median_of_five(_lengths(guesses - middle[:, None]))  # (2, P, N)
    apart = jnp.minimum(_lengths(behind - x), _lengths(ahead - x)) > _APART * distance
    distance, spread, apart = lax.optimization_barrier((distance, spread, apart))  # computed once on a GPU
    mask = jnp.broadcast_to(own[:, None], (number, 2, own.shape[1]))
    typical = masked_median(jnp.swapaxes(distance, 0, 1), mask)[:, None]
    typical = jnp.maximum(typical, jnp.stack([unit / 2, jnp.zeros_like(unit)])[:, None])
    rounding = 64 * jnp.finfo(x.dtype).eps * (1 + jnp.max(jnp.abs(x), axis=(0, 1)))
    outlying = (distance > _OUTLIER * typical + rounding) & (distance > _AGREE * spread) & apart
    outlying = outlying & (corner > _CORNER * distance)
    return (outlying[0] | outlying[1]) & (count > 2 * _REACH * stride)


def _lengths(x: Array) -> Array:
    """Return the lengths (2, ...) of the position part and the rotation part of components (9, ...)."""
    square = x * x
    return jnp.sqrt(jnp.stack([total(square[:3], 0), total(square[3:], 0)]))


def _median_of_five(values: Array) -> Array:
    """Median (C, ...) over the second axis of values (C, 5, ...)."""
    a, b, c, d, e = (values[:, k] for k in range(5))
    low = jnp.maximum(jnp.minimum(a, b), jnp.minimum(c, d))
    high = jnp.minimum(jnp.maximum(a, b), jnp.maximum(c, d))
    return jnp.maximum(jnp.minimum(e, jnp.maximum(low, high)), jnp.minimum(low, high))


def _beside(times: Array, counted: Array) -> tuple[Array, Array, Array]:
    """Counted poses beside every pose, (P, N) each, and the part of the time between them that has passed."""
    number = len(times)
    here = jnp.arange(number, dtype=jnp.int32)[:, None]
    before = lax.cummax(jnp.where(counted, here, -1), axis=0)
    after = lax.cummin(jnp.where(counted, here, number), axis=0, reverse=True)
    before, after = jnp.where(before < 0, after, before), jnp.where(after == number, before, after)
    before, after = jnp.clip(before, 0, number - 1), jnp.clip(after, 0, number - 1)
    start, end = (pick(times, place, 0) for place in (before, after))
    return before, after, jnp.where(end > start, (times - start) / jnp.where(end > start, end - start, 1), 0)


def _interpolate(x: Array, times: Array, counted: Array) -> Array:
    """Replace components (C, P, N) of poses that are not counted by interpolation between counted poses."""
    before, after, part = _beside(times, counted)
    first = pick(x, before, 1)
    return jnp.where(counted, x, first + part * (pick(x, after, 1) - first))

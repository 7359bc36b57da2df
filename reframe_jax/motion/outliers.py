"""Find outliers: poses that jump away and back, after flips, swapped markers or lost frames.

A pose is predicted by interpolation between neighbours, one to five strides before and after the pose; the
prediction is the median of the five. An outlier lies far from the prediction while the five agree, and far
from where the poses before it, and those after it, lead. Smooth motion and corners of a path are no outliers,
because the five disagree there as much; a body that stays where it jumped to follows from the poses after the
jump.

Outliers do not count; paths that run across them use the motion interpolated between the poses beside them.
Arrays have components first, then samples, and windows last.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from reframe_jax.geometry.small import cross, normalize, total
from reframe_jax.motion.noise import masked_median

__all__ = ["repair_poses"]

Array = jax.Array
_REACH = 5  # predictions, and neighbours on either side
_STRIDES = 1, 2, 4  # samples between neighbours; together they find runs of up to 10 outliers
_OUTLIER = 7.0  # distance from the prediction, in medians of all distances: five standard deviations
_AGREE = 3.0  # the same in medians of the distances of the five from their median
_MOST = 0.3  # fraction of poses that can be outliers; beyond it nothing is left out
_APART = 0.5  # of the distance, that the poses on either side, continued, lie from the pose
_JUMP = 4.0  # fourth difference over its median, above which outliers are looked for
_PASSES = 6  # long runs shrink pass by pass


def repair_poses(
    rotation: Array, position: Array, times: Array, count: Array, unit: Array
) -> tuple[Array, Array, Array]:
    """Find outliers, and replace them by motion interpolated between the poses beside them.

    Args:
        rotation: (3, 3, P, N).
        position: (3, P, N) m.
        times: (P, N) s.
        count: (N,) number of poses in each window; the rest is padding.
        unit: (N,) m, that positions are rounded to, or 0.

    Returns:
        Rotations and positions, and which poses count, (P, N) bool: neither outliers nor padding.
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
        found = lax.map(lambda stride: _find(filled, times, own, count, unit, stride), strides)
        found = counted & ~jnp.any(found, axis=0)
        return found, jnp.any(found != counted), passes + 1

    start = own, _any_jumps(measured, own), jnp.int32(0)
    counted, _, _ = lax.while_loop(lambda c: c[1] & (c[2] < _PASSES), search, start)
    fraction = jnp.sum(own & ~counted, axis=0, dtype=position.dtype) / count.astype(position.dtype)
    counted = jnp.where(fraction <= _MOST, counted, own)

    def fill(_: None) -> tuple[Array, Array]:
        filled = _interpolate(jnp.concatenate([position, rotation.reshape(9, *own.shape)]), times, counted)
        first = normalize(filled[3:6])
        second = normalize(filled[6:9] - first * total(first * filled[6:9], 0))
        rows = jnp.stack([first, second, cross(first, second)])
        return jnp.where(counted, rotation, rows), jnp.where(counted, position, filled[:3])

    fixed = lax.cond(jnp.any(counted != own), fill, lambda _: (rotation, position), None)
    return *fixed, counted


def _any_jumps(x: Array, own: Array) -> Array:
    """Whether a fourth difference of poses x (9, P, N) stands out, (): a cheap test that misses no jump."""
    whole = jnp.broadcast_to((own[:-4] & own[4:])[:, None], (x.shape[1] - 4, 2, own.shape[1]))
    size = jnp.swapaxes(_lengths(jnp.diff(x, n=4, axis=1)[None])[:, 0], 0, 1)
    rounding = 64 * jnp.finfo(x.dtype).eps * (1 + jnp.max(jnp.abs(x), axis=(0, 1)))
    return jnp.any(whole & (size > _JUMP * masked_median(size, whole) + rounding))


def _find(x: Array, times: Array, own: Array, count: Array, unit: Array, stride: Array) -> Array:
    """Outliers among poses x (9, P, N): position, and two columns of the rotation; (P, N) bool.

    Beyond its ends, the path continues by reflection in its first and in its last pose.
    """
    number, last = x.shape[1], count - 1
    whole = jnp.concatenate([x, times[None]])
    ends = whole[:, :1], jnp.take_along_axis(whole, last[None, None], axis=1)

    def beside(samples: Array) -> Array:
        """Poses and times, 1 to 5 strides of ``samples`` away from every pose (negative: before it).

        (5, 10, P, N): 9 components and the time.
        """
        each = jnp.arange(1, _REACH + 1)[:, None, None] * samples + jnp.arange(number)[:, None]
        inside = jnp.abs(jnp.where(each > last, 2 * last - each, each))
        inside = jnp.clip(inside, 0, number - 1).reshape(-1, own.shape[1])
        path = jnp.take_along_axis(whole, inside[None], axis=1).reshape(10, _REACH, number, -1)
        path = jnp.where(each < 0, 2 * ends[0][:, None] - path, path)
        return jnp.swapaxes(jnp.where(each > last, 2 * ends[1][:, None] - path, path), 0, 1)

    before, after = beside(-stride), beside(stride)
    part = (times - before[:, 9]) / (after[:, 9] - before[:, 9])
    before, after = before[:, :9], after[:, :9]
    guesses = before + part[:, None] * (after - before)
    middle = _median_of_five(guesses)
    # after a jump to another place, the path continues from the poses on one side
    behind, ahead = (
        _median_of_five(2 * near - beside(2 * side * stride)[:, :9])
        for side, near in ((-1, before), (1, after))
    )
    lengths = _lengths(jnp.concatenate([jnp.stack([x - middle, behind - x, ahead - x]), guesses - middle]))
    distance, spread = lengths[:, 0], _median_of_five(jnp.moveaxis(lengths[:, 3:], 1, 0))  # (2, P, N)
    apart = jnp.minimum(lengths[:, 1], lengths[:, 2]) > _APART * distance
    mask = jnp.broadcast_to(own[:, None], (number, 2, own.shape[1]))
    typical = masked_median(jnp.swapaxes(distance, 0, 1), mask)[:, None]
    typical = jnp.maximum(typical, jnp.stack([unit / 2, jnp.zeros_like(unit)])[:, None])
    rounding = 64 * jnp.finfo(x.dtype).eps * (1 + jnp.max(jnp.abs(x), axis=(0, 1)))
    outlying = (distance > _OUTLIER * typical + rounding) & (distance > _AGREE * spread) & apart
    return (outlying[0] | outlying[1]) & (count > 2 * _REACH * stride)


def _lengths(x: Array) -> Array:
    """Lengths of shifts and of rotations, (2, M, ...), of components (M, 9, ...)."""
    groups = np.repeat(np.eye(2), (3, 6), axis=1)
    # a sum over a leading axis is fast as a product
    return jnp.sqrt(jnp.tensordot(jnp.asarray(groups, x.dtype), x * x, ((1,), (1,)), precision="highest"))


def _median_of_five(values: Array) -> Array:
    a, b, c, d, e = values
    low = jnp.maximum(jnp.minimum(a, b), jnp.minimum(c, d))
    high = jnp.minimum(jnp.maximum(a, b), jnp.maximum(c, d))
    return jnp.maximum(jnp.minimum(e, jnp.maximum(low, high)), jnp.minimum(low, high))


def _interpolate(x: Array, times: Array, counted: Array) -> Array:
    """Components (C, P, N) of poses that count; others on the way between the nearest that do."""
    number = x.shape[1]
    here = jnp.arange(number, dtype=jnp.int32)[:, None]
    before = lax.cummax(jnp.where(counted, here, -1), axis=0)
    after = lax.cummin(jnp.where(counted, here, number), axis=0, reverse=True)
    before, after = jnp.where(before < 0, after, before), jnp.where(after == number, before, after)
    before, after = jnp.clip(before, 0, number - 1), jnp.clip(after, 0, number - 1)
    start, end = (jnp.take_along_axis(times, place, axis=0) for place in (before, after))
    part = jnp.where(end > start, (times - start) / jnp.where(end > start, end - start, 1), 0)
    first, second = (jnp.take_along_axis(x, place[None], axis=1) for place in (before, after))
    return jnp.where(counted, x, first + part * (second - first))

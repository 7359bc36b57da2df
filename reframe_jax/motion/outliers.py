"""Find poses to leave out: those that repeat the previous pose, and outliers.

An outlier jumps away and returns, for example when a tracker flips an axis or swaps markers. A run of up to
twelve poses is an outlier if the poses around it agree with each other, but not with the run: the cubic
through the two poses before it and the two after it predicts the next pose on either side much better than
the first and the last pose of the run. The path jumps at both ends of the run. In a short fast motion, the
path leaves the cubic gradually: the ends of the run are closer to the cubic than its middle, and there is no
jump. The search tries the lengths of runs in turn, the shortest first, and removes what it finds, until no
length finds a run. A body that jumps and stays has no poses after the jump that agree with those before it.
Of the two poses at either end, one alone can be an outlier.

Arrays have components first, then samples, and windows last.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike

from reframe_jax.geometry.small import pick, total
from reframe_jax.motion.checks import MIN_VELOCITIES
from reframe_jax.motion.noise import masked_median
from reframe_jax.tuning import MOTION as C

Array = jax.Array
_REST = 12  # equal poses beyond which a body is at rest; up to then, a slow tracker repeats its poses
_LONGEST = 12  # poses of a run, at most
_AROUND = 6  # poses around a run: four for the cubic, and two that it has to predict
_PARTS = 8  # parts of a batch of windows
_MOST = 0.3  # largest fraction of outliers; with more, no pose is an outlier


def find_repeats(path: Array, own: Array) -> Array:
    """Find poses that repeat the previous one, because the recorder is faster than the tracker: (P, N) bool.

    A window with a rest, or with few different poses, has none.

    Args:
        path: (12, P, N) rotations and positions.
        own: (P, N) bool, False for padding.
    """
    new = jnp.any(path[:, 1:] != path[:, :-1], axis=0)
    number = jnp.pad(jnp.cumsum(new, axis=0, dtype=jnp.int32), ((1, 0), (0, 0)))
    rests = jnp.any((number[_REST:] == number[:-_REST]) & own[_REST:], axis=0)
    few = jnp.sum(new & own[1:], axis=0, dtype=jnp.int32) < MIN_VELOCITIES
    return jnp.pad(~new, ((1, 0), (0, 0))) & own & ~(rests | few)


def find_outliers(path: Array, steps: Array, count: Array, unit: Array, wanted: ArrayLike = True) -> Array:
    """Find outliers, (P, N) bool.

    Args:
        path: (12, P, N) rotations, and positions in m.
        steps: (K, N) s, steps between the poses.
        count: (N,) number of poses in each window; the poses after them are padding.
        unit: (N,) m, unit to which the positions are rounded, or 0.
        wanted: () bool, whether to search at all.
    """
    own = jnp.arange(path.shape[1], dtype=jnp.int32)[:, None] < count
    if path.shape[1] <= _AROUND + 4:
        return jnp.zeros_like(own)
    times = jnp.pad(jnp.cumsum(steps, axis=0), ((1, 0), (0, 0)))
    # positions, and the first two columns of the rotations
    measured: Array = lax.stop_gradient(path[np.array([9, 10, 11, 0, 1, 3, 4, 6, 7], np.int32)])
    # the size of a jump is not a unit of rounding: rounded positions also have steps of one unit
    step = jnp.abs(jnp.diff(measured[:3], axis=1))
    unit = jnp.minimum(unit, jnp.min(jnp.where((step > 0) & own[1:], step, jnp.inf), axis=(0, 1)))
    size = _bends(measured)
    whole = jnp.broadcast_to(own[4:, None], (len(own) - 4, 2, own.shape[1]))
    noise = masked_median(jnp.swapaxes(size, 0, 1), whole)
    jumps = wanted & jnp.any(own[4:] & (size > C.noises * noise[:, None]), axis=(0, 1))
    rounding = 64 * jnp.finfo(size.dtype).eps * (1 + jnp.max(jnp.abs(measured), axis=(0, 1)))
    noise = jnp.maximum(noise, jnp.stack([unit / 2, jnp.zeros_like(unit)])) + rounding
    # only windows with jumps are searched, in parts, so that the other windows of the batch cost nothing
    part = -(-len(jumps) // _PARTS)
    order = jnp.argsort(~jumps, stable=True).astype(jnp.int32)

    def search(k: Array, found: Array) -> Array:
        at = jnp.take(order, k * part + jnp.arange(part, dtype=jnp.int32), mode="clip")
        columns = partial(jnp.take, indices=at, axis=-1, mode="clip")
        path = jnp.concatenate([columns(measured), columns(times)[None]])
        good = _measured(path, columns(noise), columns(count))
        return found.at[:, at].set(columns(own & jumps) & ~good)

    number = jnp.sum(jumps, dtype=jnp.int32)
    outliers = lax.fori_loop(0, (number + part - 1) // part, search, jnp.zeros_like(own))
    fraction = jnp.sum(outliers, axis=0, dtype=path.dtype) / count.astype(path.dtype)
    return outliers & (fraction <= _MOST)


def _measured(path: Array, noise: Array, count: Array) -> Array:
    """Return which poses and times (10, P, N) are no outliers, (P, N) bool; runs are removed one by one."""
    here = jnp.arange(path.shape[1], dtype=jnp.int32)[:, None]

    def search(carry: tuple[Array, ...]) -> tuple[Array, ...]:
        number, failures, path, order, left = carry
        starts = _runs(path, noise, left, number)
        found = here - lax.cummax(jnp.where(starts, here, -_LONGEST), axis=0) < number

        def remove(_: None) -> tuple[Array, ...]:
            # the found poses move to the end
            kept = jnp.argsort(found, axis=0, stable=True).astype(jnp.int32)
            fewer = left - jnp.sum(found, axis=0, dtype=left.dtype)
            return jnp.int32(0), pick(path, kept, 1), pick(order, kept, 0), fewer

        same = failures + 1, path, order, left
        return number % _LONGEST + 1, *lax.cond(jnp.any(found), remove, lambda _: same, None)

    # all lengths are tried in turn, until none of them finds a run
    order = jnp.broadcast_to(here, path.shape[1:])
    start: tuple[Array, ...] = jnp.int32(1), jnp.int32(0), path, order, count
    *_, path, order, left = lax.while_loop(lambda carry: carry[1] < _LONGEST, search, start)
    kept = (here < left) & ~_ends(path, noise, left)
    return pick(kept, jnp.argsort(order, axis=0), 0)


def _runs(path: Array, noise: Array, count: Array, number: Array) -> Array:
    """Return at which poses and times (10, P, N) a run of ``number`` outliers starts, (P, N) bool."""
    start = jnp.arange(path.shape[1], dtype=jnp.int32)[:, None]
    padded = jnp.pad(path, ((0, 0), (3, _LONGEST + 3), (0, 0)))

    def at(*offsets: int | Array) -> Array:
        """Return the path (10, M, P, N) at offsets from the start of the run."""
        cut = partial(lax.dynamic_slice_in_dim, padded, axis=1, allow_negative_indices=False)
        return jnp.stack([cut(start_index=3 + offset, slice_size=len(start)) for offset in offsets], axis=1)

    bends = jnp.pad(_bends(path[:9]), ((0, 0), (2, _LONGEST + 2), (0, 0)))
    at_end = lax.dynamic_slice_in_dim(bends, number - 1, len(start), 1, allow_negative_indices=False)
    bend = jnp.minimum(bends[:, : len(start)], at_end)
    possible = (start >= 2) & (start + number + 2 <= count)

    def compare(_: None) -> Array:
        near = at(-2, -1, number, number + 1, -3, number + 2, 0, number // 2, number - 1)
        known = jnp.stack(jnp.broadcast_arrays(start >= 3, start + number + 3 <= count))
        return possible & _are_apart(near[:, :6], known, near[:, 6:], bend, noise)

    jumps = possible & (bend > C.noises * noise[:, None])
    return lax.cond(jnp.any(jumps), compare, lambda _: jnp.zeros_like(possible), None)


def _ends(path: Array, noise: Array, count: Array) -> Array:
    """Return which of the two poses at either end of poses and times (10, P, N) are outliers, (P, N) bool."""
    here = jnp.arange(path.shape[1], dtype=jnp.int32)[:, None]
    inward = jnp.arange(_AROUND + 1, dtype=jnp.int32)[:, None]
    places = jnp.concatenate([inward + 0 * count, jnp.maximum(count - 1 - inward, 0)])
    near = pick(path, places, 1).reshape(10, 2, _AROUND + 1, -1)  # poses from either end inward
    around = jnp.stack([near[:, :, 1:], near[:, :, np.array([0, 2, 3, 4, 5, 6], np.int32)]], axis=2)
    run, known = near[:, None, :, :2], jnp.ones((2, 1, 1, 1), bool)
    apart = _are_apart(jnp.moveaxis(around, 3, 1), known, run, jnp.inf, noise).reshape(4, -1)
    ends = places.reshape(2, _AROUND + 1, -1)[:, :2].reshape(4, -1)
    return jnp.any(apart[:, None] & (here == ends[:, None]), axis=0) & (count > _AROUND)


def _are_apart(around: Array, known: Array, run: Array, bend: Array | float, noise: Array) -> Array:
    """Return whether poses disagree with those around them, (...) bool.

    Poses and times around the run are (10, 6, ...): four for the cubic, and two to test it, if ``known`` (2,
    ...). Those of the run are (10, M, ...): first, middle and last, or only one. ``bend`` (2, ...) is the
    smaller fourth difference across the ends of the run; it and ``noise`` (2, N) have the size of noise.
    """
    nodes, tested = around[:, :4], jnp.concatenate([around[:, 4:], run], axis=1)
    # Lagrange's cubic; poses outside of the path have no different times
    gaps = nodes[9, :, None] - nodes[9]
    gaps = jnp.prod(jnp.where(gaps == 0, 1, gaps), axis=1)
    away = tested[9, :, None] - nodes[9]
    product = jnp.prod(away, axis=1)
    weights = product[:, None] / jnp.where(away == 0, 1, away * gaps)
    predicted = total(weights * nodes[:9, None], 2)
    gain = 1 + total(weights * weights, 1)
    distance = _lengths(tested[:9] - predicted)  # (2, 2 + M, ...)
    others, first, middle, last = distance[:, :2], *(distance[:, i] for i in (2, 2 + len(run[0]) // 2, -1))
    ends = jnp.minimum(first, last)
    noise = C.noises * noise.reshape(2, *[1] * (ends.ndim - 2), -1)
    limit = noise * jnp.sqrt(jnp.max(gain[2:], axis=0))
    # the error of the cubic is proportional to the product of the distances: between gaps it is larger
    error = jnp.maximum(1, jnp.maximum(jnp.abs(product[2]), jnp.abs(product[-1])) / jnp.abs(product[:2]))
    agree = C.agree * jnp.max(jnp.where(known, others * error, 0), axis=1)
    apart = (ends > limit) & (ends > agree) & (ends > C.sudden * middle)
    return jnp.any(apart & (bend > noise) & (bend > C.jump * ends), axis=0)


def _bends(path: Array) -> Array:
    """Return fourth differences (2, P - 4, N) of a path (9, P, N) about its poses, with the size of noise."""
    ends, beside = path[:, 4:] + path[:, :-4], path[:, 3:-1] + path[:, 1:-3]
    return _lengths(ends - 4 * beside + 6 * path[:, 2:-2]) / 70**0.5  # the gain of white noise


def _lengths(x: Array) -> Array:
    """Return the lengths (2, ...) of the position part and the rotation part of components (9, ...)."""
    square = x * x
    return jnp.sqrt(jnp.stack([total(square[:3], 0), total(square[3:], 0)]))

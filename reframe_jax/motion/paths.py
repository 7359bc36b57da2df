"""Integrate the twist of a measured motion, in the axes of the body and of the ground.

Between two poses, the logarithm of the step is the integral of the twist plus brackets that mix its
components (the expansion of Magnus). The brackets are computed from derivatives of the twist and taken out: a
component of the twist that is always zero stays zero. The error is of the sixth order in the sample time, or
of the third order for times that jitter or come in bursts.

Arrays have components first, then twists in {b} and in {g}, then samples, and windows last.
"""

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry.small import axial, cross, materialize, pick, times, total, trace
from reframe_jax.tuning import MOTION

Array = jax.Array
_STENCIL = 7  # samples in the derivative of the twist
_NEAR = 2  # nodes on either side in a derivative across such steps
_GAIN = 100.0  # of the noise of poses in such a derivative times the squared step, above which it shrinks
_EVEN = 5  # longest over shortest step, above which exact derivatives across them amplify noise
_USUAL = 0.9  # fraction of the steps that are no gaps; a gap is _EVEN times longer than the longest of them


def _logarithm(turn: Array) -> tuple[Array, Array]:
    """Rotation vectors (3, ...) below a half turn, and (1 - (x / 2) cot(x / 2)) / x^2 of their angles x."""
    tiny = jnp.finfo(turn.dtype).eps ** 2
    half_cosine = jnp.sqrt(jnp.maximum(1 + trace(turn), tiny)) / 2
    half_sine = -axial(turn) / (4 * half_cosine)  # of the half angle, times the axis
    squared = total(half_sine * half_sine, 0)
    small = squared < 1e-4
    length = jnp.sqrt(jnp.where(small, 1.0, squared))
    ratio = squared / half_cosine**2
    series = (2 - ratio * (2 / 3 - ratio * (2 / 5 - ratio * (2 / 7 - ratio * 2 / 9)))) / half_cosine
    factor = jnp.where(small, series, 2 * jnp.arctan2(length, half_cosine) / length)
    w = factor * half_sine
    angle = total(w * w, 0)
    series = 1 / 12 + angle * (1 / 720 + angle * (1 / 30240 + angle * (1 / 1209600 + angle / 47900160)))
    closed = (1 - factor * half_cosine / 2) / jnp.where(small, 1.0, angle)
    return w, jnp.where(small, series, closed)


def twist_between(first: tuple[Array, Array], second: tuple[Array, Array]) -> tuple[Array, Array]:
    """Rotation (3, ...) rad and translation (3, ...) m, in {b}, of the constant twist between two poses.

    A pose is a rotation (3, 3, ...) and a position (3, ...).
    """
    back = jnp.swapaxes(first[0], 0, 1)
    w, factor = _logarithm(times(back, second[0]))
    shift = times(back, second[1] - first[1])
    across = cross(w, shift)
    return w, shift - across / 2 + factor * cross(w, across)


def step_twists(first: tuple[Array, Array], second: tuple[Array, Array]) -> Array:
    """Logarithms (3, 2, 2, K, N) of the steps between poses: rotations (3, 3, K, N), positions (3, K, N) m.

    The logarithms are twists times the sample time: rotations (rad) and translations (m), in {b} and in {g}.
    """
    w, v = materialize(twist_between(first, second))
    turned = materialize(times(first[0], w))
    moved = times(first[0], v) + cross(first[1], turned)
    return jnp.stack([jnp.stack([w, turned], axis=1), jnp.stack([v, moved], axis=1)], axis=1)


def mean_twists(logarithms: Array, steps: Array, count: Array) -> Array:
    """Mean twist over every step, without the brackets of the Magnus expansion.

    Brackets mix components: with them, constrained axes have an error that more data does not reduce (0.1
    degrees and 0.3 mm for fast motion at a sample time of 0.1 s). In windows with very different steps, where
    high derivatives would amplify the noise, only brackets with the first derivative are taken out.

    Args:
        logarithms: (3, 2, 2, K, N) of the steps; see :func:`step_twists`.
        steps: (1, K) or (N, K) s, sample times.
        count: (1,) or (N,) number of poses; the others are padding.

    Returns:
        (3, 2, 2, K, N): angular (rad/s) and linear (m/s) velocities, in {b} and in {g}.
    """
    h, even = steps.T, _are_even(steps)
    twist = logarithms / h
    return twist - _brackets(twist, _derivative_weights(steps, even, count - 1), h, even)


def twist_paths(
    rotation: Array, position: Array, steps: Array, count: Array, mean: Array, about_mean: Array | bool
) -> tuple[Array, Array]:
    """Integrate the twist from the first pose to every pose; poses as in :func:`.pose_features`.

    The result is rotations (3, 2, P, N), rad, and translations (3, 2, P, N), m, in {b} and {g}. With
    ``about_mean`` () bool, it is the logarithm of every pose relative to a pose with the mean rotation
    ``mean`` (3, 3, N) and the position 0, which needs no order of the poses.
    """
    turned, moved = (jnp.concatenate([x[..., :1, :], x[..., :-1, :]], axis=-2) for x in (rotation, position))
    former = jnp.where(about_mean, mean[:, :, None], turned), jnp.where(about_mean, 0, moved)
    logarithms = step_twists(former, (rotation, position))
    path, reach = mean_twists(logarithms[:, :, :, 1:], steps, count) * steps.T, 1
    while reach < path.shape[3]:  # running sums, by doubling
        later = path[:, :, :, reach:] + path[:, :, :, :-reach]
        path, reach = jax.lax.dynamic_update_slice_in_dim(path, later, reach, 3), 2 * reach
    path = jnp.where(about_mean, logarithms, jnp.pad(path, ((0, 0), (0, 0), (0, 0), (1, 0), (0, 0))))
    return path[:, 0], path[:, 1]


def sections_of(path: Array, steps: Array, count: Array) -> Array:
    """Number the sections between the gaps of recordings from 0, (K+1, N) int for every pose.

    The twist within a gap is not known, so that its integral is known only from pose to pose of a section. If
    the body moves no further in long steps than in others, poses arrived in bursts, and there are no gaps.

    The path (12, K+1, N) has rotations, and positions in m; the steps are (K, N), s, and ``count`` (N,) is
    the number of poses before the padding.
    """

    def number(_: None) -> Array:
        own = jnp.arange(1, path.shape[1])[:, None] < count
        gaps = own & (steps > _EVEN * jnp.sort(steps, axis=0)[int(_USUAL * len(steps))])
        square = jnp.square(jnp.diff(path, axis=1))
        moved = jnp.stack([jnp.sum(square[:9], axis=0), jnp.sum(square[9:], axis=0), jnp.ones_like(steps)])
        sums = jnp.sum(moved * jnp.stack([gaps, own & ~gaps])[:, None], axis=2)
        across, usual = sums[:, :2] / sums[:, 2:]
        gaps = gaps & jnp.any(across > MOTION.gap**2 * usual, axis=0)
        return jnp.cumsum(gaps, axis=0, dtype=jnp.int32)

    even = jnp.all(_are_even(steps.T))  # then, there is no gap
    after = jax.lax.cond(even, lambda _: jnp.zeros(steps.shape, jnp.int32), number, None)
    return jnp.pad(after, ((1, 0), (0, 0)))


def _are_even(steps: Array) -> Array:
    """Return whether the steps (N, K) of a window have similar durations, (N,) bool."""
    return jnp.max(steps, axis=1) <= _EVEN * jnp.min(steps, axis=1)


def bracket(a: Array, b: Array) -> Array:
    """Return the Lie bracket (wa x wb, wa x vb + va x wb) of twists (3, 2, ...), angular and linear parts."""
    a, b = materialize((a, b))
    turned = cross(a[:, :1], b)
    return jnp.concatenate([turned[:, :1], turned[:, 1:] + cross(a[:, 1:], b[:, :1])], axis=1)


def _brackets(means: Array, weights: Array, h: Array, even: Array) -> Array:
    """Brackets of mean twists (3, 2, 2, K, N); windows with ``even`` (N,) bool take higher derivatives.

    With a1 = h V, a2 = h^2 V', a3 = h^3 V''/2, a4 = h^4 V'''/6 at the middle of a step of length h, the
    logarithm of the step is, for the spatial twist V (Blanes, Casas, Oteo & Ros 2009),

        a1 + a3/12 - [a1,a2]/12 - [a1,a4]/80 + [a2,a3]/240 + [a1,[a1,a3]]/360 - [a2,[a1,a2]]/240
           + [a1,[a1,[a1,a2]]]/720,

    and for the body twist the same with every bracket turned round.
    """
    side = jnp.asarray([-1.0, 1.0], means.dtype)[:, None, None]
    first = _derivative(weights, means)
    second = jnp.where(even, _derivative(weights, first), 0)
    # from the mean to the middle of the step; steps of unequal length jump in this, so no derivative
    # may be taken of anything that still has a factor h in it
    middle = means + jnp.where(even, h**2 * ((side / 12) * bracket(means, first) - (1 / 24) * second), 0)
    a1, a3 = h * middle, h**3 * (1 / 2) * second
    higher = _derivative(weights, jnp.concatenate([middle, second], axis=2))
    a2, a4 = h**2 * higher[:, :, :2], h**4 * (1 / 6) * higher[:, :, 2:]
    a12 = bracket(a1, a2)
    # the terms above, grouped by their outer factor
    inner = bracket(a1, side / 720 * a12 + 1 / 360 * a3)
    outer = bracket(a1, inner - side / 12 * a2 - side / 80 * a4)
    return (outer + bracket(a2, side / 240 * a3 - 1 / 240 * a12)) / h


def _derivative_weights(steps: Array, even: Array, count: Array) -> Array:
    """Finite-difference weights (2 n - 1, K, N), 1/s, of the nodes from n - 1 before each one to n - 1 after.

    The nodes are the middles of the steps, of which ``count`` (N,) are not padding. Each derivative uses the
    seven nearest, and is exact for polynomials of degree 6. In windows without ``even`` (N,) bool, it uses up
    to two on either side, and is smaller where short steps would amplify the noise of poses.
    """
    number = steps.shape[1]
    nodes = min(_STENCIL, number)
    each, nth = np.arange(number), np.arange(nodes)
    first = jnp.clip(each[:, None] - nodes // 2, 0, jnp.maximum(count - nodes, 0))  # (K, N)
    windows = max(steps.shape[0], first.shape[1])
    first = jnp.broadcast_to(first, (number, windows))
    every = (first + nth[:, None, None]).reshape(-1, windows)
    spans = pick(jnp.broadcast_to(steps.T, (number, windows)), every, 0).reshape(nodes, number, windows)
    ends = jnp.cumsum(spans, axis=0) - spans / 2
    # Lagrange's polynomial of node i has the derivative (c_h / c_i) / (t_h - t_i) at node h, c_i being
    # the product of t_i - t_j over the other nodes j; those of all nodes add up to zero
    own = each[:, None] - first
    used = (even | (jnp.abs(nth[:, None, None] - own) <= _NEAR)) & (first + nth[:, None, None] < count)
    gaps = ends[:, None] - ends[None]
    eye = np.eye(nodes, dtype=bool)[:, :, None, None]
    products = jnp.prod(jnp.where(eye | ~used, 1, gaps), axis=1)
    here = nth[:, None, None] == own  # the node of this step
    gap = jnp.sum(jnp.where(here, ends, 0), axis=0) - ends
    mine = jnp.sum(jnp.where(here, products, 0), axis=0)
    others = jnp.where(here | ~used, 0, mine / (products * jnp.where(gap == 0, 1, gap)))
    weights = jnp.where(here, -jnp.sum(others, axis=0), others)
    gain = jnp.sum(jnp.square(weights / spans), axis=0) * jnp.square(jnp.square(steps.T) / _GAIN)
    weights = weights / jnp.where(even, 1, jnp.maximum(gain, 1))
    offset = jnp.arange(1 - nodes, nodes)[:, None, None, None]
    at = first + nth[:, None, None] - each[:, None]
    return jnp.sum(jnp.where(at == offset, weights, 0), axis=1)


def _derivative(weights: Array, x: Array) -> Array:
    """Derivative of samples (3, 2, 2, K, N) with weights of :func:`_derivative_weights`."""
    number = x.shape[3]
    reach = weights.shape[0] // 2
    padded = jnp.pad(x[None], ((0, 0), (0, 0), (0, 0), (0, 0), (reach, reach), (0, 0)))
    each = jax.lax.split(weights[:, None, None, None], (1,) * len(weights))
    terms = [weight * padded[:, :, :, :, j : j + number] for j, weight in enumerate(each)]
    return materialize(sum(terms[1:], terms[0])[0])

"""Compute the mean of the twist over each step from the logarithm of the step (Magnus expansion)."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry.small import components_first, cross

__all__ = ["without_brackets"]

_STENCIL = 7  # samples in the derivative of the twist
_EVEN = 5  # largest ratio of two steps; beyond this ratio, derivatives amplify the noise


def _stencil(dt: jax.Array) -> tuple[np.ndarray, jax.Array]:
    """Finite-difference weights on irregular nodes: exact for polynomials of degree 6.

    The nodes are the midpoints of the steps, (..., K) s; each derivative uses the seven nearest nodes.

    Returns:
        The nodes of each derivative, (K, n), and their weights, (..., K, n) in 1/s.
    """
    steps = dt.shape[-1]
    count = min(_STENCIL, steps)
    each = np.arange(steps)
    nodes = np.clip(each - count // 2, 0, steps - count)[:, None] + np.arange(count)
    spans = dt[..., nodes]
    time = jnp.cumsum(spans, axis=-1) - spans / 2
    # Lagrange's polynomial of node i has the derivative (c_h / c_i) / (t_h - t_i) at node h, where c_i is
    # the product of t_i - t_j over the other nodes j; the derivatives of all polynomials sum to zero
    gaps = time[..., :, None] - time[..., None, :]
    products = jnp.prod(jnp.where(jnp.broadcast_to(np.eye(count, dtype=bool), gaps.shape), 1, gaps), axis=-1)
    own = jnp.broadcast_to(nodes == each[:, None], time.shape)
    gap = jnp.sum(jnp.where(own[..., None], gaps, 0), axis=-2)
    here = jnp.sum(jnp.where(own, products, 0), axis=-1, keepdims=True)
    others = jnp.where(own, 0, here / (products * jnp.where(own, 1, gap)))
    return nodes, jnp.where(own, -jnp.sum(others, axis=-1, keepdims=True), others)


def _derivative(nodes: np.ndarray, weights: jax.Array, x: jax.Array) -> jax.Array:
    """Derivative of samples (m, K, ...), from nodes (K, n) and weights (K, n, ...)."""
    near = x[:, nodes.ravel()].reshape(len(x), *nodes.shape, *x.shape[2:])
    return jnp.sum(weights[None] * near, axis=2)


def without_brackets(body: jax.Array, spatial: jax.Array, dt: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Compute the mean of the twist over each step, to sixth order in dt.

    The logarithm of a step is the mean of the twist only if the twist is constant. Otherwise it contains Lie
    brackets, which mix the components: constrained axes get an error that more data does not reduce (0.1
    degrees and 0.3 mm for fast motion at dt = 0.1 s). With a1 = h V, a2 = h^2 V', a3 = h^3 V''/2 and a4 = h^4
    V'''/6 at the middle of a step of length h, the logarithm of the step is, for the spatial twist V (Blanes,
    Casas, Oteo & Ros 2009),

        a1 + a3/12 - [a1,a2]/12 - [a1,a4]/80 + [a2,a3]/240 + [a1,[a1,a3]]/360 - [a2,[a1,a2]]/240
           + [a1,[a1,[a1,a2]]]/720,

    and for the body twist the same with the opposite sign of every bracket. The terms without brackets are
    the mean of V over the step, in which a component that is always zero stays zero. The function subtracts
    the brackets. It does not do so in a window whose longest step exceeds five times the shortest, for
    example at a gap in the recording, because the derivatives of V would amplify the noise.

    Args:
        body: (6, K, ...) logarithms of the steps divided by dt, as body twists (w, v), rad/s and m/s.
        spatial: (6, K, ...) the same twists in {g}.
        dt: (..., K) durations of the steps, s.

    Returns:
        Mean body twists and mean spatial twists, with the shapes of the input.
    """
    nodes, weights = _stencil(dt)
    weights, h = components_first(weights, 1).swapaxes(0, 1), components_first(dt, 0)[None]
    even = jnp.max(h, axis=1, keepdims=True) <= _EVEN * jnp.min(h, axis=1, keepdims=True)
    slope = partial(_derivative, nodes, weights)
    return (
        body - jnp.where(even, _brackets(body, slope, h, -1.0), 0),
        spatial - jnp.where(even, _brackets(spatial, slope, h, 1.0), 0),
    )


def _brackets(
    means: jax.Array, slope: Callable[[jax.Array], jax.Array], h: jax.Array, turn: float
) -> jax.Array:
    """Sum of the brackets, with the opposite sign (-1) for body twists."""
    first = slope(means)
    second = slope(first)
    # from the mean to the midpoint of the step; unequal steps make the correction discontinuous, so
    # derivatives apply only to terms without a factor h
    middle = means - h**2 / 24 * second + h**2 * (turn / 12) * _bracket(means, first)
    a1, a2 = h * middle, h**2 * slope(middle)
    a3, a4 = h**3 / 2 * second, h**4 / 6 * slope(second)
    a12 = _bracket(a1, a2)
    # the terms of the docstring, grouped by their outer factor
    in_first = (turn / 720) * a12 + a3 / 360
    first_bracket = _bracket(a1, _bracket(a1, in_first) - (turn / 12) * a2 - (turn / 80) * a4)
    second_bracket = _bracket(a2, (turn / 240) * a3 - a12 / 240)
    return (first_bracket + second_bracket) / h


def _bracket(a: jax.Array, b: jax.Array) -> jax.Array:
    """Lie bracket of twists (w, v), (6, ...): (wa x wb, wa x vb - wb x va)."""
    wa, va, wb, vb = a[:3], a[3:], b[:3], b[3:]
    return jnp.concatenate([cross(wa, wb), cross(wa, vb) - cross(wb, va)])

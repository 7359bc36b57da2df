"""Mean twists from the logarithms of steps: the Magnus expansion without its brackets."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.motion.components import bracket, components_first

__all__ = ["without_brackets"]

_STENCIL = 7  # samples in the derivative of the twist
_EVEN = 5  # longest over shortest step, above which derivatives across them amplify noise


def _stencil(dt: jax.Array) -> tuple[np.ndarray, jax.Array]:
    """Finite-difference weights on irregular nodes: exact for polynomials of degree 6.

    The nodes are the middles of the steps, (..., K) s; each derivative uses the seven nearest.

    Returns:
        The nodes of each derivative, (K, n), and their weights, (..., K, n) in 1/s.
    """
    steps = dt.shape[-1]
    count = min(_STENCIL, steps)
    each = np.arange(steps)
    nodes = np.clip(each - count // 2, 0, steps - count)[:, None] + np.arange(count)
    spans = dt[..., nodes]
    time = jnp.cumsum(spans, axis=-1) - spans / 2
    # Lagrange's polynomial of node i has the derivative (c_h / c_i) / (t_h - t_i) at node h, c_i being
    # the product of t_i - t_j over the other nodes j; those of all nodes add up to zero
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
    """Mean twists of the steps with the brackets of the Magnus expansion removed, to sixth order in dt.

    With a1 = h V, a2 = h^2 V', a3 = h^3 V''/2, a4 = h^4 V'''/6 at the middle of a step of length h, the
    logarithm of the step is, for the spatial twist V (Blanes, Casas, Oteo & Ros 2009),

        a1 + a3/12 - [a1,a2]/12 - [a1,a4]/80 + [a2,a3]/240 + [a1,[a1,a3]]/360 - [a2,[a1,a2]]/240
           + [a1,[a1,[a1,a2]]]/720,

    and for the body twist the same with every bracket turned round. The terms without brackets average
    V over the step: a component that is always zero stays zero. The brackets mix components: left in,
    they are an error along constrained axes that no amount of data removes (0.1 degrees and 0.3 mm for
    lively motion at dt = 0.1 s). In a window whose steps differ widely, as across a gap in the recording,
    they are left in: the derivatives would make far more of the noise.

    Args:
        body: (6, K, ...) mean body twists.
        spatial: the same in {g}.
        dt: (..., K) s.

    Returns:
        Both, of the same shapes.
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
    """The brackets, which turn round for body twists (-1)."""
    first = slope(means)
    second = slope(first)
    # from the mean to the middle of the step; steps of unequal length jump in this, so no derivative
    # may be taken of anything that still has a factor h in it
    middle = means - h**2 / 24 * second + h**2 * (turn / 12) * bracket(means, first)
    a1, a2 = h * middle, h**2 * slope(middle)
    a3, a4 = h**3 / 2 * second, h**4 / 6 * slope(second)
    a12 = bracket(a1, a2)
    # the terms above, grouped by their outer factor
    in_first = (turn / 720) * a12 + a3 / 360
    first_bracket = bracket(a1, bracket(a1, in_first) - (turn / 12) * a2 - (turn / 80) * a4)
    second_bracket = bracket(a2, (turn / 240) * a3 - a12 / 240)
    return (first_bracket + second_bracket) / h

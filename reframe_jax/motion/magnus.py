"""Mean twists from the logarithms of steps: the Magnus expansion without its brackets."""

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.motion.components import bracket, components_first

__all__ = ["without_brackets"]

_STENCIL = 7  # samples in the derivative of the twist
_EVEN = 5  # longest over shortest step, above which derivatives across them amplify noise


def _derivative_weights(dt: jax.Array, count: jax.Array | None = None) -> jax.Array:
    """Finite-difference weights on irregular nodes: exact for polynomials of degree 6.

    The nodes are the middles of the steps; each derivative uses the seven nearest.

    Args:
        dt: (..., K) s.
        count: (...) how many of the steps count, 7 or more; the others are padding. All by default.

    Returns:
        (..., K, n) in 1/s, for the derivative at each node: the weights of n consecutive nodes, or with a
        ``count`` those of the nodes from 6 before it to 6 after it.
    """
    steps = dt.shape[-1]
    n = min(_STENCIL, steps)
    each = np.arange(steps, dtype=np.int32)
    nth = np.arange(n, dtype=np.int32)
    if count is None:
        first = jnp.asarray(np.clip(each - n // 2, 0, steps - n))
        spans = dt[..., first[:, None] + nth[None]]
    else:
        each = each.reshape(*[1] * count.ndim, -1)
        first = jnp.clip(each - n // 2, 0, count[..., None] - n)
        dt = jnp.broadcast_to(dt, first.shape)
        nth = nth.reshape(*[1] * first.ndim, -1)
        nodes = first[..., None] + nth
        spans = jnp.take_along_axis(dt, nodes.reshape(*first.shape[:-1], -1), axis=-1).reshape(nodes.shape)
    time = jnp.cumsum(spans, axis=-1) - spans / 2
    # Lagrange's polynomial of node i has the derivative (c_h / c_i) / (t_h - t_i) at node h, c_i being
    # the product of t_i - t_j over the other nodes j; those of all nodes add up to zero
    gaps = time[..., :, None] - time[..., None, :]
    products = jnp.prod(jnp.where(jnp.broadcast_to(np.eye(n, dtype=bool), gaps.shape), 1, gaps), axis=-1)
    own_place = (each - first)[..., None]
    here = jnp.broadcast_to(nth.reshape(*[1] * (own_place.ndim - 1), -1) == own_place, time.shape)
    inside = jnp.any(here, axis=-1, keepdims=True)  # everywhere but in padding
    gap = jnp.where(inside, jnp.sum(jnp.where(here[..., None], gaps, 0), axis=-2), 1)
    own = jnp.sum(jnp.where(here, products, 0), axis=-1, keepdims=True)
    others = jnp.where(here, 0, own / (products * jnp.where(here, 1, gap)))
    weights = jnp.where(here, -jnp.sum(others, axis=-1, keepdims=True), others)
    if count is None:
        return weights
    place = first - each + (n - 1)  # of the first node, counted from 6 before
    offsets = np.arange(2 * n - 1, dtype=np.int32).reshape((*nth.shape[:-1], -1))
    rows = [jnp.where(place[..., None] + i == offsets, weights[..., i, None], 0) for i in range(n)]
    return sum(rows[1:], rows[0])


def _derivative(weights: jax.Array, x: jax.Array) -> jax.Array:
    """Derivative of samples (m, K, ...) with weights (n, K, ...), see :func:`_derivative_weights`."""
    n, steps = weights.shape[:2]
    if n > _STENCIL:  # centred
        margin = n // 2
        padded = jnp.pad(x, ((0, 0), (margin, margin), *[(0, 0)] * (x.ndim - 2)))
        shifted = [weights[j, None] * padded[:, j : steps + j] for j in range(n)]
        return sum(shifted[1:], shifted[0])
    margin = n // 2
    ends = [
        jnp.sum(weights[None, :, rows] * x[:, nodes, None], axis=1)
        for rows, nodes in (
            (slice(margin), slice(n)),
            (slice(steps - n + 1 + margin, None), slice(steps - n, None)),
        )
    ]
    inner = weights[:, margin : steps - n + 1 + margin]
    shifted = [inner[j, None] * x[:, j : steps - n + 1 + j] for j in range(n)]
    return jnp.concatenate([ends[0], sum(shifted[1:], shifted[0]), ends[1]], axis=1)


def without_brackets(
    body: jax.Array, spatial: jax.Array, dt: jax.Array, count: jax.Array | None = None
) -> tuple[jax.Array, jax.Array]:
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
        body: (6, K, ...) mean body twists, or (3, K, ...) mean angular velocities in {b}.
        spatial: the same in {g}.
        dt: (..., K) s.
        count: see :func:`_derivative_weights`.

    Returns:
        Both, of the same shapes.
    """
    weights, h = (components_first(_derivative_weights(dt, count), 1)), components_first(dt, 0)[None]
    even = components_first(
        jnp.max(dt, axis=-1, keepdims=True) <= _EVEN * jnp.min(dt, axis=-1, keepdims=True), 0
    )
    return (
        body - jnp.where(even[None], _brackets(body, weights, h, -1.0), 0),
        spatial - jnp.where(even[None], _brackets(spatial, weights, h, 1.0), 0),
    )


def _brackets(means: jax.Array, weights: jax.Array, h: jax.Array, turn: float) -> jax.Array:
    """The brackets, which turn round for body twists (-1)."""
    # constants are multiplied with, as in h * (1 / 24): in float64 a division takes a GPU far longer
    first = _derivative(weights, means)
    second = _derivative(weights, first)
    # from the mean to the middle of the step; steps of unequal length jump in this, so no derivative
    # may be taken of anything that still has a factor h in it
    middle = means - h**2 * (1 / 24) * second + h**2 * (turn / 12) * bracket(means, first)
    a1, a2 = h * middle, h**2 * _derivative(weights, middle)
    a3, a4 = h**3 * (1 / 2) * second, h**4 * (1 / 6) * _derivative(weights, second)
    a1, a2, a3, a4 = (a1, a2, a3, a4)
    a12 = bracket(a1, a2)
    # the terms above, grouped by their outer factor
    in_first = (turn / 720) * a12 + (1 / 360) * a3
    first_bracket = bracket(a1, bracket(a1, in_first) - (turn / 12) * a2 - (turn / 80) * a4)
    second_bracket = bracket(a2, (turn / 240) * a3 - (1 / 240) * a12)
    return (first_bracket + second_bracket) * (1 / h)

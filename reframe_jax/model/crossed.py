"""Two axes that keep their angle, one in each body: the cross of a universal joint.

The angle of an axis a of the ground and an axis b of the body is held: a'R b is a coordinate of variance
c_s(a, b), bilinear in the moments of R. The fit minimises sum_s n_s log c_s by Levenberg and Marquardt's
steps.
"""

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.model.small import largest, normalize, once, solve_arrow, times, total

__all__ = ["crossed_axes"]

Array = jax.Array
_APART = 30.0  # weight of the squared cosine of the mean angle: axes along each other hold it in any motion


def crossed_axes(
    forms: Array, details: Array, mean: Array, ground: Array, body: Array, apart: int, steps: int
) -> tuple[Array, Array, Array]:
    """Axes after a number of steps.

    Args:
        forms: (3, 3, 3, 3, S, ...) moments of R, entry by entry.
        details: (S, ...).
        mean: (3, 3, ...) mean rotation.
        ground: (3, ...) axis a to start from.
        body: (3, ...) axis b to start from.
        apart: number of first steps in which the mean axes are kept apart.
        steps: number of them.

    Returns:
        a (3, ...), b (3, ...), and the objective.
    """
    tiny = jnp.finfo(ground.dtype).tiny ** 0.5
    count = total(details, 0)

    def variance(a: Array, b: Array) -> tuple[Array, Array, Array, Array]:
        of_body = total(once(total(forms * a[:, None, None, None, None], 0)) * a[:, None, None], 1)  # (j, l)
        across = once(total(forms * b[:, None, None, None], 1))  # (i, k, l)
        of_ground = once(total(across * b[:, None], 2))  # (i, k)
        mixed = total(across * a[:, None, None], 1)  # (i, l)
        size = total(total(of_ground * a[:, None, None], 0) * a[:, None], 0) + tiny
        return once((size, of_ground, of_body, mixed))

    def size_of(a: Array, b: Array) -> Array:
        half = once(total(total(forms * a[:, None, None, None, None], 0) * b[:, None, None, None], 0))
        return total(total(half * a[:, None, None], 0) * b[:, None], 0) + tiny

    def step(i: int, carry: tuple[Array, ...]) -> tuple[Array, ...]:
        a, b, damping, _ = carry
        size, *parts = variance(a, b)
        push = jnp.where(i < apart, _APART, 0.0) * count
        weight = once(details / size)
        axes = jnp.stack([a, b])
        pull = once(jnp.stack([times(mean, b), times(jnp.swapaxes(mean, 0, 1), a)]))
        cosine = total(a * pull[0], 0)
        value = total(details * jnp.log(size), 0) + push * cosine * cosine
        top, low, between = once([total(part * weight, 2) for part in parts])
        gradient = jnp.stack([times(top, a), times(low, b)]) + push * cosine * pull
        # lengths do not count
        gradient = gradient - axes * total(axes * gradient, 1)[:, None]
        blocks = once(jnp.stack([top, low]) + push * pull[:, :, None] * pull[:, None])
        scale = largest(largest(jnp.stack([blocks[:, i, i] for i in range(3)])))
        unit = jnp.asarray(np.eye(3), a.dtype).reshape(3, 3, *[1] * scale.ndim)
        blocks = blocks + unit * ((damping + 1e-9) * scale + tiny)
        blocks = blocks + 10 * scale * axes[:, :, None] * axes[:, None]
        coupled = between + push * pull[0][:, None] * pull[1][None]
        change = solve_arrow(once(blocks), once(coupled)[None], once(gradient))
        c, d = once((normalize(a - change[0]), normalize(b - change[1])))
        cosine = total(c * times(mean, d), 0)
        new = total(details * jnp.log(size_of(c, d)), 0) + push * cosine * cosine
        value, new = once((value, new))
        lower = new < value
        damping = jnp.clip(jnp.where(lower, damping * 0.1, damping * 10), 1e-7, 1e4)
        value = jnp.where(lower, new, value)
        return jnp.where(lower, c, a), jnp.where(lower, d, b), damping, value

    zero = jnp.zeros_like(ground[0] * details[0])
    a, b, _, value = jax.lax.fori_loop(0, steps, step, (ground, body, zero + 1e-3, zero))
    return a, b, value

"""Two axes that keep their angle, one in each body: the cross of a universal joint.

The angle of an axis a of the ground and an axis b of the body is held: a'R b is a coordinate of variance
c_s(a, b), bilinear in the moments of R. The fit minimises sum_s n_s log c_s by Levenberg and Marquardt's
steps.
"""

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.model.small import largest, normalize, once, solve_positive, times, total

__all__ = ["crossed_axes"]

Array = jax.Array
_APART = 30.0  # weight of the squared cosine of the mean angle: axes along each other hold it in any motion


def crossed_axes(
    forms: Array, details: Array, mean: Array, ground: Array, body: Array, apart: bool, steps: int
) -> tuple[Array, Array, Array]:
    """Axes after a number of steps.

    Args:
        forms: (3, 3, 3, 3, S, ...) moments of R, entry by entry.
        details: (S, ...).
        mean: (3, 3, ...) mean rotation.
        ground: (3, ...) axis a to start from.
        body: (3, ...) axis b to start from.
        apart: whether the mean axes are kept apart.
        steps: number of them.

    Returns:
        a (3, ...), b (3, ...), and the objective.
    """
    small = jnp.finfo(ground.dtype).tiny ** 0.5
    push = _APART * total(details, 0) if apart else 0.0

    def variance(a: Array, b: Array) -> tuple[Array, Array, Array, Array]:
        half = once(total(forms * a[:, None, None, None, None], 0))  # (j, k, l)
        mixed = total(half * b[:, None, None, None], 0)  # (k, l): derivative by a_k of the first, b_l
        of_body = total(half * a[:, None, None], 1)  # (j, l)
        across = once(total(forms * b[:, None, None, None], 1))  # (i, k, l)
        of_ground = total(across * b[:, None], 2)  # (i, k)
        size = total(total(mixed * a[:, None, None], 0) * b[:, None], 0) + small
        return once((size, of_ground, of_body, mixed))

    def value_of(a: Array, b: Array, size: Array) -> Array:
        cosine = total(a * times(mean, b), 0)
        return total(details * jnp.log(size), 0) + push * cosine * cosine

    def step(_: int, carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        a, b, value, damping = carry
        size, of_ground, of_body, mixed = variance(a, b)
        weight = details / size
        turned, back = times(mean, b), times(jnp.swapaxes(mean, 0, 1), a)
        pull = jnp.concatenate([turned, back])
        upper, lower_block, between = (total(m * weight, 2) for m in (of_ground, of_body, mixed))
        gradient = jnp.concatenate([times(upper, a), times(lower_block, b)])
        gradient = gradient + push * total(a * turned, 0) * pull
        # the row (k, l) of `between` is a rate of a and a rate of b
        rows = [
            jnp.concatenate([upper, between], axis=1),
            jnp.concatenate([jnp.swapaxes(between, 0, 1), lower_block], axis=1),
        ]
        hessian = jnp.concatenate(rows) + push * pull[:, None] * pull[None]
        # lengths do not count
        zero = jnp.zeros_like(a)
        both = jnp.stack([jnp.concatenate([a, zero]), jnp.concatenate([zero, b])])
        gradient = gradient - total(both * total(both * gradient[None], 1)[:, None], 0)
        top = largest(jnp.stack([hessian[i, i] for i in range(6)]))
        unit = jnp.asarray(np.eye(6), a.dtype).reshape(6, 6, *[1] * value.ndim)
        lengths = total(both[:, :, None] * both[:, None], 0)
        hessian = hessian + unit * ((damping + 1e-9) * top + small) + 10 * top * lengths
        change = -solve_positive(*once((hessian, gradient)))
        c, d = normalize(a + change[:3]), normalize(b + change[3:])
        new = value_of(c, d, variance(c, d)[0])
        lower = new < value
        damping = jnp.clip(jnp.where(lower, damping * 0.1, damping * 10), 1e-7, 1e4)
        return jnp.where(lower, c, a), jnp.where(lower, d, b), jnp.where(lower, new, value), damping

    value = value_of(ground, body, variance(ground, body)[0])
    start = ground, body, value, jnp.full_like(value, 1e-3)
    a, b, value, _ = jax.lax.fori_loop(0, steps, step, start)
    return a, b, value

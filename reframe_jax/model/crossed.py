"""Two axes that keep their angle, one in each body: the cross of a universal joint.

The angle of an axis a of the ground and an axis b of the body is held: a'R b is a coordinate of variance
c_s(a, b), bilinear in the moments of R. The fit minimises sum_s n_s log c_s by Levenberg and Marquardt's
steps.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.model.small import largest, materialize, normalize, solve_positive, times, total

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
        steps: number of all steps.

    Returns:
        a (3, ...), b (3, ...), and the objective with what keeps them apart.
    """
    small = jnp.finfo(ground.dtype).tiny ** 0.5
    keep = _APART * total(details, 0)
    unit = jnp.asarray(np.eye(6), ground.dtype).reshape(6, 6, *[1] * (ground.ndim - 1))

    def expand(a: Array, b: Array) -> _Local:
        """The logarithm's sum and its tangent about two axes, without what keeps them apart."""
        across = materialize(total(forms * b[:, None, None, None], 1))  # (i, k, l)
        half = materialize(total(forms * a[:, None, None, None, None], 0))  # (j, k, l)
        mixed, of_body = total(half * b[:, None, None, None], 0), total(half * a[:, None, None], 1)
        of_ground, mixed = materialize((total(across * b[:, None], 2), mixed))  # (i, k) and (k, l)
        size = materialize(total(total(mixed * a[:, None, None], 0) * b[:, None], 0) + small)
        weight = materialize(details / size)
        upper, lower, between = materialize(tuple(total(m * weight, 2) for m in (of_ground, of_body, mixed)))
        gradient = jnp.concatenate([times(upper, a), times(lower, b)])
        rows = [
            jnp.concatenate([upper, between], axis=1),
            jnp.concatenate([jnp.swapaxes(between, 0, 1), lower], axis=1),
        ]
        turned, back = times(mean, b), times(jnp.swapaxes(mean, 0, 1), a)
        pull, cosine = jnp.concatenate([turned, back]), total(a * turned, 0)
        value = total(details * jnp.log(size), 0)
        return materialize(_Local(value, gradient, jnp.concatenate(rows), cosine, pull))

    def step(i: Array, carry: tuple[Array, Array, _Local, Array]) -> tuple[Array, Array, _Local, Array]:
        a, b, here, damping = carry
        push = jnp.where(i <= apart, keep, 0)
        gradient = here.gradient + push * here.cosine * here.pull
        hessian = here.hessian + push * here.pull[:, None] * here.pull[None]
        # lengths do not count
        zero = jnp.zeros_like(a)
        both = jnp.stack([jnp.concatenate([a, zero]), jnp.concatenate([zero, b])])
        gradient = materialize(gradient - total(both * total(both * gradient[None], 1)[:, None], 0))
        top = largest(total(hessian * unit, 1))
        lengths = total(both[:, :, None] * both[:, None], 0)
        lifted = hessian + unit * ((damping + 1e-9) * top + small) + 10 * top * lengths
        change = materialize(-solve_positive(*materialize((lifted, gradient))))
        c, d = materialize((normalize(a + change[:3]), normalize(b + change[3:])))
        new = expand(c, d)
        before = here.value + push * here.cosine * here.cosine
        lower = new.value + push * new.cosine * new.cosine < before
        kept = jax.tree.map(lambda x, y: jnp.where(lower, x, y), (c, d, new), (a, b, here))
        damping = jnp.clip(jnp.where(lower, damping * 0.1, damping * 10), 1e-7, 1e4)
        return *kept, damping

    # the first step stays at the start, and expands there
    start = jnp.zeros((6, *ground.shape[1:]), ground.dtype)
    none = jnp.zeros_like(start[0])
    nowhere = _Local(none + jnp.inf, start, start[None] + unit, none, start)
    damping = none + 1e-2
    a, b, here, _ = jax.lax.fori_loop(0, steps + 1, step, (ground, body, nowhere, damping))
    return a, b, here.value + keep * here.cosine * here.cosine


class _Local(NamedTuple):
    """Value, gradient (6, ...) and Hessian (6, 6, ...); cosine of the mean angle, and its gradient."""

    value: Array
    gradient: Array
    hessian: Array
    cosine: Array
    pull: Array

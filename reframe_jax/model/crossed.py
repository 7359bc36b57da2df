"""Find the two axes of a universal joint: one in each body, at a constant right angle.

The angle between an axis a of the ground and an axis b of the body is constant: a'R b is a held coordinate
with variance c_s(a, b), bilinear in the moments of R. Levenberg-Marquardt steps minimise sum_s n_s log c_s. A
penalty keeps the mean angle near a right angle: axes at any other angle may fit a short motion by chance, and
parallel axes fit every motion.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry.small import largest, materialize, normalize, solve_positive, times, total

Array = jax.Array
_APART = 3.0  # penalty on the squared cosine of the mean angle, per independent detail


def promising_pairs(
    forms: Array, details: Array, mean: Array, ground: Array, body: Array
) -> tuple[Array, Array]:
    """Choose, from nine pairs of axes, the three with the lowest objective: a (3, 3, N) and b (3, 3, N).

    Args:
        forms: (3, 3, 3, 3, S, N) moments of R, entry by entry.
        details: (S, N) number of independent details of each scale.
        mean: (3, 3, N) mean rotation.
        ground: (3, 3, N) axes of the ground, as columns.
        body: (3, 3, N) axes of the body, as columns.
    """
    of_ground = materialize(total(forms[:, :, :, :, None] * ground[:, None, None, None, :, None], 0))
    of_ground = materialize(total(of_ground * ground[:, None, :, None], 1))  # (j, l, a, S, N)
    half = total(of_ground[:, :, :, None] * body[:, None, None, :, None], 0)
    size = total(half * body[:, None, :, None], 0) + jnp.finfo(forms.dtype).tiny ** 0.5
    cosine = times(jnp.swapaxes(ground, 0, 1), times(mean, body))
    value = total(details * jnp.log(size), 2) + _APART * total(details, 0) * cosine * cosine
    best = jax.lax.top_k(-value.reshape(9, -1).T, 3)[1].T
    first, second = (
        jnp.take_along_axis(v, i[None], axis=1) for v, i in ((ground, best // 3), (body, best % 3))
    )
    return first, second


def crossed_axes(
    forms: Array, details: Array, mean: Array, ground: Array, body: Array, steps: int
) -> tuple[Array, Array, Array]:
    """Fit the two axes of a universal joint.

    Args:
        forms: (3, 3, 3, 3, S, ...) moments of R, entry by entry.
        details: (S, ...) number of independent details of each scale.
        mean: (3, 3, ...) mean rotation.
        ground: (3, ...) axis a to start from.
        body: (3, ...) axis b to start from.
        steps: number of steps.

    Returns:
        The unit vectors a (3, ...) and b (3, ...), and the objective (...).
    """
    small = jnp.finfo(ground.dtype).tiny ** 0.5
    keep = _APART * total(details, 0)
    unit = jnp.asarray(np.eye(4), ground.dtype).reshape(4, 4, *[1] * (ground.ndim - 1))

    def expand(a: Array, b: Array) -> _Local:
        """Expand the objective to second order about two axes."""
        across = total(forms * b[:, None, None, None], 1)  # (i, k, l)
        half = total(forms * a[:, None, None, None, None], 0)  # (j, k, l)
        of_ground, of_body = total(across * b[:, None], 2), total(half * a[:, None, None], 1)
        both = total(across * a[:, None, None], 1)
        size = total(total(of_ground * a[:, None, None], 0) * a[:, None], 0) + small
        weight = details / size
        upper, lower, between = (total(m * weight, 2) for m in (of_ground, of_body, both))
        bases = _across(a), _across(b)  # (3, 2, ...)
        moved = [times(form, basis) for form, basis in zip((upper, lower), bases, strict=True)]
        gradient = [
            total(basis * times(m, v)[:, None], 0)
            for basis, m, v in zip(bases, (upper, lower), (a, b), strict=True)
        ]
        blocks = [total(basis[:, :, None] * m[:, None], 0) for basis, m in zip(bases, moved, strict=True)]
        corner = total(bases[0][:, :, None] * times(between, bases[1])[:, None], 0)
        rows = [
            jnp.concatenate([blocks[0], corner], axis=1),
            jnp.concatenate([jnp.swapaxes(corner, 0, 1), blocks[1]], axis=1),
        ]
        turned, back = times(mean, b), times(jnp.swapaxes(mean, 0, 1), a)
        pull = jnp.concatenate([total(bases[0] * turned[:, None], 0), total(bases[1] * back[:, None], 0)])
        cosine = total(a * turned, 0)
        value = total(details * jnp.log(size), 0) + keep * cosine * cosine
        gradients = jnp.concatenate(gradient) + keep * cosine * pull
        return _Local(value, gradients, jnp.concatenate(rows) + keep * pull[:, None] * pull[None])

    def step(_: Array, carry: tuple[Array, Array, _Local, Array]) -> tuple[Array, Array, _Local, Array]:
        a, b, here, damping = carry
        size = total(here.hessian * unit, 1)
        lift = damping * size + 1e-9 * largest(size) + small
        change = -solve_positive(here.hessian + unit * lift[:, None], here.gradient)
        c = normalize(a + times(_across(a), change[:2]))
        d = normalize(b + times(_across(b), change[2:]))
        new = expand(c, d)
        lower = new.value < here.value
        kept = jax.tree.map(lambda x, y: jnp.where(lower, x, y), (c, d, new), (a, b, here))
        damping = jnp.clip(jnp.where(lower, damping * 0.1, damping * 10), 1e-7, 1e4)
        return *kept, damping

    # the first step does not move: it only expands the objective
    start = jnp.zeros((4, *ground.shape[1:]), ground.dtype)
    none = jnp.zeros_like(start[0])
    nowhere = _Local(none + jnp.inf, start, start[None] + unit)
    damping = none + 1e-2
    a, b, here, _ = jax.lax.fori_loop(0, steps + 1, step, (ground, body, nowhere, damping))
    return a, b, here.value


class _Local(NamedTuple):
    """Value, half the gradient (4, ...) and half the Hessian (4, 4, ...)."""

    value: Array
    gradient: Array
    hessian: Array


def _across(axis: Array) -> Array:
    """Two directions (3, 2, ...) normal to unit vectors (3, ...), continuous except at z = 0 (Duff 2017)."""
    x, y, z = axis
    sign = jnp.where(z < 0, -1.0, 1.0).astype(axis.dtype)
    p = -1 / (sign + z)
    q = x * y * p
    first = jnp.stack([1 + sign * x * x * p, sign * q, -sign * x])
    return jnp.stack([first, jnp.stack([q, sign + y * y * p, -y])], axis=1)

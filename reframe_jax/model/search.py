"""Search for the origin with the lowest norm over time scales, for every linear frame type.

The norm of the paper is the geometric mean of the RMS velocities along three axes; its logarithm is that of
det Sigma. Over scales it is F(x) = sum_s n_s log det Sigma_s(x), with n_s independent details: the Gaussian
likelihood of displacements whose variances are all unknown. Sigma_s(x) is a quadratic polynomial in the
origin x, with 6 x 10 coefficients.

The search takes two kinds of steps. The logarithm is concave, so the tangent of log det is an upper bound: a
*tangent step*, to the minimum of this quadratic, never increases F. *Newton steps* then converge. They use
the absolute curvatures of the exact Hessian, because valleys of F are narrow, curved, and often concave along
their bottom, where the tangent is up to a thousand times too steep.

Arrays have components first, then scales, types, starts and windows: every operation is elementwise over the
last three.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry.kernel import added_up, in_registers
from reframe_jax.geometry.small import (
    diagonalize,
    invert_symmetric,
    largest,
    materialize,
    pick,
    sandwich,
    solve_positive,
    solve_symmetric,
    times,
    total,
    trace,
    unit_matrix,
)
from reframe_jax.geometry.symmetric import INDEX_PAIRS, PACKED
from reframe_jax.objectives.moments import MONOMIALS

_FIRST, _SECOND = (np.array(ends, np.int32) for ends in zip(*MONOMIALS, strict=True))
_PLACE, _PAIRS = np.array(PACKED, np.int32), tuple(np.array(INDEX_PAIRS, np.int32).T)
_FORM = np.array([[MONOMIALS.index((min(a, b), max(a, b))) for b in range(4)] for a in range(4)], np.int32)

_TANGENT_STEPS, _NEWTON_STEPS = 8, 14  # number of tangent steps, largest number of Newton steps
_CONVERGED = 1e-8  # decrease of F per detail: with 1,000 details, a step of 0.3 % of the standard deviation
_RELAX = 1.6  # factor on tangent steps; over-relaxation halves their number
_DAMPING, _LEAST_DAMPING = 0.03, 1e-6  # of Newton steps: first and least, as a fraction of the tangent
_TRIALS = (0.04, 0.2, 1.0, 5.0)  # factors of the last damping that every step tries
_FIXED_STARTS = np.array([[0, 0.2, -0.5], [0, -0.2, -0.4], [0, 0.1, 0.5]])
"""(3, starts) m, origins from which every search starts."""
_RIDGE = 1e-9  # fraction of the trace that regularizes the regression on rotation features

Array = jax.Array
_ADDED_UP = partial(added_up, axes=(2, 0, -1))  # over the scales of coefficients and counts


def polynomials(products: Array, rows: np.ndarray) -> Array:
    """Compute the coefficients (6, 10, S, T, 1, N) of Sigma_s(x) for every linear type.

    The products are the moments (F, F, S, N) of the features z. With the rows (T, 3, 4, F), coordinate i of
    type t is sum_a (1, x)_a rows[t, i, a] z.
    """
    # every entry of `rows` is 0, 1 or -1 and has one feature: moments are picked, not multiplied
    feature, sign = np.abs(rows).argmax(-1), rows.sum(-1)
    i, j = np.array(INDEX_PAIRS).T[:, :, None, None]
    a, b = np.stack([_FIRST, _SECOND])[:, None, :, None]
    t = np.arange(len(rows))
    flat, width = products.reshape(-1, *products.shape[2:]), products.shape[0]
    halves = []
    for one, other in ((a, b), (b, a)):
        weight = jnp.asarray((sign[t, i, one] * sign[t, j, other])[..., None, None], products.dtype)
        halves.append(flat[feature[t, i, one] * width + feature[t, j, other]] * weight)
    half = np.where(_FIRST == _SECOND, 0.5, 1.0)[:, None, None, None]
    values = (halves[0] + halves[1]) * jnp.asarray(half, products.dtype)
    return jnp.swapaxes(values, 2, 3)[:, :, :, :, None]


def unexplained_covariance(moments: Array, rows: np.ndarray) -> Array:
    """Compute a lower bound (3, 3, T, 1, N), m^2, of the covariance of the path over all origins.

    The path is affine in the origin, with rotation features as coefficients. A linear regression of the
    constant part on these features leaves smaller residuals than any origin, and they are small along held
    axes only. The inverse of this covariance weights the coordinates in the search for a first origin.
    The moments (F, F, N) are those over all scales; for the rows, see :func:`polynomials`.
    """
    used = [[np.flatnonzero(np.abs(part).any((0, 1))) for part in (of[:, :1], of[:, 1:])] for of in rows]
    found: list[Array] = [moments] * len(rows)
    for size in sorted({len(others) for _, others in used}):
        alike = [t for t, (_, others) in enumerate(used) if len(others) == size]
        own, others = (np.stack([used[t][k] for t in alike], -1) for k in (0, 1))
        path, turns = moments[own[:, None], own[None]], moments[others[:, None], others[None]]
        both = moments[others[:, None], own[None]]  # (others, 3, types, N)
        unit, eye = (jnp.eye(width, dtype=moments.dtype)[:, :, None, None] for width in (size, 3))
        ridge = _RIDGE * total(total(turns * unit, 0), 0)
        solved = solve_positive((turns + ridge * unit)[:, :, None], both)
        rest = path - total(both[:, :, None] * solved[:, None], 0)
        floor = 64 * jnp.finfo(moments.dtype).eps * total(total(path * eye, 0), 0)
        for k, t in enumerate(alike):
            found[t] = (rest + floor * eye)[:, :, k]
    return jnp.stack(found, axis=2)[:, :, :, None]


def lowest_origins(
    coefficients: Array, details: Array, box: Array, unexplained: Array
) -> tuple[Array, Array]:
    """Find the lowest F of every type, and its origin.

    The result is the origins (3, T, N), m, and F (T, N) at these origins. The arguments are the results of
    :func:`polynomials` and of :func:`unexplained_covariance`, the independent details (S, N) of each scale,
    and half the width (N,), m, of the cube that is searched.
    """
    problem = coefficients, details[:, None, None], box[None, None]
    x = _starts(*problem[:2], unexplained)
    x, norm = in_registers(_tangent_steps, 3)(*problem, jnp.clip(jnp.where(jnp.isfinite(x), x, 0), -box, box))
    best = jnp.argmin(norm, axis=1)
    x, norm = in_registers(_newton_steps, 3)(*problem, pick(x, best[:, None], 2))
    return x[:, :, 0], norm[:, 0]


def _tangent_steps(coefficients: Array, counts: Array, box: Array, x: Array) -> tuple[Array, Array]:
    """Take tangent steps from origins (3, T, K, N); also return F (T, K, N)."""
    x = jax.lax.fori_loop(0, _TANGENT_STEPS, lambda _, x: _tangent_step(coefficients, counts, box, x), x)
    return x, _norm(coefficients, counts, x)


def _newton_steps(coefficients: Array, counts: Array, box: Array, x: Array) -> tuple[Array, Array]:
    """Take Newton's steps from origins (3, T, 1, N) until none moves; also return F (T, 1, N)."""
    step = partial(_newton_step, coefficients, counts, box)
    axes = jnp.broadcast_to(unit_matrix(x.dtype, x.ndim - 1), (3, *x.shape))
    damping = jnp.full_like(x[0], _DAMPING)
    start = 0, _Point(x, axes, damping, jnp.zeros_like(damping), damping > 0)
    _, end = jax.lax.while_loop(
        lambda carry: (carry[0] < _NEWTON_STEPS) & jnp.any(carry[1].moving),
        lambda carry: (carry[0] + 1, step(carry[1])),
        start,
    )
    return end.origin, end.norm


def norm_at(coefficients: Array, details: Array, origins: Array) -> Array:
    """Compute F (T, N) of every type at its origin, for origins (3, T, N), m."""
    return _norm(coefficients, details[:, None, None], origins[:, :, None])[:, 0]


@_ADDED_UP
def _norm(coefficients: Array, counts: Array, x: Array) -> Array:
    """F at origins (3, T, K, N), (T, K, N)."""
    _, det = invert_symmetric(_sigma(coefficients, x))
    return total(counts * jnp.log(det), 0)


def _starts(coefficients: Array, counts: Array, unexplained: Array) -> Array:
    """Starting origins (3, T, starts, N): of the unexplained covariance, of least motion, and fixed."""
    traces = coefficients[0] + coefficients[3] + coefficients[5]
    inverse, _ = invert_symmetric([unexplained[i, j] for i, j in INDEX_PAIRS])
    halves = jnp.asarray(_HALVES, traces.dtype)
    inverse = jnp.broadcast_to(inverse[:, :, None], (3, 3, *traces.shape[1:]))
    squares = [square[_FORM] * halves for square in (total(traces * (counts > 0), 1), traces[:, -1])]
    forms = jnp.concatenate([_tangent(coefficients, counts, inverse), *squares], axis=3)
    found = -solve_symmetric(_lift(forms[1:, 1:]), forms[1:, 0])
    fixed = jnp.asarray(_FIXED_STARTS, coefficients.dtype)[:, None, :, None]
    fixed = jnp.broadcast_to(fixed, (3, found.shape[1], fixed.shape[2], found.shape[3]))
    return jnp.concatenate([found, fixed], axis=2)


_HALVES = np.where(np.eye(4, dtype=bool), 1.0, 0.5)[:, :, None, None, None]
"""Factors that turn the coefficients of monomials into a symmetric matrix."""


def _sigma(coefficients: Array, x: Array) -> Array:
    """Components of Sigma at origins (3, T, K, N), (6, S, T, K, N)."""
    z = jnp.ones_like(x[0]), *x
    terms = [coefficients[:, k] * (z[b] if a == 0 else z[a] * z[b]) for k, (a, b) in enumerate(MONOMIALS)]
    return materialize(sum(terms[1:], terms[0]))


def _slope(coefficients: Array, x: Array) -> Array:
    """Derivatives of Sigma with respect to the origins, (6, 3, S, T, K, N)."""
    z = jnp.ones_like(x[0]), *x
    slopes = []
    for axis in (1, 2, 3):
        terms = [
            coefficients[:, k] * (z[b] if a == axis else z[a]) * (2 if a == b else 1)
            for k, (a, b) in enumerate(MONOMIALS)
            if axis in (a, b)
        ]
        slopes.append(sum(terms[1:], terms[0]))
    return jnp.stack(slopes, axis=1)


def _tangent(coefficients: Array, counts: Array, inverse: Array) -> Array:
    """sum_s n_s tr(Sigma_s^-1 Sigma_s(y)): the matrix of a quadratic form in (1, y), (4, 4, T, K, N)."""
    twice = jnp.asarray([1.0 if i == j else 2.0 for i, j in INDEX_PAIRS], counts.dtype)
    weights = materialize(inverse[_PAIRS] * (twice.reshape(6, *[1] * counts.ndim) * counts))
    # one component after the other, so that the data stay in the cache
    q = total(materialize(total(coefficients * weights[:, None], 0)), 1)
    return q[_FORM] * jnp.asarray(_HALVES, q.dtype)


def _lift(matrix: Array) -> Array:
    size = trace(matrix)
    unit = unit_matrix(size.dtype, size.ndim)
    return matrix + (1e-9 * size + jnp.finfo(matrix.dtype).tiny) * unit


@_ADDED_UP
def _tangent_at(coefficients: Array, counts: Array, x: Array) -> Array:
    inverse, _ = invert_symmetric(_sigma(coefficients, x))
    return _tangent(coefficients, counts, inverse)


def _tangent_step(coefficients: Array, counts: Array, box: Array, x: Array) -> Array:
    form = _tangent_at(coefficients, counts, x)
    step = solve_symmetric(_lift(form[1:, 1:]), form[1:, 0] + times(form[1:, 1:], x))
    # without motion, every origin is equally good
    return materialize(jnp.clip(x - _RELAX * jnp.where(jnp.isfinite(step), step, 0), -box, box))


@_ADDED_UP
def _expand(coefficients: Array, counts: Array, x: Array) -> tuple[Array, Array, Array, Array]:
    """F about origins (3, ...): value, slope (3, ...), Hessian (3, 3, ...) of the tangent, exact Hessian."""
    inverse, det = invert_symmetric(_sigma(coefficients, x))
    form = _tangent(coefficients, counts, inverse)
    change = _slope(coefficients, x)[_PLACE]
    product = materialize(total(inverse[:, :, None, None] * change[None], 1))  # (i, j, a, S, ...)
    squared = total(product[:, :, :, None] * jnp.swapaxes(product, 0, 1)[:, :, None], 0, 1)
    exact = 2 * form[1:, 1:] - total(squared * counts, 2)
    value = total(counts * jnp.log(det), 0)
    slope = 2 * (form[1:, 0] + times(form[1:, 1:], x))
    return materialize((value, slope, 2 * form[1:, 1:], exact))


class _Point(NamedTuple):
    """State of Newton's steps."""

    origin: Array  # (3, T, 1, N) m
    axes: Array  # (3, 3, T, 1, N) principal axes of the Hessian at the last origin, as columns
    damping: Array  # (T, 1, N), a fraction of the tangent
    norm: Array  # (T, 1, N) F at the origin
    moving: Array  # (T, 1, N) bool, whether the origin takes another step


def _newton_step(coefficients: Array, counts: Array, box: Array, at: _Point) -> _Point:
    """Newton's step along the principal axes of the exact Hessian, with its curvatures made positive.

    One Jacobi sweep a step improves the axes of the step before. A curvature is at least the damping times
    the curvature of the tangent, which is an upper bound. The step tries several dampings, and takes the one
    with the lowest F. An origin stops where the step predicts hardly any decrease.
    """
    x = at.origin
    value, slope, tangent, exact = _expand(coefficients, counts, x)
    size = jnp.sqrt(total(total(exact * exact, 0), 0)) + jnp.finfo(x.dtype).tiny
    unit = unit_matrix(size.dtype, size.ndim)
    seen = sandwich(at.axes, (exact / size + 2 * unit)[:, :, None])
    axes = materialize(times(at.axes, diagonalize(seen, sweeps=1)))
    most = total(axes * times(tangent, axes), 0)
    least = jnp.finfo(most.dtype).eps * largest(most) + jnp.finfo(most.dtype).tiny
    dampings = at.damping * jnp.asarray(_TRIALS, x.dtype)[:, None]
    curvature = jnp.abs(total(axes * times(exact, axes), 0))
    curvature = jnp.maximum(curvature, dampings * most) + least
    along = total(axes * slope[:, None], 0)
    decrease = total(along * along / curvature, 0)[:, :1] / 2  # predicted for the least damping
    tried = materialize(jnp.clip(x - times(axes, along / curvature), -box, box))
    values = _norm(coefficients, counts, tried)
    best = jnp.argmin(values, axis=1)[:, None]
    found = pick(values, best, 1)
    lower = (found <= value) & at.moving
    x = jnp.where(lower, pick(tried, best, 2), x)
    taken = jnp.where(lower, pick(dampings, best, 1), _TRIALS[-1] * dampings[:, -1:])
    norm = jnp.where(lower, found, value)
    moving = at.moving & (decrease > _CONVERGED * total(counts, 0))
    return _Point(x, axes, jnp.maximum(taken, _LEAST_DAMPING), norm, moving)

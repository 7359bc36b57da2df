"""The origin of every linear frame type: the lowest norm over time scales.

The norm of the paper is the geometric mean of the RMS velocities along three axes; its logarithm is that of
det Sigma. Over scales it is F(x) = sum_s n_s log det Sigma_s(x), with n_s independent details: the Gaussian
likelihood of displacements whose variances are all unknown. Sigma_s(x) is a quadratic polynomial in the
origin x, 6 x 10 coefficients.

Two kinds of steps lead to the minimum. The logarithm is concave, so that the tangent of log det lies above
it: a *tangent step* to the minimum of that quadratic never goes up. *Newton steps* with the exact Hessian,
blended with the tangent's where it is not positive, finish.

Arrays have components first, then scales, windows, types and starts: everything between two products is
elementwise over the last three.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

__all__ = ["MONOMIALS", "PAIRS", "lowest_origins", "norm_at", "polynomials", "unexplained_covariance"]

PAIRS = tuple((i, j) for i in range(3) for j in range(i, 3))
"""Components of Sigma."""
MONOMIALS = tuple((a, b) for a in range(4) for b in range(a, 4))
"""Products of (1, x) that a component of Sigma is a sum of."""
_SECOND = tuple((a, b) for a, b in MONOMIALS if a > 0)

_TANGENT_STEPS, _NEWTON_STEPS = 12, 10
_RELAX = 1.6  # of tangent steps, over-relaxed: takes about half as many
_BLEND = 0.9  # part of the exact Hessian in the first Newton step
_FIXED_STARTS = np.array([[0, 0.2, -0.5], [0, -0.2, -0.4], [0, 0.1, 0.5]])
"""(3, starts) m."""
_RIDGE = 1e-9  # of the trace, in the regression on rotation features

Array = jax.Array


def polynomials(products: Array, rows: np.ndarray) -> Array:
    """Coefficients of Sigma_s(x) of every type, (N, T, S * 6, 10).

    Args:
        products: (N, S, F, F) moments of the features.
        rows: (T, 3, 4, F): coordinate i of type t is sum_a (1, x)_a rows[t, i, a] z.
    """
    # every entry of `rows` is 0, 1 or -1 and has one feature: moments are picked, not multiplied
    feature, sign = np.abs(rows).argmax(-1), rows.sum(-1)
    picked, signs = [], []
    for (i, a), (j, b) in _terms():
        picked.append((feature[:, i, a], feature[:, j, b]))
        signs.append(sign[:, i, a] * sign[:, j, b])
    first, second = (np.stack([pair[k] for pair in picked], -1) for k in (0, 1))
    weight = jnp.asarray(np.stack(signs, -1), products.dtype)
    flat = products.reshape(*products.shape[:2], -1)
    values = flat[:, :, first * products.shape[-1] + second] * weight
    half = jnp.asarray([0.5 if a == b else 1.0 for a, b in MONOMIALS], values.dtype)
    values = values.reshape(*values.shape[:3], 6, 10, 2).sum(-1) * half
    return jnp.swapaxes(values, 1, 2).reshape(values.shape[0], len(rows), -1, 10)


def _terms() -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Entries (i, a), (j, b) of the moments that make the coefficients, two for each."""
    terms = []
    for i, j in PAIRS:
        for a, b in MONOMIALS:
            terms += [((i, a), (j, b)), ((i, b), (j, a))]
    return terms


def unexplained_covariance(total: Array, rows: np.ndarray) -> Array:
    """What no origin explains of the path of every type, (N, T, 3, 3) m^2: a lower bound of its covariance.

    The path of an origin is affine in it with the rotation features as coefficients. The residuals of a
    linear
    regression of the rest on these features are smaller than those of any origin, and small exactly along
    held
    axes. Their inverse weighs the coordinates for a first origin.

    Args:
        total: (N, F, F) moments of the features over all scales.
        rows: (T, 3, 4, F), see :func:`polynomials`.
    """
    found = []
    for of_type in rows:
        own = np.flatnonzero(np.abs(of_type[:, 0]).any(0))
        others = np.flatnonzero(np.abs(of_type[:, 1:]).any((0, 1)))
        path, turns = total[:, own[:, None], own], total[:, others[:, None], others]
        both = total[:, others[:, None], own]
        ridge = (
            _RIDGE
            * jnp.trace(turns, axis1=1, axis2=2)[:, None, None]
            * jnp.eye(len(others), dtype=total.dtype)
        )
        rest = path - jnp.einsum("nfi,nfj->nij", both, jnp.linalg.solve(turns + ridge, both))
        floor = jnp.finfo(total.dtype).eps * jnp.trace(path, axis1=1, axis2=2)[:, None, None]
        found.append(rest + 64 * floor * jnp.eye(3, dtype=total.dtype))
    return jnp.stack(found, axis=1)


def lowest_origins(
    coefficients: Array, details: Array, box: Array, unexplained: Array
) -> tuple[Array, Array]:
    """The lowest F of every type, and where.

    Args:
        coefficients: (N, T, S * 6, 10).
        details: (N, S) independent details of each scale.
        box: (N,) m, half the width of the cube that is searched.
        unexplained: (N, T, 3, 3) m^2, see :func:`unexplained_covariance`.

    Returns:
        (N, T, 3) m and (N, T).
    """
    counts = jnp.moveaxis(details, 1, 0)[:, :, None, None]
    box = box[:, None, None]
    x = _starts(coefficients, counts, unexplained)
    x = jnp.clip(jnp.where(jnp.isfinite(x), x, 0), -box, box)
    x = jax.lax.fori_loop(0, _TANGENT_STEPS, lambda _, x: _tangent_step(coefficients, counts, box, x), x)
    _, det = _adjugate(_sigma(coefficients, _monomials(x)))
    best = jnp.argmin(jnp.sum(counts * jnp.log(det), axis=0), axis=-1)
    x = jnp.take_along_axis(x, best[None, ..., None], axis=-1)
    carry = (x, *_expand(coefficients, counts, x), jnp.full(x.shape[1:], _BLEND, x.dtype))
    step = partial(_newton_step, coefficients, counts, box)
    carry = jax.lax.fori_loop(0, _NEWTON_STEPS, lambda _, c: step(c), carry)
    return jnp.moveaxis(carry[0][..., 0], 0, -1), carry[1][..., 0]


def norm_at(coefficients: Array, details: Array, origins: Array) -> Array:
    """F of every type at its origin, (N, T), for origins (N, T, 3) m."""
    counts = jnp.moveaxis(details, 1, 0)[:, :, None, None]
    _, det = _adjugate(_sigma(coefficients, _monomials(jnp.moveaxis(origins, -1, 0)[..., None])))
    return jnp.sum(counts * jnp.log(det), axis=0)[..., 0]


def _starts(coefficients: Array, counts: Array, unexplained: Array) -> Array:
    """Starts (3, N, T, starts): by the unexplained covariance, the origins that move least, others."""
    shape = (*coefficients.shape[:2], -1, 6, 10)
    traces = coefficients.reshape(shape)[:, :, :, (0, 3, 5)].sum(3)
    total = jnp.einsum("nts,ntsm->ntm", jnp.moveaxis(counts[..., 0] > 0, 0, -1).astype(traces.dtype), traces)
    first = []
    for q in (total, traces[:, :, -1]):
        q = jnp.moveaxis(q, -1, 0)
        hessian = [q[MONOMIALS.index(ab)] * (1.0 if ab[0] == ab[1] else 0.5) for ab in _SECOND]
        slope = [q[MONOMIALS.index((0, a))] / 2 for a in (1, 2, 3)]
        first.append(-_solve(_lift(hessian), slope)[0])
    adjugate, det = _adjugate(jnp.stack([unexplained[..., i, j] for i, j in PAIRS])[..., None])
    inverse = [jnp.broadcast_to(entry / det, (*counts.shape[:2], *det.shape[1:])) for entry in adjugate]
    form = _tangent(coefficients, counts, inverse)
    first.append(-_solve(_lift([form[ab] for ab in _SECOND]), [form[a, 0] for a in (1, 2, 3)])[0][..., 0])
    fixed = jnp.asarray(_FIXED_STARTS, coefficients.dtype)[:, None, None]
    fixed = jnp.broadcast_to(fixed, (3, *coefficients.shape[:2], fixed.shape[-1]))
    return jnp.concatenate([jnp.stack(first, axis=-1), fixed], axis=-1)


def _monomials(x: Array) -> Array:
    z = [jnp.ones_like(x[0]), *x]
    return jnp.stack([z[a] * z[b] for a, b in MONOMIALS], axis=2)


def _slopes(x: Array) -> list[Array]:
    z, zero = [jnp.ones_like(x[0]), *x], jnp.zeros_like(x[0])
    return [
        jnp.stack([(z[b] if a == q else zero) + (z[a] if b == q else zero) for a, b in MONOMIALS], axis=2)
        for q in (1, 2, 3)
    ]


def _sigma(coefficients: Array, monomials: Array) -> Array:
    """Sigma at K points, (6, S, N, T, K)."""
    values = jnp.einsum("ntcm,ntmk->ntck", coefficients, monomials, precision="highest")
    return values.reshape(*values.shape[:2], -1, 6, values.shape[-1]).transpose(3, 2, 0, 1, 4)


def _adjugate(s: Array) -> tuple[list[Array], Array]:
    a, b, c, d, e, f = s
    adjugate = [d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b]
    det = a * adjugate[0] + b * adjugate[1] + c * adjugate[2]
    return adjugate, jnp.maximum(det, jnp.finfo(det.dtype).tiny)


def _tangent(coefficients: Array, counts: Array, inverse: list[Array]) -> dict[tuple[int, int], Array]:
    """sum_s n_s tr(Sigma_s^-1 Sigma_s(y)), a quadratic form in (1, y): its entries, each (N, T, K)."""
    weight = [v * counts * (1 if i == j else 2) for v, (i, j) in zip(inverse, PAIRS, strict=True)]
    weights = jnp.stack(weight).transpose(2, 3, 1, 0, 4)
    weights = weights.reshape(*weights.shape[:2], -1, weights.shape[-1])
    q = jnp.einsum("ntcm,ntck->mntk", coefficients, weights, precision="highest")
    form = {}
    for m, (a, b) in enumerate(MONOMIALS):
        form[a, b] = form[b, a] = q[m] * (1.0 if a == b else 0.5)
    return form


def _solve(matrix: list[Array], vector: list[Array]) -> tuple[Array, Array]:
    """Solution of a symmetric 3 x 3 system, (3, ...), and whether the matrix is positive definite."""
    a, b, c, d, e, f = matrix
    l2, l3 = b / a, c / a
    d2 = d - l2 * b
    l32 = (e - l3 * b) / d2
    d3 = f - l3 * c - l32 * l32 * d2
    y2 = vector[1] - l2 * vector[0]
    y3 = vector[2] - l3 * vector[0] - l32 * y2
    z3 = y3 / d3
    z2 = y2 / d2 - l32 * z3
    return jnp.stack([vector[0] / a - l2 * z2 - l3 * z3, z2, z3]), (a > 0) & (d2 > 0) & (d3 > 0)


def _lift(matrix: list[Array]) -> list[Array]:
    small = 1e-9 * (matrix[0] + matrix[3] + matrix[5]) + jnp.finfo(matrix[0].dtype).tiny
    return [entry + small if k in (0, 3, 5) else entry for k, entry in enumerate(matrix)]


def _tangent_step(coefficients: Array, counts: Array, box: Array, x: Array) -> Array:
    adjugate, det = _adjugate(_sigma(coefficients, _monomials(x)))
    form, z = _tangent(coefficients, counts, [entry / det for entry in adjugate]), [1.0, *x]
    slope = [sum(form[a, b] * z[b] for b in range(4)) for a in (1, 2, 3)]
    step = _solve(_lift([form[ab] for ab in _SECOND]), slope)[0]
    # where nothing moves, no origin is better than another
    return jnp.clip(x - _RELAX * jnp.where(jnp.isfinite(step), step, 0), -box, box)


def _expand(coefficients: Array, counts: Array, x: Array) -> tuple[Array, Array, Array, Array]:
    """F, its slope (3, ...), the tangent's Hessian and the exact one (6, ...)."""
    k = x.shape[-1]
    values = _sigma(coefficients, jnp.concatenate([_monomials(x), *_slopes(x)], axis=-1))
    adjugate, det = _adjugate(values[..., :k])
    inverse = [entry / det for entry in adjugate]
    form, z = _tangent(coefficients, counts, inverse), [1.0, *x]
    whole = _full(inverse)
    products = []
    for a in (1, 2, 3):
        change = _full(values[..., a * k : (a + 1) * k])
        products.append(
            [[sum(whole[i][m] * change[m][j] for m in range(3)) for j in range(3)] for i in range(3)]
        )
    tangent = [2 * form[ab] for ab in _SECOND]
    exact = []
    for second, (a, b) in zip(tangent, _SECOND, strict=True):
        p, q = products[a - 1], products[b - 1]
        trace = sum(p[i][j] * q[j][i] for i in range(3) for j in range(3))
        exact.append(second - jnp.sum(counts * trace, axis=0))
    slope = jnp.stack([2 * sum(form[a, b] * z[b] for b in range(4)) for a in (1, 2, 3)])
    return jnp.sum(counts * jnp.log(det), axis=0), slope, jnp.stack(tangent), jnp.stack(exact)


def _full(s: list[Array] | Array) -> list[list[Array]]:
    return [[s[0], s[1], s[2]], [s[1], s[3], s[4]], [s[2], s[4], s[5]]]


def _newton_step(
    coefficients: Array, counts: Array, box: Array, carry: tuple[Array, ...]
) -> tuple[Array, ...]:
    x, value, slope, tangent, exact, blend = carry
    blended = _lift(list(tangent * (1 - blend) + exact * blend))
    full, positive = _solve(blended, list(slope))
    safe, _ = _solve(_lift(list(tangent)), list(slope))
    y = jnp.clip(x - jnp.where(positive, full, safe), -box, box)
    new = _expand(coefficients, counts, y)
    lower = new[0] <= value
    kept = [jnp.where(lower, a, b) for a, b in zip((y, *new), (x, value, slope, tangent, exact), strict=True)]
    blend = jnp.where(lower, jnp.where(positive, 1.0, _BLEND), blend / 2)
    return (*kept, blend.astype(x.dtype))

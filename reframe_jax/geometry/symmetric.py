"""Algebra for large batches of symmetric 3x3 matrices, stored as six arrays.

A batch of matrices is a tuple (xx, xy, xz, yy, yz, zz) of arrays (...) with one shape. Every function
consists of elementwise operations, which XLA fuses and vectorizes over the batch; general functions for small
matrices (einsum, solve, eigh) are slower.
"""

import jax
import jax.numpy as jnp
from jax import custom_jvp, lax

Symmetric = tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]
Vector = tuple[jax.Array, jax.Array, jax.Array]

INDEX_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
PACKED = ((0, 1, 2), (1, 3, 4), (2, 4, 5))

_JACOBI_SWEEPS = 5  # quadratic convergence: in the worst case, 4 sweeps reach float64 rounding


def to_matrix(s: Symmetric) -> jax.Array:
    """Build symmetric matrices (..., 3, 3) from six arrays (...): xx, xy, xz, yy, yz, zz."""
    rows = [jnp.stack([s[PACKED[i][j]] for j in range(3)], axis=-1) for i in range(3)]
    return jnp.stack(rows, axis=-2)


def _reciprocal(x: jax.Array) -> jax.Array:
    """1/x, and 0 for x = 0: a zero pivot of a semidefinite matrix has a zero column below."""
    zero = x == 0
    return jnp.where(zero, 0, 1 / jnp.where(zero, 1, x))


def pivots(s: Symmetric) -> Vector:
    """Return the diagonal D of S = L D L^T, for positive semidefinite matrices S.

    The product of the three numbers is the determinant. This elimination is backward stable. An expansion of
    the determinant by cofactors is not: with one free and two constrained axes, it loses twice as many
    digits, and all digits in float32.
    """
    xx, xy, xz, yy, yz, zz = s
    inverse = _reciprocal(xx)
    y = yy - xy * xy * inverse
    coupling = yz - xy * xz * inverse
    z = zz - xz * xz * inverse - coupling * coupling * _reciprocal(y)
    return xx, y, z


def _rotate(
    values: list[jax.Array], off: dict[tuple[int, int], jax.Array], axes: list[Vector], i: int, j: int
) -> None:
    """Apply one Jacobi rotation in the plane (i, j), in place, which makes off[i, j] zero."""
    k = 3 - i - j
    ij = (i, j)
    ik, jk = (min(i, k), max(i, k)), (min(j, k), max(j, k))
    b = off[ij]
    half = (values[j] - values[i]) / 2
    # t = tan of the smaller rotation angle, in a form without overflow and division by zero
    root = jnp.abs(half) + jnp.hypot(half, b)
    t = jnp.where(b == 0, 0, jnp.where(half < 0, -b, b) / jnp.where(b == 0, 1, root))
    c = 1 / jnp.sqrt(1 + t * t)
    s = t * c
    values[i], values[j] = values[i] - t * b, values[j] + t * b
    off[ij] = jnp.zeros_like(b)
    off[ik], off[jk] = c * off[ik] - s * off[jk], s * off[ik] + c * off[jk]
    x, y = axes[i], axes[j]
    axes[i] = (c * x[0] - s * y[0], c * x[1] - s * y[1], c * x[2] - s * y[2])
    axes[j] = (s * x[0] + c * y[0], s * x[1] + c * y[1], s * x[2] + c * y[2])


@custom_jvp
def eigh(s: Symmetric) -> tuple[Vector, tuple[Vector, Vector, Vector]]:
    """Compute the eigenvalues, in any order, and the unit eigenvectors, by cyclic Jacobi rotations.

    Jacobi's method computes small eigenvalues accurately beside large ones, as constrained axes need. The
    function is differentiable; the derivative of eigenvectors with equal eigenvalues is undefined and set to
    zero. The results are three arrays, and three vectors with three arrays each.
    """
    zero, one = jnp.zeros_like(s[0]), jnp.ones_like(s[0])

    def sweep(carry: tuple, _: None) -> tuple[tuple, None]:  # type: ignore[type-arg]
        values, (xy, xz, yz), axes = list(carry[0]), carry[1], list(carry[2])
        off = {(0, 1): xy, (0, 2): xz, (1, 2): yz}
        for i, j in ((0, 1), (0, 2), (1, 2)):
            _rotate(values, off, axes, i, j)
        return (tuple(values), (off[0, 1], off[0, 2], off[1, 2]), tuple(axes)), None

    axes = ((one, zero, zero), (zero, one, zero), (zero, zero, one))
    start = ((s[0], s[3], s[5]), (s[1], s[2], s[4]), axes)
    (values, _, vectors), _ = lax.scan(sweep, start, length=_JACOBI_SWEEPS)
    return values, vectors


def quadratic_form(a: Vector, s: Symmetric, b: Vector) -> jax.Array:
    """Return a^T S b (...), for vectors of three arrays (...) and S of six arrays (...)."""
    return sum(a[i] * s[PACKED[i][j]] * b[j] for i in range(3) for j in range(3))  # type: ignore[return-value]


@eigh.defjvp
def _eigh_jvp(primals: tuple[Symmetric], tangents: tuple[Symmetric]) -> tuple[tuple, tuple]:  # type: ignore[type-arg]
    """First-order perturbation: ds_i = e_i.dS e_i, de_i = sum_j e_j (e_j.dS e_i) / (s_i - s_j)."""
    (s,), (ds,) = primals, tangents
    values, vectors = eigh(s)
    d_values = tuple(quadratic_form(e, ds, e) for e in vectors)
    d_vectors = []
    for i in range(3):
        terms = []
        for j in range(3):
            if j != i:
                gap = values[i] - values[j]
                coupling = quadratic_form(vectors[j], ds, vectors[i])
                terms.append((jnp.where(gap == 0, 0, coupling / jnp.where(gap == 0, 1, gap)), vectors[j]))
        d_vectors.append(tuple(sum(coupling * e[c] for coupling, e in terms) for c in range(3)))
    return (values, vectors), (d_values, tuple(d_vectors))

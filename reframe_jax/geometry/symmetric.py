"""Algebra for large batches of symmetric 3x3 matrices, stored as six arrays.

A batch of matrices is a tuple (xx, xy, xz, yy, yz, zz) of arrays (...) with one shape. Every function
consists of elementwise operations, which XLA fuses and vectorizes over the batch; general functions for small
matrices (einsum, solve, eigh) are slower.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import custom_jvp, lax

Symmetric = tuple[jax.Array, ...]
Vector = tuple[jax.Array, jax.Array, jax.Array]

INDEX_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
PACKED = ((0, 1, 2), (1, 3, 4), (2, 4, 5))

_JACOBI_SWEEPS = 5  # quadratic convergence: in the worst case, 4 sweeps reach float64 rounding


def to_matrix(s: Symmetric) -> jax.Array:
    """Build symmetric matrices (..., 3, 3) from six arrays (...): xx, xy, xz, yy, yz, zz."""
    return jnp.moveaxis(jnp.stack(s)[np.array(PACKED)], (0, 1), (-2, -1))


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


@custom_jvp
def eigh(s: Symmetric) -> tuple[Vector, tuple[Vector, Vector, Vector]]:
    """Compute the eigenvalues, in any order, and the unit eigenvectors, by cyclic Jacobi rotations.

    Jacobi's method computes small eigenvalues accurately beside large ones, as constrained axes need. The
    function is differentiable; the derivative of eigenvectors with equal eigenvalues is undefined and set to
    zero. The results are three arrays, and three vectors with three arrays each.
    """

    def turn(_: int, carry: tuple) -> tuple:  # type: ignore[type-arg]
        """Rotate the first two axes so that xy becomes zero, then make the first axis the last."""
        (x, y, z), (xy, xz, yz), (first, second, third) = carry
        half = (y - x) / 2
        # t = tan of the smaller rotation angle, in a form without overflow and division by zero
        root = jnp.abs(half) + jnp.hypot(half, xy)
        t = jnp.where(xy == 0, 0, jnp.where(half < 0, -xy, xy) / jnp.where(xy == 0, 1, root))
        cosine = 1 / jnp.sqrt(1 + t * t)
        sine = t * cosine
        pairs = list(zip((*first, xz), (*second, yz), strict=True))
        *first, xz = (cosine * a - sine * b for a, b in pairs)
        *second, yz = (sine * a + cosine * b for a, b in pairs)
        vectors = tuple(second), third, tuple(first)
        return (y + t * xy, z, x - t * xy), (yz, jnp.zeros_like(xy), xz), vectors

    zero, one = jnp.zeros_like(s[0]), jnp.ones_like(s[0])
    axes = ((one, zero, zero), (zero, one, zero), (zero, zero, one))
    start = ((s[0], s[3], s[5]), (s[1], s[2], s[4]), axes)
    values, _, vectors = lax.fori_loop(0, 3 * _JACOBI_SWEEPS, turn, start)
    return values, vectors


def ascending_eigh(s: Symmetric) -> tuple[jax.Array, jax.Array]:
    """Return the eigenvalues (..., 3) in ascending order, and the eigenvectors (..., 3, 3) as columns.

    In a batch on a CPU, ``jnp.linalg.eigh`` waits for threads that may all be waiting in other programs.
    """
    values, vectors = (jnp.moveaxis(jnp.stack(jax.tree.leaves(part)), 0, -1) for part in eigh(s))
    order = jnp.argsort(values, axis=-1)
    axes = jnp.swapaxes(vectors.reshape(*values.shape, 3), -1, -2)
    return jnp.take_along_axis(values, order, -1), jnp.take_along_axis(axes, order[..., None, :], -1)


@eigh.defjvp
def _eigh_jvp(primals: tuple[Symmetric], tangents: tuple[Symmetric]) -> tuple[tuple, tuple]:  # type: ignore[type-arg]
    """First-order perturbation: ds_i = e_i.dS e_i, de_i = sum_j e_j (e_j.dS e_i) / (s_i - s_j)."""
    (s,), (ds,) = primals, tangents
    values, vectors = eigh(s)
    e, d = jnp.stack([jnp.stack(vector) for vector in vectors]), jnp.stack(ds)[np.array(PACKED)]
    seen = jnp.einsum("ia...,ab...,jb...->ij...", e, d, e, precision="highest")
    gap = jnp.stack(values)[:, None] - jnp.stack(values)
    mixed = jnp.where(gap == 0, 0, seen / jnp.where(gap == 0, 1, gap))
    d_vectors = jnp.einsum("ij...,ja...->ia...", mixed, e, precision="highest")
    return (values, vectors), (tuple(seen[i, i] for i in range(3)), tuple(map(tuple, d_vectors)))

"""Symmetric 3x3 matrices of large batches, stored as six arrays.

A batch of matrices is a tuple (xx, xy, xz, yy, yz, zz) of arrays (...) with one shape. Elementwise operations
on these arrays are fused and vectorized over the batch.
"""

import jax
import jax.numpy as jnp

Symmetric = tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]
Vector = tuple[jax.Array, jax.Array, jax.Array]

INDEX_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
PACKED = ((0, 1, 2), (1, 3, 4), (2, 4, 5))


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

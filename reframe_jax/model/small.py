"""Algebra of small vectors and matrices with components first and problems last.

A vector is (3, ...), a matrix (3, 3, ...), and the last axes run over problems. So every operation is
elementwise on long rows: there are no kernels for small matrices, and none of LAPACK.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

__all__ = [
    "cross",
    "diagonalize",
    "inverse_and_determinant",
    "largest",
    "normalize",
    "once",
    "rotate",
    "sandwich",
    "solve_positive",
    "times",
    "total",
    "turn",
]

Array = jax.Array
T = TypeVar("T")
_EYE = np.eye(3, dtype=bool)
_PAIRS = ((0, 1), (0, 2), (1, 2))


def once(values: T) -> T:
    """Compute arrays once: XLA would compute them again for every operation that reads them."""
    return jax.lax.optimization_barrier(values)


def total(array: Array, *axes: int) -> Array:
    """Sum over short axes, term by term: on a CPU, reductions over leading axes take forty times as long."""
    for axis in sorted(axes, reverse=True):
        terms = [jax.lax.slice_in_dim(array, i, i + 1, axis=axis) for i in range(array.shape[axis])]
        summed = terms[0]
        for term in terms[1:]:
            summed = summed + term
        array = jax.lax.squeeze(summed, (axis,))
    return array


def largest(array: Array, axis: int = 0) -> Array:
    """Maximum over an axis, by halves."""
    while (n := array.shape[axis]) > 1:
        half = (n + 1) // 2
        first = jax.lax.slice_in_dim(array, 0, half, axis=axis)
        array = jnp.maximum(first, jax.lax.slice_in_dim(array, n - half, n, axis=axis))
    return jax.lax.squeeze(array, (axis,))


def times(matrix: Array, vector: Array) -> Array:
    """Product of (m, n, ...) and (n, ...), or of (m, n, ...) and (n, k, ...)."""
    if matrix.ndim == vector.ndim:
        return total(matrix[:, :, None] * vector[None], 1)
    return total(matrix * vector[None], 1)


def _after(a: Array) -> Array:
    return jnp.concatenate([a[1:], a[:1]])


def cross(a: Array, b: Array) -> Array:
    """Cross product of vectors (3, ...)."""
    return _after(a * _after(b) - _after(a) * b)


def normalize(vector: Array) -> Array:
    """Vectors (3, ...) divided by their length; zero stays zero."""
    return vector / jnp.sqrt(total(vector * vector, 0) + jnp.finfo(vector.dtype).tiny)


def sandwich(outer: Array, form: Array) -> Array:
    """U' C U for U (3, 3, ...) and C (3, 3, S, ...): a form in other axes."""
    half = once(total(outer[:, :, None, None] * form[:, None], 0))
    return total(half[:, :, None] * outer[None, :, :, None], 1)


def rotate(vector: Array, matrix: Array) -> Array:
    """Cayley's rotation by a vector (3, ...), to the second order its exponential, times (3, n, ...)."""
    half = jnp.broadcast_to(vector[:, None] / 2, matrix.shape)
    turned = once(cross(half, matrix))
    return matrix + 2 * (turned + cross(half, turned)) / (1 + total(half * half, 0))


def inverse_and_determinant(s: Array) -> tuple[Array, Array]:
    """Inverse and determinant of symmetric, positive definite matrices (3, 3, ...)."""
    a, b, c, d, e, f = s[0, 0], s[0, 1], s[0, 2], s[1, 1], s[1, 2], s[2, 2]
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    u, v, w = a * f - c * c, b * c - a * e, a * d - b * b
    det = jnp.maximum(a * p + b * q + c * r, jnp.finfo(s.dtype).tiny)
    adjugate = jnp.stack([p, q, r, q, u, v, r, v, w]).reshape(s.shape)
    return once(adjugate / det), det


def solve_positive(matrix: Array, vector: Array) -> Array:
    """Solution (n, ...) of a symmetric, positive definite system (n, n, ...), by elimination."""
    n = len(vector)
    floor = jnp.finfo(matrix.dtype).eps * jnp.stack([matrix[i, i] for i in range(n)])
    rest, right, rows = matrix, vector, []
    for _ in range(n):
        pivot = jnp.maximum(rest[0, 0], floor[n - len(right)] + jnp.finfo(matrix.dtype).tiny)
        row, value = rest[0, 1:] / pivot, right[0] / pivot
        rows.append((row, value))
        right = right[1:] - row * right[0]
        rest = once(rest[1:, 1:] - rest[1:, :1] * row[None])
    solution = rows[-1][1][None]
    for row, value in rows[-2::-1]:
        solution = jnp.concatenate([(value - total(row * solution, 0))[None], solution])
    return solution


def turn(cosine: Array, sine: Array, i: int, j: int) -> Array:
    """Rotations (3, 3, ...) in the plane of the axes i and j."""
    zero, one = jnp.zeros_like(cosine), jnp.ones_like(cosine)
    rows = [[one if a == b else zero for b in range(3)] for a in range(3)]
    rows[i][i] = rows[j][j] = cosine
    rows[i][j], rows[j][i] = -sine, sine
    return jnp.stack([entry for row in rows for entry in row]).reshape(3, 3, *cosine.shape)


def diagonalize(
    forms: Array, weights: Array | None = None, together: Array | None = None, sweeps: int = 5
) -> Array:
    """Axes (3, 3, ...) in which forms (3, 3, S, ...) are as diagonal as possible, by Jacobi's rotations.

    They make sum_s w_s sum_i log (V' C_s V)_ii smallest (Flury & Gautschi 1986): principal axes that several
    covariances have in common, and the eigenvectors of a single one. Axes that are not correlated stay as
    they are, and are not sorted.

    Args:
        forms: positive definite.
        weights: (S, ...), or None for 1.
        together: (3, 3, ...) bool, pairs of axes that may be mixed; all by default.
        sweeps: number of rounds over the three pairs.
    """
    tiny = jnp.finfo(forms.dtype).tiny ** 0.5
    axes = jnp.broadcast_to(
        jnp.eye(3, dtype=forms.dtype).reshape(3, 3, *[1] * (forms.ndim - 3)),
        (*forms.shape[:2], *forms.shape[3:]),
    )

    def sweep(_: int, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        c, v = carry
        for i, j in _PAIRS:
            di, dj = jnp.maximum(c[i, i], tiny), jnp.maximum(c[j, j], tiny)
            gap, w = di - dj, (di - dj) / (di * dj)
            if weights is not None:
                w = w * weights
            apart, mixed = total(w * gap, 0), 2 * total(w * c[i, j], 0)
            length = jnp.sqrt(apart * apart + mixed * mixed + jnp.finfo(forms.dtype).tiny)
            tangent = mixed / (apart + length + jnp.finfo(forms.dtype).tiny)
            if together is not None:
                tangent = jnp.where(together[i, j], tangent, 0)
            cosine = 1 / jnp.sqrt(1 + tangent * tangent)
            q = once(turn(cosine, tangent * cosine, i, j))
            c, v = once((sandwich(q, c), times(v, q)))
        return c, v

    return jax.lax.fori_loop(0, sweeps, sweep, (forms, axes))[1]

"""Algebra of small vectors and matrices with components first and problems last.

A vector is (3, ...), a matrix (3, 3, ...), and the last axes run over problems. So every operation is
elementwise on long rows: there are no kernels for small matrices, and none of LAPACK.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp

__all__ = [
    "cross",
    "diagonalize",
    "inverse_and_determinant",
    "largest",
    "normalize",
    "once",
    "rotate",
    "sandwich",
    "solve_arrow",
    "times",
    "total",
]

Array = jax.Array
T = TypeVar("T")


def once(values: T) -> T:
    """Compute arrays and store them.

    XLA's CPU compiler puts chains of operations into one loop, and computes a value again for every operation
    that reads it; it looks past an optimization barrier. A condition that it cannot evaluate makes it store
    the values.
    """
    if jax.default_backend() != "cpu":
        return values
    leaf = jax.tree.leaves(values)[0]
    one = jax.lax.stop_gradient(leaf[(0,) * leaf.ndim])
    return jax.lax.cond(
        (one <= 0) | ~(one <= 0), lambda v: v, lambda v: jax.tree.map(jnp.negative, v), values
    )


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
    """Maximum over a short axis, term by term."""
    top, *rest = (jax.lax.slice_in_dim(array, i, i + 1, axis=axis) for i in range(array.shape[axis]))
    for term in rest:
        top = jnp.maximum(top, term)
    return jax.lax.squeeze(top, (axis,))


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


def solve_arrow(diagonal: Array, coupled: Array, right: Array) -> Array:
    """Solve a symmetric, positive definite system of blocks of three, by Schur's complement.

    Args:
        diagonal: (n, 3, 3, ...) the blocks on the diagonal.
        coupled: (n - 1, 3, 3, ...) blocks of the first with every other; those are not coupled.
        right: (n, 3, ...).

    Returns:
        (n, 3, ...).
    """
    sides = range(len(coupled))
    inverses = once(jnp.moveaxis(inverse_and_determinant(jnp.moveaxis(diagonal[1:], 0, 2))[0], 2, 0))
    carried = once(jnp.stack([times(coupled[k], inverses[k]) for k in sides]))
    whole, value = diagonal[0], right[0]
    for k in sides:
        whole = whole - times(carried[k], jnp.swapaxes(coupled[k], 0, 1))
        value = value - times(carried[k], right[k + 1])
    first = once(times(inverse_and_determinant(once(whole))[0], value))
    rest = [times(inverses[k], right[k + 1]) - times(jnp.swapaxes(carried[k], 0, 1), first) for k in sides]
    return jnp.stack([first, *rest])


def diagonalize(
    forms: Array, weights: Array | None = None, together: Array | None = None, sweeps: int = 5
) -> Array:
    """Axes (3, 3, ...) in which forms are nearly diagonal, by Jacobi's rotations.

    They make sum_s w_s sum_i log (V' C_s V)_ii smallest (Flury & Gautschi 1986): principal axes that several
    covariances have in common, and the eigenvectors of a single one. Axes that are not correlated stay as
    they are, and are not sorted.

    Args:
        forms: (3, 3, S, ...), positive definite.
        weights: (S, ...), or None for 1.
        together: (3, 3, ...) bool, pairs of axes that may be mixed; all by default.
        sweeps: number of rounds over the three pairs.
    """
    tiny = jnp.finfo(forms.dtype).tiny
    unit = jnp.eye(3, dtype=forms.dtype).reshape(3, 3, *[1] * (forms.ndim - 3))
    axes = jnp.broadcast_to(unit, (*forms.shape[:2], *forms.shape[3:]))
    mixing = jnp.ones((3, *forms.shape[3:]), bool) if together is None else _pairs(together)

    def rotation(_: int, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        c, v, mixing = carry
        di, dj = jnp.maximum(c[0, 0], tiny**0.5), jnp.maximum(c[1, 1], tiny**0.5)
        gap, w = di - dj, (di - dj) / (di * dj)
        w = w if weights is None else w * weights
        apart, mixed = total(w * gap, 0), 2 * total(w * c[0, 1], 0)
        length = jnp.sqrt(apart * apart + mixed * mixed + tiny)
        tangent = jnp.where(mixing[0], mixed / (apart + length), 0)
        cosine = 1 / jnp.sqrt(1 + tangent * tangent)
        cosine, sine = once((cosine, tangent * cosine))
        # the first axis goes to the end: the next pair is again that of the first two
        c = jnp.swapaxes(_turn_first(jnp.swapaxes(_turn_first(c, cosine, sine), 0, 1), cosine, sine), 0, 1)
        v = jnp.swapaxes(_turn_first(jnp.swapaxes(v, 0, 1), cosine, sine), 0, 1)
        return c, v, _after(mixing)

    return jax.lax.fori_loop(0, 3 * sweeps, rotation, (forms, axes, mixing))[1]


def _turn_first(rows: Array, cosine: Array, sine: Array) -> Array:
    """Turn the first two rows of (3, ...), and move the first to the end."""
    a, b = rows[0], rows[1]
    return jnp.stack([b * cosine - a * sine, rows[2], a * cosine + b * sine])


def _pairs(together: Array) -> Array:
    """Which of the pairs (0, 1), (1, 2), (2, 0) may be mixed, (3, ...)."""
    return jnp.stack([together[0, 1], together[1, 2], together[2, 0]])

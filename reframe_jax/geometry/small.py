"""Algebra of small vectors and matrices with components first and problems last.

A vector is (3, ...) and a matrix (3, 3, ...); the trailing axes are problems. Every operation is elementwise
on long arrays. Compiled libraries handle many small matrices one by one, which is slower.
"""

from collections.abc import Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry.symmetric import INDEX_PAIRS

Array = jax.Array
T = TypeVar("T")
_NO_MOMENT = -1.2345678e33  # a number that no array of moments contains


def materialize(values: T) -> T:
    """Store arrays in memory at this point of a program. The values do not change.

    Without this function, XLA may compute the arrays again in every operation that reads them. On a GPU, this
    costs less than the memory traffic, so the function returns its argument. On a CPU, it is a conditional
    whose predicate is always true but unknown to the compiler, which removes an ``optimization_barrier`` too
    early. The branches return the same values, but the barrier keeps the compiler from merging them. Outside
    of a program, arrays are in memory already.
    """
    first = next(leaf for leaf in jax.tree.leaves(values) if jnp.issubdtype(leaf.dtype, jnp.floating))
    if jax.default_backend() != "cpu" or not isinstance(first, jax.core.Tracer):
        return values
    corner = jax.lax.slice(first, (0,) * first.ndim, (1,) * first.ndim)
    always = jax.lax.reshape(corner, ()) != _NO_MOMENT
    return jax.lax.cond(always, lambda x: x, jax.lax.optimization_barrier, values)


def total(array: Array, *axes: int) -> Array:
    """Sum over axes with few entries, term by term: XLA's reductions over leading axes are slow on a CPU."""
    for axis in sorted(axes, reverse=True):
        terms = jax.lax.split(array, (1,) * array.shape[axis], axis)
        summed = terms[0]
        for term in terms[1:]:
            summed = summed + term
        array = jax.lax.squeeze(summed, (axis,))
    return array


def largest(array: Array, axis: int = 0) -> Array:
    """Return the maximum over an axis, by repeated comparison of the two halves of the axis."""
    while (length := array.shape[axis]) > 1:
        half = (length + 1) // 2
        first = jax.lax.slice_in_dim(array, 0, half, axis=axis)
        array = jnp.maximum(first, jax.lax.slice_in_dim(array, length - half, length, axis=axis))
    return jax.lax.squeeze(array, (axis,))


def pick(array: Array, index: Array, axis: int) -> Array:
    """Select entries of an axis by indices that exist; ``index`` has the last axes of the array, or all."""
    index = index.reshape(*[1] * (array.ndim - index.ndim), *index.shape)
    return jnp.take_along_axis(array, index, axis=axis, mode="promise_in_bounds")


def times(matrix: Array, vector: Array) -> Array:
    """Multiply matrices (m, n, ...) by vectors (n, ...) or by matrices (n, k, ...)."""
    if matrix.ndim == vector.ndim:
        ones = (1,) * len(vector)
        columns, rows = jax.lax.split(matrix, ones, 1), jax.lax.split(vector, ones)
        first, *others = (column * row for column, row in zip(columns, rows, strict=True))
        return sum(others, first)
    return total(matrix * vector[None], 1)


def cross(a: Array, b: Array) -> Array:
    """Return the cross products of vectors (3, ...)."""
    (x, y, z), (u, v, w) = jax.lax.split(a, (1, 1, 1)), jax.lax.split(b, (1, 1, 1))
    # components are ordered before they are multiplied: products that are concatenated are slow on a CPU
    second, third = jnp.concatenate([y, z, x]), jnp.concatenate([z, x, y])
    return second * jnp.concatenate([w, u, v]) - third * jnp.concatenate([v, w, u])


def unit_matrix(dtype: Any, lanes: int) -> Array:
    """Return the unit matrix (3, 3, 1, ...) for arrays of problems with this number of axes."""
    return jnp.asarray(np.eye(3), dtype).reshape(3, 3, *[1] * lanes)


def trace(matrix: Array) -> Array:
    """Return the traces (...) of matrices (3, 3, ...)."""
    return matrix[0, 0] + matrix[1, 1] + matrix[2, 2]


def axial(matrix: Array) -> Array:
    """Return vectors (3, ...) with the components m_23 - m_32, m_31 - m_13, m_12 - m_21 of (3, 3, ...)."""
    return jnp.stack([matrix[i, j] - matrix[j, i] for i, j in ((1, 2), (2, 0), (0, 1))])


def crosses(vector: Array) -> Array:
    """Return matrices (3, 3, ...) whose rows are the cross products of the coordinate axes with a vector."""
    signs = np.cross(np.eye(3)[:, None], np.eye(3)).reshape(3, 3, 3, *[1] * (vector.ndim - 1))
    return total(vector[None, :, None] * jnp.asarray(signs, vector.dtype), 1)


def normalize(vector: Array) -> Array:
    """Divide vectors (3, ...) by their length; zero stays zero."""
    return vector / jnp.sqrt(total(vector * vector, 0) + jnp.finfo(vector.dtype).tiny)


def sandwich(outer: Array, form: Array) -> Array:
    """Express quadratic forms C (3, 3, S, ...) in other axes, the columns of U (3, 3, ...): U' C U."""
    half = total(outer[:, :, None, None] * form[:, None], 0)
    return total(half[:, :, None] * outer[None, :, :, None], 1)


def rotate(vector: Array, matrix: Array) -> Array:
    """Rotate the columns of matrices (3, n, ...) by small vectors (3, ...), rad.

    Cayley's formula gives the rotation, which equals the exponential of the vector to second order.
    """
    half = jnp.broadcast_to(vector[:, None] / 2, matrix.shape)
    turned = materialize(cross(half, matrix))
    return matrix + 2 * (turned + cross(half, turned)) / (1 + total(half * half, 0))


def _decompose(s: Array | Sequence[Array]) -> tuple[Array, ...]:
    """Decompose symmetric, positive definite 3x3 matrices into L D L': the pivots D, and L_21, L_31, L_32.

    Pivots below the rounding error of the diagonal are raised to this error.
    """
    a, b, c, d, e, f = s

    def pivot(value: Array, diagonal: Array) -> Array:
        least = jnp.finfo(value.dtype).eps * diagonal + jnp.finfo(value.dtype).tiny ** 0.5
        return jnp.maximum(value, least)

    a = pivot(a, a)
    l2, l3 = b / a, c / a
    d2, u = pivot(d - l2 * b, d), e - l3 * b
    l4 = u / d2
    return a, d2, pivot(f - l3 * c - l4 * u, f), l2, l3, l4


def invert_symmetric(s: Array | Sequence[Array]) -> tuple[Array, Array]:
    """Invert symmetric, positive definite 3x3 matrices, accurately also where they are nearly singular.

    From the components 11, 12, 13, 22, 23, 33, the result is the inverses (3, 3, ...) and the determinants.
    """
    d1, d2, d3, l2, l3, l4 = _decompose(s)
    units = np.eye(3)[np.indices((3, 3))].transpose(3, 0, 1, 2)  # 1 where either index is 0, 1 or 2
    x, y, z = jnp.asarray(units.reshape(*units.shape, *[1] * d1.ndim), d1.dtype)
    # the sum of v v' / d over the rows v of the inverse of L, with products instead of concatenated
    # components, which are slow on a CPU
    rows = x, y - l2 * x, z - l4 * y + (l2 * l4 - l3) * x
    ends = (jax.lax.split(row, (1, 1)) for row in rows)
    terms = [one * other * (1 / d) for (one, other), d in zip(ends, (d1, d2, d3), strict=True)]
    return sum(terms[1:], terms[0])[0], d1 * d2 * d3


def solve_symmetric(matrix: Array, vectors: Array) -> Array:
    """Solve symmetric, positive definite systems (3, 3, ...) x = (3, ...) or (3, n, ...)."""
    inverse, _ = invert_symmetric([matrix[i, j] for i, j in INDEX_PAIRS])
    return times(materialize(inverse), vectors)


def solve_positive(matrix: Array, vector: Array) -> Array:
    """Solve symmetric, positive definite systems (n, n, ...) x = (n, ...) by Gauss-Jordan elimination."""
    length = len(vector)
    diagonal = jnp.stack([matrix[i, i] for i in range(length)])
    floor = jnp.finfo(matrix.dtype).eps * diagonal + jnp.finfo(matrix.dtype).tiny

    index = jnp.arange(length, dtype=jnp.int32).reshape(-1, *[1] * (vector.ndim - 1))

    def at(k: Array, array: Array, axis: int = 0) -> Array:
        return jax.lax.dynamic_index_in_dim(array, k, axis, keepdims=False, allow_negative_indices=False)

    def eliminate(k: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        matrix, vector = carry
        row, value, column = at(k, matrix), at(k, vector), at(k, matrix, 1)
        size = jnp.maximum(at(k, row), at(k, floor))
        row, value, column = jax.lax.optimization_barrier((row / size, value / size, column))
        own = index == k
        vector = jnp.where(own, value, vector - column * value)
        return jnp.where(own[:, None], row, matrix - column[:, None] * row), vector

    return jax.lax.fori_loop(0, length, eliminate, (matrix, vector))[1]


def count_independent(covariance: Array, least: Array) -> Array:
    """Count the independent variables of a covariance (n, n, ...), by elimination with pivots.

    A variable counts if the variance that the variables before it do not explain exceeds ``least`` (n, ...).
    """
    each = np.arange(len(covariance))
    index = each.reshape(-1, *[1] * (least.ndim - 1))

    def eliminate(_: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        rest, number = carry
        excess = rest[each, each] - least
        top, best = jnp.max(excess, axis=0), index == jnp.argmax(excess, axis=0)  # one of equals
        row = jnp.sum(jnp.where(best, rest, 0), axis=1)
        pivot = jnp.sum(jnp.where(best, row, 0), axis=0)
        return rest - jnp.where(top > 0, row[:, None] * row / pivot, 0), number + (top > 0)

    number = jnp.zeros(least.shape[1:], jnp.int32)
    return jax.lax.fori_loop(0, len(each), eliminate, (covariance, number))[1]


def diagonalize(
    forms: Array, weights: Array | None = None, together: Array | None = None, sweeps: int = 5
) -> Array:
    """Find the common principal axes of several covariances, by Jacobi rotations.

    The axes V minimize sum_s w_s sum_i log (V' C_s V)_ii (Flury & Gautschi 1986). For a single covariance,
    they are its eigenvectors. The function starts at the coordinate axes and does not sort the result.

    Axes are columns of (3, 3, ...). The forms C_s are (3, 3, S, ...), and the weights w_s (S, ...) are 1 by
    default. Only pairs of axes ``together`` (3, 3, ...) are rotated into each other, by default all, in
    ``sweeps`` rounds over the three pairs.
    """
    tiny = jnp.finfo(forms.dtype).tiny ** 0.5
    axes = jnp.broadcast_to(unit_matrix(forms.dtype, forms.ndim - 3), (3, 3, *forms.shape[3:]))
    pairs = None if together is None else jnp.stack([together[0, 1], together[1, 2], together[2, 0]])

    def turn(k: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        """Rotate the first two axes, then put the first one last."""
        c, v = carry
        one, two = jnp.maximum(c[0, 0], tiny), jnp.maximum(c[1, 1], tiny)
        gap, w = one - two, (one - two) / (one * two)
        if weights is not None:
            w = w * weights
        apart, mixed = total(w * gap, 0), 2 * total(w * c[0, 1], 0)
        length = jnp.sqrt(apart * apart + mixed * mixed + jnp.finfo(forms.dtype).tiny)
        tangent = mixed / (apart + length + jnp.finfo(forms.dtype).tiny)
        if pairs is not None:
            allowed = jax.lax.dynamic_index_in_dim(pairs, k % 3, 0, False, allow_negative_indices=False)
            tangent = jnp.where(allowed, tangent, 0)
        cosine = 1 / jnp.sqrt(1 + tangent * tangent)
        sine = tangent * cosine
        v = _turn_two(v, cosine, sine)
        c = _turn_two(c, cosine[None], sine[None])
        c = jnp.swapaxes(_turn_two(jnp.swapaxes(c, 0, 1), cosine[None], sine[None]), 0, 1)
        return c, v

    return jax.lax.fori_loop(0, 3 * sweeps, turn, (forms, axes))[1]


def _turn_two(columns: Array, cosine: Array, sine: Array) -> Array:
    """Columns (3, 3, ...): the first two turned into each other, the third, the new first."""
    one, two, third = jax.lax.split(columns, (1, 1, 1), 1)
    return jnp.concatenate([two * cosine - one * sine, third, one * cosine + two * sine], axis=1)

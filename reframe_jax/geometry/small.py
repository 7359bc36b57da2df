"""Algebra of small vectors and matrices with components first and problems last.

A vector is (3, ...), a matrix (3, 3, ...), and the last axes run over problems. So every operation is
elementwise on long rows, without LAPACK and without kernels for small matrices.
"""

from collections.abc import Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

Array = jax.Array
T = TypeVar("T")
_NO_MOMENT = -1.2345678e33  # a number that no array contains


def materialize(values: T) -> T:
    """Compute arrays once: otherwise XLA computes them again in every operation that reads them.

    An ``optimization_barrier`` does this on a GPU. On a CPU it is removed before operations are joined; only
    the boundary of a conditional stays, whose predicate is always true, which the compiler cannot know.
    """
    if jax.default_backend() != "cpu":
        return jax.lax.optimization_barrier(values)
    first = next(leaf for leaf in jax.tree.leaves(values) if jnp.issubdtype(leaf.dtype, jnp.floating))
    corner = jax.lax.slice(first, (0,) * first.ndim, (1,) * first.ndim)
    always = jax.lax.reshape(corner, ()) != _NO_MOMENT
    return jax.lax.cond(always, lambda x: x, lambda x: jax.tree.map(jnp.zeros_like, x), values)


def total(array: Array, *axes: int) -> Array:
    """Sum over short axes, term by term: on a CPU, reductions over leading axes take forty times as long."""
    for axis in sorted(axes, reverse=True):
        terms = jax.lax.split(array, (1,) * array.shape[axis], axis)
        summed = terms[0]
        for term in terms[1:]:
            summed = summed + term
        array = jax.lax.squeeze(summed, (axis,))
    return array


def largest(array: Array, axis: int = 0) -> Array:
    """Maximum over an axis, by halves."""
    while (length := array.shape[axis]) > 1:
        half = (length + 1) // 2
        first = jax.lax.slice_in_dim(array, 0, half, axis=axis)
        array = jnp.maximum(first, jax.lax.slice_in_dim(array, length - half, length, axis=axis))
    return jax.lax.squeeze(array, (axis,))


def times(matrix: Array, vector: Array) -> Array:
    """Product of (m, n, ...) and (n, ...), or of (m, n, ...) and (n, k, ...)."""
    if matrix.ndim == vector.ndim:
        return total(matrix[:, :, None] * vector[None], 1)
    return total(matrix * vector[None], 1)


def components_first(array: Array, components: int) -> Array:
    """Move the component axes to the front: (..., K, components) to (components, K, ...)."""
    axes = range(-components, 0)
    return jnp.moveaxis(array, (*axes, -components - 1), tuple(range(components + 1)))


def components_last(array: Array, components: int) -> Array:
    """Inverse of :func:`components_first`."""
    axes = range(-components, 0)
    return jnp.moveaxis(array, tuple(range(components + 1)), (*axes, -components - 1))


def cross(a: Array, b: Array) -> Array:
    """Cross product of vectors (3, ...)."""
    (x, y, z), (u, v, w) = jax.lax.split(a, (1, 1, 1)), jax.lax.split(b, (1, 1, 1))
    return jnp.concatenate([y * w - z * v, z * u - x * w, x * v - y * u])


def normalize(vector: Array) -> Array:
    """Vectors (3, ...) divided by their length; zero stays zero."""
    return vector / jnp.sqrt(total(vector * vector, 0) + jnp.finfo(vector.dtype).tiny)


def sandwich(outer: Array, form: Array) -> Array:
    """U' C U for U (3, 3, ...) and C (3, 3, S, ...): a form in other axes."""
    half = materialize(total(outer[:, :, None, None] * form[:, None], 0))
    return total(half[:, :, None] * outer[None, :, :, None], 1)


def rotate(vector: Array, matrix: Array) -> Array:
    """Cayley's rotation by a vector (3, ...), to the second order its exponential, times (3, n, ...)."""
    half = jnp.broadcast_to(vector[:, None] / 2, matrix.shape)
    turned = materialize(cross(half, matrix))
    return matrix + 2 * (turned + cross(half, turned)) / (1 + total(half * half, 0))


def invert_symmetric(s: Array | Sequence[Array], positive: bool = True) -> tuple[Array, Array]:
    """Inverse (6, ...) and determinant of symmetric 3 x 3 matrices: components 11, 12, 13, 22, 23, 33.

    By L D L', whose pivots are accurate to the rounding of the diagonal however small they are; a sum of
    cofactors loses them. Pivots of matrices that should be positive definite are at least that rounding.
    """
    a, b, c, d, e, f = s

    def pivot(value: Array, diagonal: Array) -> Array:
        least = jnp.finfo(value.dtype).eps * diagonal + jnp.finfo(value.dtype).tiny ** 0.5
        return jnp.maximum(value, least) if positive else value

    a = pivot(a, a)
    l2, l3 = b / a, c / a
    d2, u = pivot(d - l2 * b, d), e - l3 * b
    l4 = u / d2
    d3 = pivot(f - l3 * c - l4 * u, f)
    i2, i3, k = 1 / d2, 1 / d3, l2 * l4 - l3
    inverse = [1 / a + l2 * l2 * i2 + k * k * i3, -l2 * i2 - k * l4 * i3, k * i3]
    return materialize(jnp.stack([*inverse, i2 + l4 * l4 * i3, -l4 * i3, i3])), a * d2 * d3


def inverse_and_determinant(s: Array, positive: bool = True) -> tuple[Array, Array]:
    """Inverse (3, 3, ...) and determinant of symmetric matrices (3, 3, ...); see :func:`invert_symmetric`."""
    inverse, det = invert_symmetric([s[i, j] for i in range(3) for j in range(i, 3)], positive)
    return inverse[np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]], np.int32)], det


def solve_positive(matrix: Array, vector: Array) -> Array:
    """Solution (n, ...) of a symmetric, positive definite system (n, n, ...), by Gauss and Jordan."""
    length = len(vector)
    diagonal = jnp.stack([matrix[i, i] for i in range(length)])
    floor = jnp.finfo(matrix.dtype).eps * diagonal + jnp.finfo(matrix.dtype).tiny

    def eliminate(_: int, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        """Eliminate the first unknown, then put it last."""
        matrix, vector, floor = carry
        size = jnp.maximum(matrix[0, 0], floor[0])
        row, value = materialize((matrix[0] / size, vector[0] / size))
        column = matrix[1:, 0]
        matrix = jnp.concatenate([matrix[1:] - column[:, None] * row[None], row[None]])
        vector = jnp.concatenate([vector[1:] - column * value[None], value[None]])
        return _first_last(matrix, 1), vector, _first_last(floor, 0)

    return jax.lax.fori_loop(0, length, eliminate, (matrix, vector, floor))[1]


def _first_last(array: Array, axis: int) -> Array:
    first, rest = jax.lax.split(array, (1, array.shape[axis] - 1), axis)
    return jnp.concatenate([rest, first], axis)


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
    lanes = forms.ndim - 3
    axes = jnp.eye(3, dtype=forms.dtype).reshape(3, 3, *[1] * lanes)
    axes = jnp.broadcast_to(axes, (*forms.shape[:2], *forms.shape[3:]))
    allowed = jnp.ones(axes.shape, bool) if together is None else jnp.broadcast_to(together, axes.shape)

    def turn(_: int, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        """Rotate the first two axes, then put the first one last."""
        c, v, allowed = carry
        one, two = jnp.maximum(c[0, 0], tiny), jnp.maximum(c[1, 1], tiny)
        gap, w = one - two, (one - two) / (one * two)
        if weights is not None:
            w = w * weights
        apart, mixed = materialize((total(w * gap, 0), 2 * total(w * c[0, 1], 0)))
        length = jnp.sqrt(apart * apart + mixed * mixed + jnp.finfo(forms.dtype).tiny)
        tangent = mixed / (apart + length + jnp.finfo(forms.dtype).tiny)
        tangent = jnp.where(allowed[0, 1], tangent, 0)
        cosine = 1 / jnp.sqrt(1 + tangent * tangent)
        cosine, sine = materialize((cosine, tangent * cosine))
        v = materialize(_turn_two(v, cosine, sine))
        c = materialize(_turn_two(c, cosine[None], sine[None]))
        c = materialize(jnp.swapaxes(_turn_two(jnp.swapaxes(c, 0, 1), cosine[None], sine[None]), 0, 1))
        return c, v, jnp.roll(allowed, (-1, -1), (0, 1))

    return jax.lax.fori_loop(0, 3 * sweeps, turn, (forms, axes, allowed))[1]


def _turn_two(columns: Array, cosine: Array, sine: Array) -> Array:
    """Columns (3, 3, ...): the first two turned into each other, the third, the new first."""
    one, two, third = columns[:, 0], columns[:, 1], columns[:, 2]
    return jnp.stack([two * cosine - one * sine, third, one * cosine + two * sine], axis=1)

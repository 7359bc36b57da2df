"""Algebra of small vectors and matrices with components first: (3, ...), (6, ...), (3, 3, ...).

Every operation is elementwise on long rows of samples and windows, and needs no kernels for small matrices,
which are slow in XLA.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

__all__ = ["bracket", "components_first", "components_last", "cross", "product", "stack", "transpose", "unit"]


def components_first(array: jax.Array, components: int) -> jax.Array:
    """(..., K, components) to (components, K, ...), for a number of component axes."""
    axes = range(-components, 0)
    return jnp.moveaxis(array, (*axes, -components - 1), tuple(range(components + 1)))


def components_last(array: jax.Array, components: int) -> jax.Array:
    """Inverse of :func:`components_first`."""
    axes = range(-components, 0)
    return jnp.moveaxis(array, tuple(range(components + 1)), (*axes, -components - 1))


def product(a: jax.Array, b: jax.Array) -> jax.Array:
    """Matrix product (3, 3, ...) (3, n, ...) or matrix times vector (3, 3, ...) (3, ...)."""
    if b.ndim == a.ndim:
        return a[:, 0, None] * b[0, None] + a[:, 1, None] * b[1, None] + a[:, 2, None] * b[2, None]
    return a[:, 0] * b[0, None] + a[:, 1] * b[1, None] + a[:, 2] * b[2, None]


def stack(parts: Sequence[jax.Array], axis: int = 0) -> jax.Array:
    """Stack arrays of one shape.

    On a CPU they are computed first, each by itself, and then copied: XLA would compute them number by number
    in one loop, which asks at every number whose turn it is.
    """
    return jnp.concatenate(([jnp.expand_dims(part, axis) for part in parts]), axis=axis)


def _cross(a: jax.Array, b: jax.Array) -> list[jax.Array]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Cross product of vectors (3, ...)."""
    return stack(_cross(a, b))


def transpose(matrix: jax.Array) -> jax.Array:
    """Transpose of matrices (3, 3, ...)."""
    return jnp.swapaxes(matrix, 0, 1)


def bracket(a: jax.Array, b: jax.Array) -> jax.Array:
    """Lie bracket of twists (w, v), (wa x wb, wa x vb - wb x va), or of angular velocities, (3, ...)."""
    if a.shape[0] == 3:
        return cross(a, b)
    wa, va, wb, vb = a[:3], a[3:], b[:3], b[3:]
    return stack(_cross(wa, wb) + [x - y for x, y in zip(_cross(wa, vb), _cross(wb, va), strict=True)])


def unit(vector: jax.Array) -> jax.Array:
    """Vectors (3, ...) divided by their length."""
    return vector / jnp.sqrt(jnp.sum(jnp.square(vector), axis=0))[None]

"""Algebra of small vectors and matrices with components first: (3, ...), (6, ...), (3, 3, ...).

Every operation is elementwise on long rows of samples and windows. It needs no kernels for small matrices,
which are slow in XLA.
"""

import jax
import jax.numpy as jnp

__all__ = ["bracket", "components_first", "components_last", "cross", "product", "transpose"]


def components_first(array: jax.Array, components: int) -> jax.Array:
    """Move the component axes to the front: (..., K, components) to (components, K, ...)."""
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


def cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Cross product of vectors (3, ...)."""
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def transpose(matrix: jax.Array) -> jax.Array:
    """Transpose of matrices (3, 3, ...)."""
    return jnp.swapaxes(matrix, 0, 1)


def bracket(a: jax.Array, b: jax.Array) -> jax.Array:
    """Lie bracket of twists (w, v), (6, ...): (wa x wb, wa x vb - wb x va)."""
    wa, va, wb, vb = a[:3], a[3:], b[:3], b[3:]
    return jnp.concatenate([cross(wa, wb), cross(wa, vb) - cross(wb, va)])

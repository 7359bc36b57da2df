"""Matrix products in full precision.

By default, JAX multiplies float32 matrices on GPUs with a mantissa of 10 bits, which limits the accuracy of
an orientation to a milliradian.
"""

import jax
import jax.numpy as jnp
from jax import lax


def matmul(a: jax.Array, b: jax.Array) -> jax.Array:
    """Multiply matrices (..., m, n) by matrices (..., n, k), as ``a @ b`` does."""
    return jnp.matmul(a, b, precision=lax.Precision.HIGHEST)


def apply(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """Multiply matrices (..., m, n) by vectors (..., n)."""
    return matmul(matrix, vector[..., None])[..., 0]

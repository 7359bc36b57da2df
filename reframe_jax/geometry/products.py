"""Products of matrices in full precision.

GPUs multiply float32 matrices with 10 bits of mantissa unless told otherwise: JAX's default there. An
orientation is then good to a milliradian.
"""

import jax
import jax.numpy as jnp
from jax import lax

__all__ = ["apply", "matmul"]


def matmul(a: jax.Array, b: jax.Array) -> jax.Array:
    """``a @ b``."""
    return jnp.matmul(a, b, precision=lax.Precision.HIGHEST)


def apply(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """Matrices (..., m, n) times vectors (..., n)."""
    return matmul(matrix, vector[..., None])[..., 0]

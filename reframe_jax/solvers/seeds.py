"""Starting points that fill a box evenly."""

import jax
import jax.numpy as jnp
import numpy as np

__all__ = ["quasi_random"]


def quasi_random(key: jax.Array, count: int, dim: int, dtype: jnp.dtype) -> jax.Array:
    """Points of the unit cube: Roberts' additive recurrence R_d, shifted at random.

    Any prefix of the sequence covers the cube evenly, so ``count`` can change freely. Its increments
    are powers of the real root of x^(d+1) = x + 1, the generalized golden ratio.

    Args:
        key: JAX random key of the shift.
        count: number of points.
        dim: dimension of the cube.
        dtype: type of the result.

    Returns:
        (dim, count) in [0, 1).
    """
    root = 2.0
    for _ in range(64):
        root = (1 + root) ** (1 / (dim + 1))
    steps = np.arange(1, count + 1) * root ** -np.arange(1.0, dim + 1)[:, None]
    shift = jax.random.uniform(key, (dim, 1), dtype=dtype)
    return jnp.mod(jnp.asarray(steps % 1, dtype=dtype) + shift, 1)

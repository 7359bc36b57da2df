"""How probable a second origin is: by the sampling distribution of the difference of two norms.

Two origins that explain the same window are not independent: what one leaves over, the other mostly leaves
over as well. Their norms differ by d = (log det S_2 - log det S_1) / 2, S being the covariance along the
constrained axes, and d is a sum over the samples of the difference of what they contribute. The spread of
that sum tells how much d may be by chance (Vuong 1989).
"""

import jax
import jax.numpy as jnp

from reframe_jax.geometry import symmetric
from reframe_jax.uncertainty.sandwich import long_run_variance

__all__ = ["twin_probability"]


def twin_probability(
    samples: jax.Array, slopes: jax.Array, twin: jax.Array, dof: jax.Array, block: jax.Array
) -> jax.Array:
    """Probability that the twin is the true origin rather than the reported one, (N,).

    Args:
        samples: (3, K+1, N) of the path of the reported origin, along the axes of the frame.
        slopes: (3, 3, K+1, N) derivatives of these by the coordinates of the origin.
        twin: (3, N) m, from the reported origin.
        dof: (3, N), 1 where an axis is free.
        block: (N,) samples beyond which errors are independent.
    """
    held = jnp.sum(dof == 0, axis=0)
    here, share = _left_over(samples, held)
    there, its_share = _left_over(samples + jnp.sum(slopes * twin[None, :, None], axis=1), held)
    variance = long_run_variance((its_share - share)[None], block)[0]
    difference = there - here
    deviations = difference / jnp.sqrt(jnp.maximum(variance, jnp.finfo(variance.dtype).tiny))
    return jax.scipy.stats.norm.cdf(-deviations)


def _left_over(samples: jax.Array, held: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Logarithm of the norm along the constrained axes, (N,), and what each sample adds to it, (K+1, N)."""
    rows = [[jnp.sum(a * b, axis=0) for b in samples] for a in samples]
    xx, xy, xz, yy, yz, zz = (rows[i][j] for i, j in symmetric.INDEX_PAIRS)
    values, vectors = symmetric.eigh((xx, xy, xz, yy, yz, zz))
    tiny = jnp.finfo(samples.dtype).tiny
    total, share = jnp.zeros_like(values[0]), jnp.zeros_like(samples[0])
    for i, (value, vector) in enumerate(zip(values, vectors, strict=True)):
        counted, value = i < held, jnp.maximum(value, tiny)
        along = jnp.sum(samples * jnp.stack(vector)[:, None], axis=0)
        total = total + jnp.where(counted, jnp.log(value) / 2, 0)
        share = share + jnp.where(counted[None], jnp.square(along) / (2 * value)[None], 0)
    mean = jnp.mean(share, axis=0, keepdims=True)
    return total, share - mean

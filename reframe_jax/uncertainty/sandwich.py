"""The covariance of an estimate from its sensitivities: by the noise of the poses, and by what is left over.

The noise of the poses gives sum_k s_p^2 P_k P_k^T + s_r^2 Q_k Q_k^T, P_k and Q_k being the sensitivities to
shift and rotation of pose k. Chords that overlap share poses, which this takes into account.

The errors of trackers are not white. What is left along the constrained axes tells how much larger the
covariance is: contributions of neighbouring samples to an estimate, which white noise makes independent
beyond the length of a chord, then have the same sign. Summed over blocks and squared, they give the long-run
variance (Newey and West 1987). Its ratio to what the noise explains inflates the covariance.
"""

import jax

from reframe_jax.arrays import jnp
from reframe_jax.compilation import once
from reframe_jax.geometry.products import matmul

__all__ = ["inflation", "long_run_variance", "noise_covariance", "noise_variances"]


def noise_covariance(turn: jax.Array, shift: jax.Array, noise: tuple[jax.Array, jax.Array]) -> jax.Array:
    """Covariance of m estimates by white noise in the poses.

    Args:
        turn: (m, 3, K+1, N) sensitivities to the rotation of every pose.
        shift: (m, 3, K+1, N) sensitivities to its position.
        noise: (N,) m and (N,) rad, standard deviation of each component of position and orientation.

    Returns:
        (m, m, N).
    """
    rows = jnp.concatenate([turn * noise[1][None, None, None], shift * noise[0][None, None, None]], axis=1)
    flat = jnp.moveaxis(once(rows.reshape(rows.shape[0], -1, rows.shape[-1])), -1, 0)
    return jnp.moveaxis(matmul(flat, jnp.swapaxes(flat, 1, 2)), 0, -1)


def noise_variances(turn: jax.Array, shift: jax.Array, noise: tuple[jax.Array, jax.Array]) -> jax.Array:
    """The diagonal of :func:`noise_covariance`, (m, N)."""
    by_shift, by_turn = (jnp.sum(jnp.square(rows), axis=(1, 2)) for rows in (shift, turn))
    return jnp.square(noise[0])[None] * by_shift + jnp.square(noise[1])[None] * by_turn


def long_run_variance(scores: jax.Array, block: jax.Array) -> jax.Array:
    """Variance of the sum over the samples of (m, K, N), (m, N), from the sums over all blocks.

    Args:
        scores: contributions of the samples, of mean zero.
        block: (N,) samples in a block.
    """
    length = scores.shape[1]
    total = jnp.cumsum(scores, axis=1)
    padded = jnp.concatenate([jnp.zeros_like(total[:, :1]), total], axis=1)
    ends = jnp.arange(1, 2 * length, dtype=jnp.int32)[:, None]  # blocks may stick out at both ends
    starts = jnp.maximum(ends - block[None], 0)
    inside = ends - block[None] < length

    def at(index: jax.Array) -> jax.Array:
        return jnp.take_along_axis(padded, jnp.minimum(index, length)[None], axis=1)

    sums = jnp.where(inside[None], at(ends) - at(starts), 0)
    return jnp.sum(jnp.square(sums), axis=1) / block.astype(scores.dtype)[None]


def inflation(long_run: jax.Array, explained: jax.Array) -> jax.Array:
    """How much larger standard deviations are than the noise explains, (N,): one or more.

    Args:
        long_run: (m, N) variances of quantities of one kind by what is left over.
        explained: (m, N) the same by the noise.
    """
    tiny = jnp.finfo(explained.dtype).tiny
    ratio = jnp.sum(long_run, axis=0) / jnp.maximum(jnp.sum(explained, axis=0), tiny)
    return jnp.sqrt(jnp.maximum(ratio, 1))

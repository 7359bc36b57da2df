"""How probable a second origin, or another frame type, is: by the sampling distribution of a difference.

Two origins that explain the same window are not independent: what one leaves over, the other mostly leaves
over as well. Their norms differ by d = (log det S_2 - log det S_1) / 2, S being the covariance along the
constrained axes, and d is a sum over the samples of the difference of what they contribute. The spread of
that sum tells how much d may be by chance (Vuong 1989). The same holds for the origins of two frame types.
"""

import jax

from reframe_jax.arrays import jnp, norm
from reframe_jax.compilation import once
from reframe_jax.geometry import symmetric
from reframe_jax.uncertainty.sampling import Sampling
from reframe_jax.uncertainty.sandwich import long_run_variance

__all__ = ["twin_probability", "type_probability"]

_MISSED = 0.1  # of the logarithm of an axis: noise does not act on the paths of all types alike


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
    there = samples + jnp.sum(slopes * twin[None, :, None], axis=1)
    both = jnp.stack([there, samples], axis=1)
    total, shares = _left_over(both, held)
    return _better((total[:1], shares[:1]), (total[1:], shares[1:]), block)[0]


def type_probability(
    paths: jax.Array, sampling: Sampling, winner: jax.Array, dof: jax.Array, block: jax.Array
) -> jax.Array:
    """Probability that each linear type, rather than the reported one, has the stiller axes, (N, 4).

    Compared are as many axes as the reported type has constrained: the slowest ones of every type.

    Args:
        paths: (3, K+1, 4, N) m, of the origins of all types.
        sampling: of the windows.
        winner: (N,) the reported type.
        dof: (3, N) of its axes, 1 where an axis is free.
        block: (N,) samples beyond which errors are independent.
    """
    held = jnp.sum(dof == 0, axis=0)
    rows = jnp.swapaxes(paths, 1, 2)
    samples = sampling.take(rows.reshape(-1, *rows.shape[2:])).reshape(rows.shape)
    total, shares = once(_left_over(once(samples), held))
    own = jnp.take_along_axis(total, winner[None], axis=0)
    own_shares = jnp.take_along_axis(shares, winner[None, None], axis=0)
    missed = _MISSED * jnp.sqrt(held.astype(paths.dtype))[None]
    return _better((total, shares), (own, own_shares), block, missed).T


def _better(
    one: tuple[jax.Array, jax.Array],
    other: tuple[jax.Array, jax.Array],
    block: jax.Array,
    missed: jax.Array | float = 0.0,
) -> jax.Array:
    """Probability that each of m leaves less over than another, (m, N); 1/2 where the two leave the same.

    Args:
        one: logarithms of their norms, (m, N), and what each sample adds to them, (m, K+1, N).
        other: likewise, of the other, or of one other for all.
        block: (N,) samples beyond which errors are independent.
        missed: standard deviation of the difference of the logarithms besides chance.
    """
    variance = long_run_variance(one[1] - other[1], block)
    rounding = jnp.finfo(variance.dtype).eps  # its square root, of the logarithm of a norm
    deviation = jnp.sqrt(variance + jnp.square(missed) + rounding)
    return norm.cdf((other[0] - one[0]) / deviation)


def _left_over(samples: jax.Array, held: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Logarithms of the norms along the constrained axes, (m, N), and what each sample adds, (m, K+1, N).

    Args:
        samples: (3, m, K+1, N).
        held: (N,) how many axes are constrained.
    """
    xx, xy, xz, yy, yz, zz = (jnp.sum(samples[i] * samples[j], axis=1) for i, j in symmetric.INDEX_PAIRS)
    values, vectors = symmetric.eigh((xx, xy, xz, yy, yz, zz))
    tiny = jnp.finfo(samples.dtype).tiny
    total, share = jnp.zeros_like(values[0]), jnp.zeros_like(samples[0])
    for i, (value, vector) in enumerate(zip(values, vectors, strict=True)):
        counted, value = (i < held)[None], jnp.maximum(value, tiny)
        along = jnp.sum(samples * jnp.stack(vector)[:, :, None], axis=0)
        total = total + jnp.where(counted, jnp.log(value) / 2, 0)
        share = share + jnp.where(counted[None], jnp.square(along) / (2 * value)[:, None], 0)
    mean = jnp.mean(share, axis=1, keepdims=True)
    return total, share - mean

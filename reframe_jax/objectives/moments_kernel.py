"""The sums over samples as one GPU kernel.

What XLA makes of them on a GPU reads the samples once for every product. Here every thread reads the
samples of one problem once and adds up all products in registers.
"""

from typing import Any

import jax
import jax.numpy as jnp

__all__ = ["mean_products"]

_BLOCK = 128  # problems in a block, one to a thread


def mean_products(entries: jax.Array, interpret: bool = False) -> list[jax.Array]:
    """Mean over the samples of the product of every entry with itself and with those after it.

    Args:
        entries: (n, K, N), of N problems.
        interpret: run without a GPU, slowly, for tests.

    Returns:
        For every entry i an array (n - i, N).
    """
    from jax.experimental import pallas as pl  # slow to import, and of no use on a CPU
    from jax.experimental.pallas import triton

    n, samples, count = entries.shape
    blocks = -(-count // _BLOCK)
    if count % _BLOCK:  # the last problem fills the last block
        entries = entries[:, :, jnp.minimum(jnp.arange(blocks * _BLOCK), count - 1)]
    pairs = [(i, j) for i in range(n) for j in range(i, n)]

    def add_up(entries: Any, *rows: Any) -> None:
        def add(k: Any, totals: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
            x = [entries[i, k] for i in range(n)]
            return tuple(total + x[i] * x[j] for total, (i, j) in zip(totals, pairs, strict=True))

        zero = jnp.zeros(_BLOCK, entries.dtype)
        totals = jax.lax.fori_loop(0, samples, add, (zero,) * len(pairs))
        for total, (i, j) in zip(totals, pairs, strict=True):
            rows[i][j - i] = total / samples

    out = pl.pallas_call(
        add_up,
        grid=(blocks,),
        in_specs=[pl.BlockSpec((n, samples, _BLOCK), lambda b: (0, 0, b))],
        out_specs=[pl.BlockSpec((n - i, _BLOCK), lambda b: (0, b)) for i in range(n)],
        out_shape=[jax.ShapeDtypeStruct((n - i, blocks * _BLOCK), entries.dtype) for i in range(n)],
        interpret=interpret,
        compiler_params=None if interpret else triton.CompilerParams(num_warps=_BLOCK // 32),
    )(entries)
    return [row[:, :count] for row in out]

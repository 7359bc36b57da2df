"""The whole search of a problem as one GPU kernel.

A GPU's arithmetic waits for memory, and the search, run operation by operation, reads and writes its
values some thousand times. Here every thread loads the 60 moments of one problem once, runs one chain
of :class:`BasinHopping` in registers, and writes four numbers. The operations and the random numbers are
those of :mod:`reframe_jax.optimise.basin_hopping` with :class:`ValleySteps`; only their order in
memory differs.
"""

from typing import Any, cast

import jax
import jax.numpy as jnp

from reframe_jax.compilation import inside_a_kernel
from reframe_jax.optimise.valley import descend
from reframe_jax.symmetric import Vector

__all__ = ["search_chains"]

_BLOCK = 128  # problems in a block, one to a thread


def search_chains(
    moments: jax.Array,
    low: jax.Array,
    high: jax.Array,
    starts: jax.Array,
    jumps: jax.Array,
    accepted: jax.Array,
    *,
    steps: int,
    hops: int,
    polish: int,
    interpret: bool = False,
) -> tuple[jax.Array, jax.Array]:
    """Run every chain of every problem.

    Args:
        moments: (6, 10, N), see :mod:`reframe_jax.moments`.
        low: (3,) faces of the box, m.
        high: (3,) faces of the box, m.
        starts: (3, R) where the chains start, m.
        jumps: (H, 3, R) jump of every hop, m; H >= 1.
        accepted: (H, R) largest rise of log J that a hop accepts.
        steps: local steps after every jump.
        hops: jumps of a chain.
        polish: final local minimisations of a chain, without a jump.
        interpret: run without a GPU, slowly, for tests.

    Returns:
        Best origins (3, R, N) and log J there (R, N).
    """
    from jax.experimental import pallas as pl  # slow to import, and of no use on a CPU
    from jax.experimental.pallas import triton

    restarts = starts.shape[1]
    count, dtype = moments.shape[2], moments.dtype
    blocks = -(-count // _BLOCK)
    if count % _BLOCK:  # the last problem fills the last block
        moments = moments[:, :, jnp.minimum(jnp.arange(blocks * _BLOCK), count - 1)]
    tables = [table.reshape(-1) for table in (low, high, starts, jumps, accepted)]

    def chain(*refs: Any) -> None:
        values = [ref[...] for ref in refs[:60]]
        low, high, starts, jumps, accepted = refs[60:65]
        x_ref, value_ref = refs[65:68], refs[68]
        r = pl.program_id(1)
        coefficients = [values[10 * i : 10 * i + 10] for i in range(6)]
        box = cast(Vector, tuple(low[a] for a in range(3))), cast(Vector, tuple(high[a] for a in range(3)))
        zero = jnp.zeros_like(values[0])

        def step(h: Any, carry: tuple[Vector, jax.Array, Vector, jax.Array]) -> tuple[Any, ...]:
            """One body for the first minimisation, the hops and the polishing: it is compiled once."""
            p, value, best_p, best = carry
            row = jnp.clip(h - 1, 0, hops - 1)
            begin = []
            for a in range(3):
                hopped = jnp.clip(p[a] + jumps[(row * 3 + a) * restarts + r], box[0][a], box[1][a])
                begin.append(jnp.where(h == 0, p[a], jnp.where(h > hops, best_p[a], hopped)))
            q, determinant = descend(coefficients, *box, cast(Vector, tuple(begin)), steps)
            new = jnp.log(determinant) / 6
            new = jnp.where(new == new, new, jnp.inf)  # NaN counts as infinite
            accept, better = new < value + accepted[row * restarts + r], new < best
            return (
                tuple(jnp.where(accept, q[a], p[a]) for a in range(3)),
                jnp.where(accept, new, value),
                tuple(jnp.where(better, q[a], best_p[a]) for a in range(3)),
                jnp.where(better, new, best),
            )

        start = cast(Vector, tuple(zero + starts[a * restarts + r] for a in range(3)))
        worst = zero + jnp.inf
        total = 1 + hops + polish
        *_, best_p, best = jax.lax.fori_loop(0, total, step, (start, worst, start, worst))
        for a in range(3):
            x_ref[a][...] = best_p[a]
        value_ref[...] = best

    columns = [
        pl.BlockSpec((None, None, _BLOCK), lambda b, r, i=i, j=j: (i, j, b))
        for i in range(6)
        for j in range(10)
    ]
    whole = [pl.BlockSpec(table.shape, lambda b, r: (0,)) for table in tables]
    out = jax.ShapeDtypeStruct((restarts, blocks * _BLOCK), dtype)
    with inside_a_kernel():
        *x, value = pl.pallas_call(
            chain,
            grid=(blocks, restarts),
            in_specs=columns + whole,
            out_specs=[pl.BlockSpec((None, _BLOCK), lambda b, r: (r, b))] * 4,
            out_shape=[out] * 4,
            interpret=interpret,
            compiler_params=None if interpret else triton.CompilerParams(num_warps=_BLOCK // 32),
        )(*[moments] * 60, *tables)
    return jnp.stack(x)[:, :, :count], value[:, :count]

"""The whole search of a problem as one GPU kernel.

A GPU's arithmetic waits for memory, and the search, run operation by operation, reads and writes its
values some thousand times. Here every thread loads the 60 moments of one problem once, takes one chain
of :class:`BasinHopping` through its steps in registers, and writes eight numbers. The operations and the
random numbers are those of :mod:`reframe_jax.solvers.basin_hopping` with :class:`ValleySteps`; only
their order in memory differs.
"""

from typing import Any, cast

import jax
import jax.numpy as jnp

from reframe_jax.compilation import inside_a_kernel
from reframe_jax.geometry.symmetric import Vector
from reframe_jax.solvers.valley_steps import descend

__all__ = ["step_chains"]

_BLOCK = 128  # problems in a block, one to a thread


def step_chains(
    moments: jax.Array,
    low: jax.Array,
    high: jax.Array,
    hop: jax.Array,
    x: jax.Array,
    value: jax.Array,
    best_x: jax.Array,
    best_value: jax.Array,
    jumps: jax.Array,
    rises: jax.Array,
    *,
    steps: int,
    hops: int,
    interpret: bool = False,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Make some steps of every chain of every problem.

    Args:
        moments: (6, 10, N), see :mod:`reframe_jax.objectives.moments`.
        low: (3,) faces of the box, m.
        high: (3,) faces of the box, m.
        hop: steps made so far.
        x: (3, R, N) where the chains are, m.
        value: (R, N) log J there.
        best_x: (3, R, N) the best they have met, m.
        best_value: (R, N) log J there.
        jumps: (S, 3, R) jump of every step, m.
        rises: (S, R) largest rise of log J that a step accepts.
        steps: local steps after every jump.
        hops: jumps of a chain; steps after them start from the best.
        interpret: run without a GPU, slowly, for tests.

    Returns:
        The new ``x, value, best_x, best_value``.
    """
    from jax.experimental import pallas as pl  # slow to import, and of no use on a CPU
    from jax.experimental.pallas import triton

    total, _, restarts = jumps.shape
    count = moments.shape[2]
    blocks = -(-count // _BLOCK)
    chains = [*x, value, *best_x, best_value]
    if count % _BLOCK:  # the last problem fills the last block
        fill = jnp.minimum(jnp.arange(blocks * _BLOCK), count - 1)
        moments, chains = moments[:, :, fill], [a[:, fill] for a in chains]
    tables = [table.reshape(-1) for table in (low, high, hop, jumps, rises)]

    def chain(*refs: Any) -> None:
        values, start, outputs = [ref[...] for ref in refs[:60]], refs[60:68], refs[73:]
        low, high, first, jumps, rises = refs[68:73]
        r = pl.program_id(1)
        coefficients = [values[10 * i : 10 * i + 10] for i in range(6)]
        box = cast(Vector, tuple(low[a] for a in range(3))), cast(Vector, tuple(high[a] for a in range(3)))

        def step(s: Any, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
            """One body for the first minimisation, the hops and the polishing: it is compiled once."""
            p, value, best_p, best = carry[:3], carry[3], carry[4:7], carry[7]
            hop, begin = first[0] + s, []
            for a in range(3):
                hopped = jnp.clip(p[a] + jumps[(s * 3 + a) * restarts + r], box[0][a], box[1][a])
                begin.append(jnp.where(hop == 0, p[a], jnp.where(hop > hops, best_p[a], hopped)))
            q, determinant = descend(coefficients, *box, cast(Vector, tuple(begin)), steps)
            new = jnp.log(determinant) / 6
            new = jnp.where(new == new, new, jnp.inf)  # NaN counts as infinite
            accept, better = new < value + rises[s * restarts + r], new < best
            return (
                *(jnp.where(accept, q[a], p[a]) for a in range(3)),
                jnp.where(accept, new, value),
                *(jnp.where(better, q[a], best_p[a]) for a in range(3)),
                jnp.where(better, new, best),
            )

        after = jax.lax.fori_loop(0, total, step, tuple(ref[...] for ref in start))
        for ref, new in zip(outputs, after, strict=True):
            ref[...] = new

    columns = [
        pl.BlockSpec((None, None, _BLOCK), lambda b, r, i=i, j=j: (i, j, b))
        for i in range(6)
        for j in range(10)
    ]
    of_chain = pl.BlockSpec((None, _BLOCK), lambda b, r: (r, b))
    whole = [pl.BlockSpec(table.shape, lambda b, r: (0,)) for table in tables]
    out = jax.ShapeDtypeStruct((restarts, blocks * _BLOCK), moments.dtype)
    with inside_a_kernel():
        after = pl.pallas_call(
            chain,
            grid=(blocks, restarts),
            in_specs=[*columns, *[of_chain] * 8, *whole],
            out_specs=[of_chain] * 8,
            out_shape=[out] * 8,
            interpret=interpret,
            compiler_params=None if interpret else triton.CompilerParams(num_warps=_BLOCK // 32),
        )(*[moments] * 60, *chains, *tables)
    x0, x1, x2, value, b0, b1, b2, best_value = (a[:, :count] for a in after)
    return jnp.stack([x0, x1, x2]), value, jnp.stack([b0, b1, b2]), best_value

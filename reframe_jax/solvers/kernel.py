"""The whole search of a problem as one GPU kernel.

A GPU's arithmetic waits for memory, and the search, run operation by operation, reads and writes its
values some thousand times. Here every thread loads the 60 moments of one problem once, takes one chain
of :class:`BasinHopping` through its steps in registers, and writes eight numbers. The step and the local
minimizer are the functions that the search uses elsewhere, ``transition`` and ``descend`` of
:class:`ValleySteps`, and so are the random numbers; only the order in memory differs, and the rounding.
"""

from collections.abc import Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp

from reframe_jax.compilation import inside_a_kernel
from reframe_jax.geometry.symmetric import Vector
from reframe_jax.solvers.transition import Chains, Coordinates, transition
from reframe_jax.solvers.valley_steps import descend

__all__ = ["step_chains"]

_BLOCK = 128  # problems in a block, one to a thread


def step_chains(
    moments: jax.Array,
    low: jax.Array,
    high: jax.Array,
    hop: jax.Array,
    chains: Chains,
    jumps: jax.Array,
    rises: jax.Array,
    *,
    steps: int,
    hops: int,
    interpret: bool = False,
) -> Chains:
    """Make some steps of every chain of every problem.

    Args:
        moments: (6, 10, N), see :mod:`reframe_jax.objectives.moments`.
        low: (3,) faces of the box, m.
        high: (3,) faces of the box, m.
        hop: steps made so far.
        chains: unknowns (3, R, N), m, and values (R, N), log J.
        jumps: (S, 3, R) jump of every step, m.
        rises: (S, R) largest rise of log J that a step accepts.
        steps: local steps after every jump.
        hops: jumps of a chain; steps after them start from the best.
        interpret: run without a GPU, slowly, for tests.

    Returns:
        The chains after these steps.
    """
    from jax.experimental import pallas as pl  # slow to import, and of no use on a CPU
    from jax.experimental.pallas import triton

    total, _, restarts = jumps.shape
    count = moments.shape[2]
    blocks = -(-count // _BLOCK)
    columns = [*chains.x, chains.value, *chains.best_x, chains.best_value]
    if count % _BLOCK:  # the last problem fills the last block
        fill = jnp.minimum(jnp.arange(blocks * _BLOCK), count - 1)
        moments, columns = moments[:, :, fill], [a[:, fill] for a in columns]
    tables = [table.reshape(-1) for table in (low, high, hop, jumps, rises)]

    def chain(*refs: Any) -> None:
        values, start, outputs = [ref[...] for ref in refs[:60]], refs[60:68], refs[73:]
        low, high, first, jumps, rises = refs[68:73]
        r = pl.program_id(1)
        coefficients = [values[10 * i : 10 * i + 10] for i in range(6)]
        faces = cast(Vector, tuple(low[a] for a in range(3))), cast(Vector, tuple(high[a] for a in range(3)))

        def minimise(x: Coordinates) -> tuple[Vector, jax.Array]:
            found, determinant = descend(coefficients, *faces, cast(Vector, x), steps)
            return found, jnp.log(determinant) / 6

        def step(s: Any, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
            """One body for the first minimization, the hops and the polishing: it is compiled once."""
            after = transition(
                _as_chains(carry),
                first[0] + s,
                hops,
                jump=tuple(jumps[(s * 3 + a) * restarts + r] for a in range(3)),
                rise=rises[s * restarts + r],
                low=faces[0],
                high=faces[1],
                descend=minimise,
            )
            return (*after.x, after.value, *after.best_x, after.best_value)

        after = jax.lax.fori_loop(0, total, step, tuple(ref[...] for ref in start))
        for ref, new in zip(outputs, after, strict=True):
            ref[...] = new

    of_problem = [
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
            in_specs=[*of_problem, *[of_chain] * 8, *whole],
            out_specs=[of_chain] * 8,
            out_shape=[out] * 8,
            interpret=interpret,
            compiler_params=None if interpret else triton.CompilerParams(num_warps=_BLOCK // 32),
        )(*[moments] * 60, *columns, *tables)
    x, value, best_x, best_value = _as_chains([a[:, :count] for a in after])
    return Chains(jnp.stack(x), value, jnp.stack(best_x), best_value)


def _as_chains(columns: Sequence[jax.Array]) -> Chains:
    """Chains from their eight arrays, the coordinates one by one."""
    return Chains(tuple(columns[:3]), columns[3], tuple(columns[4:7]), columns[7])

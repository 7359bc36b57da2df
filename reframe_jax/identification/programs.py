"""Compiled programs that identify: of a batch, of the chunks of a piece, of one recording.

On a processor, a window passes two programs. The first reduces it to its evidence; the second, the large one,
is the same for windows of all lengths. The first time, they are compiled side by side.
"""

import contextlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.compilation import (
    Packed,
    chunk_size,
    compiler_options,
    in_float64,
    pack,
    unpack,
    with_kernels,
)
from reframe_jax.identification.classify import Thresholds
from reframe_jax.identification.evidence import Evidence, LagRule, reduce_windows
from reframe_jax.identification.pipeline import identify_windows, solve_evidence
from reframe_jax.identification.results import Identification
from reframe_jax.identification.widening import SearchSpace
from reframe_jax.motion.kinematics import Discretization
from reframe_jax.solvers import Solver

__all__ = ["PIECE", "identify_chunks", "identify_compiled", "identify_flat", "identify_one", "reduce_one"]

PIECE = 8  # chunks that one thread computes in one call

_begun: set[Any] = set()  # kinds of programs that have been compiled, or are being


def identify_flat(
    poses: jax.Array,
    steps: jax.Array,
    lag: jax.Array | None,
    thresholds: Thresholds | None,
    space: SearchSpace,
    key: jax.Array | None,
    *,
    rule: LagRule,
    exponent: float,
    discretization: Discretization,
    solver: Solver,
) -> Identification:
    """Identify (..., K+1, 4, 4) poses, chunk by chunk."""
    key = jax.random.key(0) if key is None else key
    batch, shared = poses.shape[:-3], steps.ndim == 1
    flat = poses.reshape(-1, *poses.shape[-3:])
    steps = steps.astype(poses.dtype)
    steps = steps if shared else steps.reshape(-1, steps.shape[-1])
    lag = None if lag is None else jnp.broadcast_to(lag, batch).reshape(-1)

    def of_windows(poses: jax.Array, steps: jax.Array, lag: jax.Array | None) -> Identification:
        options = thresholds, space, key, rule, exponent, discretization, solver
        return identify_windows(poses, steps, None, lag, *options)

    count, chunk = flat.shape[0], chunk_size()
    if count <= chunk:
        found = of_windows(flat, steps, lag)
    else:
        chunks = -(-count // chunk)
        split = (flat, None if shared else steps, lag)
        if chunks * chunk > count:  # the last window fills the last chunk
            fill = np.minimum(np.arange(chunks * chunk), count - 1)
            split = jax.tree.map(lambda a: a[fill], split)
        split = jax.tree.map(lambda a: a.reshape(chunks, chunk, *a.shape[1:]), split)
        found = jax.lax.map(lambda part: of_windows(part[0], steps if shared else part[1], part[2]), split)
        found = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:count], found)
    return jax.tree.map(lambda a: a.reshape(*batch, *a.shape[1:]), found)


def _solve_evidence(
    evidence: Evidence,
    thresholds: Thresholds | None,
    space: SearchSpace,
    key: jax.Array | None,
    *,
    rule: LagRule,
    exponent: float,
    solver: Solver,
) -> Identification:
    key = jax.random.key(0) if key is None else key
    return solve_evidence(evidence, thresholds, space, key, rule, exponent, solver)


@with_kernels
def _reduce_first(*arguments: Any, **static: Any) -> tuple[Packed, jax.Array]:
    """Evidence of a single window, and which of its poses count, (K+1,)."""
    evidence = reduce_windows(*arguments, **static)
    # of one length for all
    return pack(replace(evidence, counted=jnp.ones((1, 1), bool))), evidence.counted[0]


@with_kernels
def _solve_first(evidence: Packed, *others: Any, **static: Any) -> Identification:
    """Of the only window."""
    return jax.tree.map(lambda leaf: leaf[0], _solve_evidence(unpack(evidence), *others, **static))


@with_kernels
def _reduce_each_chunk(
    poses: jax.Array,
    steps: jax.Array,
    lag: jax.Array | None,
    *,
    rule: LagRule,
    discretization: Discretization,
) -> Evidence:
    """Evidence of (N, K+1, 4, 4) poses with an axis of chunks in front, as many as a piece has.

    A single chunk is repeated, so that one program solves few windows and many.
    """
    shared, chunks = steps.ndim == 1, len(poses) // chunk_size()
    steps = steps.astype(poses.dtype)
    one_lag = lag is None or lag.ndim == 0
    split = poses, None if shared else steps, None if one_lag else lag
    split = jax.tree.map(lambda a: a.reshape(chunks, -1, *a.shape[1:]), split)

    def reduce(part: tuple[jax.Array, jax.Array | None, jax.Array | None]) -> Evidence:
        own = steps if part[1] is None else part[1], None, lag if part[2] is None else part[2]
        return reduce_windows(part[0], *own, rule, discretization)

    evidence = jax.lax.map(reduce, split)
    if chunks == PIECE:
        return evidence
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (PIECE, *leaf.shape[1:])), evidence)


@with_kernels
def _solve_each_chunk(evidence: Evidence, chunks: jax.Array, *others: Any, **static: Any) -> Identification:
    """Identification of every window of the first chunks; those that follow are filled with zeros."""

    @jax.jit  # to be traced once for its shapes and the loop
    def solve(part: Evidence) -> Identification:
        return _solve_evidence(part, *others, **static)

    def chunk(i: jax.Array) -> Evidence:
        return jax.tree.map(partial(jax.lax.dynamic_index_in_dim, index=i, keepdims=False), evidence)

    def put(i: jax.Array, found: Identification) -> Identification:
        into = partial(jax.lax.dynamic_update_index_in_dim, index=i, axis=0)
        return jax.tree.map(into, found, solve(chunk(i)))

    shapes = jax.eval_shape(solve, chunk(jnp.int32(0)))
    nothing = jax.tree.map(lambda leaf: jnp.zeros((PIECE, *leaf.shape), leaf.dtype), shapes)
    found = jax.lax.fori_loop(0, chunks, put, nothing)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), found)


def identify_one(
    poses: Any,
    steps: Any,
    count: Any,
    lag: Any,
    *others: Any,
    rule: LagRule,
    exponent: float,
    discretization: Discretization,
    solver: Solver,
) -> Identification:
    """Identify the only window of (1, K+1, 4, 4) poses; ``count``, (1,), of them, if it is not None."""
    reduce = partial(reduce_one, poses, steps, count, lag, rule=rule, discretization=discretization)
    solve = partial(solve_one, rule=rule, exponent=exponent, solver=solver)
    with _compiling(solve, reduce, lambda reduced: (reduced[0], *others)):
        evidence, counted = reduce()
    return replace(solve(evidence, *others), counted=counted)


def identify_chunks(
    poses: Any,
    steps: Any,
    lag: Any,
    *others: Any,
    rule: LagRule,
    exponent: float,
    discretization: Discretization,
    solver: Solver,
) -> Identification:
    """Identify the (N, K+1, 4, 4) poses of one chunk or of a piece, as :func:`identify_flat` does.

    Returns:
        The identification of as many windows as a piece has, of which the first N are those of the poses.
    """
    reduce = partial(_reduce_chunks, poses, steps, lag, rule=rule, discretization=discretization)
    solve = partial(_solve_chunks, rule=rule, exponent=exponent, solver=solver)

    def arguments(evidence: Evidence) -> tuple[Any, ...]:
        if evidence.maps is None:  # of one length for all
            every: Any = np.ones((*evidence.counted.shape[:2], 1), bool)
            evidence = replace(evidence, counted=every)
        return evidence, np.int32(len(poses) // chunk_size()), *others

    with _compiling(solve, reduce, arguments):
        evidence = reduce()
    found, counted = solve(*arguments(evidence)), evidence.counted
    return replace(found, counted=counted.reshape(-1, counted.shape[-1]) & found.counted)


@contextlib.contextmanager
def _compiling(solve: Any, reduce: Any, arguments: Callable[[Any], tuple[Any, ...]]) -> Iterator[None]:
    """While poses are reduced for the first time, compile the program that solves in another thread.

    Args:
        solve: the program, partial with what is static of its arguments.
        reduce: the program that comes before, partial with all its arguments.
        arguments: of the former, from the results of the latter, or from their shapes.
    """
    precise = in_float64()  # JAX's settings belong to a thread
    kind = solve.func, precise, reduce.args[0].dtype, *reduce.keywords.values(), *solve.keywords.values()
    # arrays that a device was chosen for need a program that their shapes do not tell
    if kind in _begun or getattr(reduce.args[0], "committed", False):
        yield
        return
    _begun.add(kind)
    shapes = reduce.func.eval_shape(*reduce.args, **reduce.keywords)

    def compile_solver() -> None:
        with jax.enable_x64(precise):
            solve.func.lower(*arguments(shapes), **solve.keywords).compile()

    with ThreadPoolExecutor(1) as thread:
        thread.submit(compile_solver)  # what is wrong with it, the call of the program says
        yield


_STATIC = ("rule", "exponent", "discretization", "solver")
identify_compiled = jax.jit(identify_flat, static_argnames=_STATIC)
_on_cpu = partial(jax.jit, compiler_options=compiler_options("cpu"))
_reduce_chunks = _on_cpu(_reduce_each_chunk, static_argnames=("rule", "discretization"))
_solve_chunks = _on_cpu(_solve_each_chunk, static_argnames=("rule", "exponent", "solver"))
# of a single window: machine code that is optimised less compiles sooner and is as fast
_for_one = partial(jax.jit, compiler_options=compiler_options(single=True))
reduce_one = _for_one(_reduce_first, static_argnames=("rule", "discretization"))
solve_one = _for_one(_solve_first, static_argnames=("rule", "exponent", "solver"))

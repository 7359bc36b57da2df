"""Helpers for JAX's transformations and compiled programs."""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

__all__ = ["BLOCK_DIVISOR", "in_float64", "index_leaves", "join_parts", "traced", "update_marked"]

_BLOCK = 8  # smallest number of problems per block
BLOCK_DIVISOR = 16
"""A block contains all problems divided by this number, or ``_BLOCK`` problems if that is more."""

_T = TypeVar("_T")


def in_float64() -> bool:
    """Whether JAX computes in float64 in this thread."""
    return bool(jax.dtypes.canonicalize_dtype(np.float64) == np.float64)


def update_marked(
    function: Callable[[Any], Any], marked: jax.Array, inputs: Any, outputs: Any, divisor: int = BLOCK_DIVISOR
) -> Any:
    """Recompute the outputs of marked problems in full blocks; unmarked problems cost no time.

    Args:
        function: function from the inputs of a block of problems to their outputs.
        marked: (N,) bool.
        inputs: pytree of arrays (..., N).
        outputs: pytree of arrays (..., N), in the format of ``function``.
        divisor: a block contains the number of problems divided by this number, and at least eight problems.

    Returns:
        The outputs, with new values for the marked problems.
    """
    problems = marked.size
    if problems == 1:
        return jax.lax.cond(marked[0], lambda new, _: function(new), lambda _, old: old, inputs, outputs)
    size = max(min(problems, _BLOCK), problems // divisor)
    order, count = jnp.argsort(~marked), jnp.sum(marked)  # marked problems first, in their order

    def block(i: jax.Array, outputs: Any) -> Any:
        # depends on i: for a single problem, XLA would detect equal blocks and compute them unconditionally
        i, of_all = jax.lax.optimization_barrier((i, inputs))
        place = i * size + jnp.arange(size)
        rows = order[jnp.minimum(place, problems - 1)]
        found = function(jax.tree.map(lambda a: jnp.take(a, rows, axis=-1), of_all))
        target = jnp.where(place < count, rows, problems)  # drops the rows of unmarked problems
        return jax.tree.map(lambda old, new: old.at[..., target].set(new, mode="drop"), outputs, found)

    return jax.lax.fori_loop(0, (count + size - 1) // size, block, outputs)


def traced(tree: Any) -> bool:
    """Whether any array of a pytree is a tracer: the caller is under a JAX transformation."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def index_leaves(tree: _T, index: Any) -> _T:
    """Index every leaf of a pytree like an array.

    One program takes a row, or consecutive rows, from all JAX arrays. Separate indexing would compile one
    program per shape and dtype.
    """
    leaves = jax.tree.leaves(tree)
    together = all(isinstance(leaf, jax.Array) and leaf.ndim for leaf in leaves)
    lengths = {leaf.shape[0] for leaf in leaves} if together else set()
    if len(lengths) == 1:
        if isinstance(index, int | np.integer) and not isinstance(index, bool):
            return _take_row(tree, index)
        if isinstance(index, slice):
            start, stop, step = index.indices(lengths.pop())
            if step == 1:
                return _take_rows(tree, start, max(0, stop - start))
    return jax.tree.map(lambda leaf: leaf[index], tree)


def join_parts(parts: list[_T], count: int) -> _T:
    """Concatenate parts along the first axis of their leaves, and keep the first ``count`` rows."""
    if len(parts) == 1:
        return (
            parts[0] if len(jax.tree.leaves(parts[0])[0]) == count else index_leaves(parts[0], slice(count))
        )
    if jax.default_backend() == "cpu":  # NumPy needs no program for each number of parts
        parts = jax.device_get(parts)
        return jax.tree.map(lambda *leaves: jnp.asarray(np.concatenate(leaves)[:count]), *parts)
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:count], *parts)


@jax.jit
def _take_row(tree: _T, row: jax.Array) -> _T:
    return jax.tree.map(lambda leaf: jax.lax.dynamic_index_in_dim(leaf, row, keepdims=False), tree)


@partial(jax.jit, static_argnums=2)
def _take_rows(tree: _T, start: jax.Array, count: int) -> _T:
    return jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, start, count), tree)

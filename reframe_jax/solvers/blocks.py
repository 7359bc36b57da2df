"""Computation on a marked subset of many problems."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

__all__ = ["update_marked"]

_BLOCK, _SHARE = 8, 16  # problems are worked on by the eight, or by a sixteenth of all


def update_marked(function: Callable[[Any], Any], marked: jax.Array, inputs: Any, outputs: Any) -> Any:
    """Replace what belongs to the marked problems, gathered into full blocks; the others cost nothing.

    Args:
        function: from the inputs of a block of problems to their outputs.
        marked: (N,) bool.
        inputs: pytree of arrays (..., N).
        outputs: pytree of arrays (..., N), as the function returns it.

    Returns:
        The outputs, new where marked.
    """
    problems = marked.size
    size = max(min(problems, _BLOCK), problems // _SHARE)
    order, count = jnp.argsort(~marked), jnp.sum(marked)  # the marked first, as they come

    def block(i: jax.Array, outputs: Any) -> Any:
        # tied to i: of a single problem XLA would see that every block is the same, and compute it anyway
        i, of_all = jax.lax.optimization_barrier((i, inputs))
        place = i * size + jnp.arange(size)
        rows = order[jnp.minimum(place, problems - 1)]
        found = function(jax.tree.map(lambda a: jnp.take(a, rows, axis=-1), of_all))
        target = jnp.where(place < count, rows, problems)  # those of problems not marked are dropped
        return jax.tree.map(lambda old, new: old.at[..., target].set(new, mode="drop"), outputs, found)

    return jax.lax.fori_loop(0, (count + size - 1) // size, block, outputs)

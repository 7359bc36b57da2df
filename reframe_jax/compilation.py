"""How the small algebra of many problems is compiled.

The search is a few hundred elementwise operations on arrays over problems. Left alone, XLA on a CPU
fuses them into loops of which each computes what it needs from scratch, a Hessian once for every
component of every step that reads it: most of the time goes into repetition. :func:`once` marks the
values that are to be computed once and stored. XLA drops such marks before it fuses, unless told not to
by :data:`CPU_OPTIONS`. On a GPU they are dropped, which is right there: recomputing beats memory.
"""

from typing import Any, TypeVar

import jax

__all__ = ["CPU_OPTIONS", "chunk_size", "once", "traced"]

CPU_OPTIONS: dict[str, Any] = {
    "xla_disable_hlo_passes": "cse_barrier_expander",  # the pass that drops the marks of once()
    "xla_cpu_prefer_vector_width": 512,  # where there is AVX-512; otherwise it changes nothing
    "xla_cpu_use_fusion_emitters": False,  # the older code generator compiles twice as fast
}
"""``compiler_options`` of ``jax.jit`` for identification on a CPU.

JAX takes them from the outermost ``jit`` only: give them to yours if you call ``identify`` inside one.
"""

_T = TypeVar("_T")

_CHUNK = {"cpu": 32, "gpu": 16384}


def chunk_size() -> int:
    """Windows worked on at once: on a CPU so few that a core's first cache holds them, on a GPU many."""
    return _CHUNK.get(jax.default_backend(), 1024)


def once(values: _T) -> _T:
    """Compute the arrays of a pytree once, however many operations read them."""
    return jax.lax.optimization_barrier(values)


def traced(tree: Any) -> bool:
    """Whether any array of a pytree is a tracer, that is, the caller is being transformed."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))

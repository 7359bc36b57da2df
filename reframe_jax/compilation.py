"""How the small algebra of many problems is compiled.

The search is a few hundred elementwise operations on arrays over problems. Left alone, XLA on a CPU
fuses them into loops of which each computes what it needs from scratch, a Hessian once for every
component of every step that reads it: most of the time goes into repetition. :func:`once` marks the
values that are to be computed once and stored. On a CPU XLA drops such marks before it fuses, unless told
not to by :func:`compiler_options`; on a GPU it fuses first.

The loops that are left are many and short, and on a CPU starting one costs as much as running it. In our own
programs :func:`as_one_kernel` compiles a whole search or decision to one. Where a GPU's memory is the limit,
the arithmetic is in kernels of our own, in which values stay in registers.
"""

import contextlib
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial, wraps
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.scheduling_groups import xla_metadata_call

from reframe_jax.arrays import put, tracing, using_numpy

__all__ = [
    "BLOCK_SHARE",
    "Packed",
    "apply_each",
    "as_one_kernel",
    "backend",
    "chunk_size",
    "compiler_options",
    "in_float64",
    "index_leaves",
    "inside_a_kernel",
    "once",
    "once_on_cpu",
    "pack",
    "traced",
    "unpack",
    "with_kernels",
]

_CPU_OPTIONS: dict[str, Any] = {
    "xla_disable_hlo_passes": "cse_barrier_expander",  # the pass that drops the marks of once()
    "xla_cpu_experimental_ynn_fusion_type": "",  # a library's sums, which cost more than they save here
    "xla_cpu_prefer_vector_width": 512,  # where there is AVX-512; otherwise it changes nothing
}
if jax.__version_info__ < (0, 11):
    # the older of two code generators compiles twice as fast; jax 0.11 has one only
    _CPU_OPTIONS["xla_cpu_use_fusion_emitters"] = False

_LEVEL = "xla_backend_optimization_level"
_BLOCK = 8  # marked problems are worked on by the eight
BLOCK_SHARE = 16
"""Or by this part of all."""

_T = TypeVar("_T")
_LARGE = 1 << 18  # numbers

_CHUNK = {"cpu": 64, "gpu": 65536}


def compiler_options(platform: str | None = None, single: bool = False) -> dict[str, Any]:
    """``compiler_options`` of ``jax.jit`` for identification.

    JAX takes them from the outermost ``jit`` only: give them to yours if you call ``identify`` inside one.

    Args:
        platform: ``"cpu"``, ``"gpu"``; by default that of JAX's default device.
        single: whether the program is for a single window. Its arrays are short, so that machine code that
            LLVM optimises less is as fast, and compiles sooner. A level that ``XLA_FLAGS`` names wins.
    """
    if (platform or jax.default_backend()) != "cpu":
        return {}
    level_chosen = _LEVEL in os.environ.get("XLA_FLAGS", "")
    return {**_CPU_OPTIONS, **({_LEVEL: 1} if single and not level_chosen else {})}


def chunk_size() -> int:
    """Windows worked on at once: on a CPU so few that a core's own caches hold them, on a GPU many."""
    return _CHUNK.get(jax.default_backend(), 1024)


def backend() -> str:
    """What computes here: "cpu", also with NumPy, "gpu" or another of JAX's."""
    return "cpu" if using_numpy() else jax.default_backend()


def in_float64() -> bool:
    """Whether JAX computes in float64, in this thread."""
    return bool(jax.dtypes.canonicalize_dtype(np.float64) == np.float64)


def once(values: _T) -> _T:
    """Compute the arrays of a pytree once, however many operations read them."""
    if tracing.value == "gpu" or using_numpy():
        return values
    if tracing.value != "kernel":
        return jax.lax.optimization_barrier(values)
    # a kernel has no place for marks; results of a function that is called are stored too
    leaves, structure = jax.tree.flatten(values)
    stored: _T = jax.tree.unflatten(structure, _stored(*leaves))
    return stored


def once_on_cpu(values: _T) -> _T:
    """:func:`once` on a CPU; on a GPU XLA may fuse what computes the values with what reads them."""
    return once(values) if backend() == "cpu" else values


def apply_each(function: Callable[[Any], Any], items: Sequence[Any]) -> list[Any]:
    """Apply an elementwise function to pytrees of one shape, stacked so that it is compiled once for all.

    In a GPU kernel, which holds no stacks, and with NumPy it is applied to one after the other.
    """
    if tracing.value == "gpu" or using_numpy():
        return [function(item) for item in items]
    stacked = once(jax.tree.map(lambda *leaves: jnp.stack(leaves), *items))
    found = once(jax.vmap(function)(stacked))
    return [jax.tree.map(lambda leaf, i=i: leaf[i], found) for i in range(len(items))]


def with_kernels(function: Callable[..., _T]) -> Callable[..., _T]:
    """Let :func:`as_one_kernel` make kernels, where the function is traced for a CPU.

    For programs that nobody differentiates or vectorizes: operations that this brings may not be allowed in
    a kernel.
    """

    @wraps(function)
    def program(*arguments: Any, **static: Any) -> _T:
        if jax.default_backend() != "cpu":
            return function(*arguments, **static)
        with tracing("program"):
            return function(*arguments, **static)

    return program


def as_one_kernel(function: Callable[..., _T], *arguments: Any, most: int = _LARGE) -> _T:
    """Call a function of pytrees of arrays; within :func:`with_kernels` all of it is one kernel.

    XLA on a CPU starts a kernel for every loop over arrays. That takes a tenth of a microsecond, longer than
    the arithmetic of a few hundred numbers. Large arrays, over which XLA spreads several threads, stay as
    they are.

    Args:
        function: of elementwise operations, reductions and loops, without sort, scatter or matrix product.
            All its arrays are arguments.
        arguments: pytrees of arrays.
        most: numbers that the largest of them may have.
    """
    large = max(leaf.size for leaf in jax.tree.leaves(arguments)) > most
    if tracing.value != "program" or large:
        return function(*arguments)

    def kernel(*arguments: Any) -> tuple[_T, tuple[Any, ...]]:
        with tracing("kernel"):
            # XLA ends the process over an argument that a kernel does not use: all are returned too
            return function(*arguments), arguments

    return _called(kernel, xla_cpu_small_call="true")(*arguments)[0]


def _called(function: Callable[..., _T], **attributes: str) -> Callable[..., _T]:
    """The function as one that XLA calls, where by default it would put its operations in place."""
    return cast(Callable[..., _T], xla_metadata_call(function, inlineable="false", **attributes))


_stored = _called(lambda *leaves: leaves)


def update_marked(
    function: Callable[[Any], Any], marked: jax.Array, inputs: Any, outputs: Any, share: int = BLOCK_SHARE
) -> Any:
    """Replace what belongs to the marked problems, gathered into full blocks; the others cost nothing.

    Args:
        function: from the inputs of a block of problems to their outputs.
        marked: (N,) bool.
        inputs: pytree of arrays (..., N).
        outputs: pytree of arrays (..., N), as the function returns it.
        share: of the problems that a block holds: one part of so many, and eight problems at least.

    Returns:
        The outputs, new where marked.
    """
    if using_numpy():
        if not np.any(marked):
            return outputs
        found = function(jax.tree.map(lambda leaf: leaf[..., marked], inputs))
        return jax.tree.map(lambda old, new: put(old, (..., marked), new), outputs, found)
    problems = marked.size
    if problems == 1:
        return jax.lax.cond(marked[0], lambda new, _: function(new), lambda _, old: old, inputs, outputs)
    size = max(min(problems, _BLOCK), problems // share)
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


def inside_a_kernel() -> contextlib.AbstractContextManager[None]:
    """While a GPU kernel is traced: all its values live in registers, and :func:`once` has no place."""
    return cast(contextlib.AbstractContextManager[None], tracing("gpu"))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Packed:
    """A pytree of arrays, of one vector for every dtype; see :func:`pack`."""

    vectors: dict[str, jax.Array]
    structure: Any = field(metadata={"static": True})


def pack(tree: Any) -> Packed:
    """Put the arrays of a pytree together: every array that leaves a program takes a microsecond or two."""
    leaves, structure = jax.tree.flatten(tree)
    shapes = tuple((leaf.dtype.name, leaf.shape) for leaf in leaves)
    vectors = {
        dtype: jnp.concatenate([leaf.reshape(-1) for leaf in leaves if leaf.dtype.name == dtype])
        for dtype in sorted({dtype for dtype, _ in shapes})
    }
    return Packed(vectors, (structure, shapes))


def unpack(packed: Packed) -> Any:
    """The pytree that was packed."""
    structure, shapes = packed.structure
    start, leaves = dict.fromkeys(packed.vectors, 0), []
    for dtype, shape in shapes:
        end = start[dtype] + math.prod(shape)
        leaves.append(packed.vectors[dtype][start[dtype] : end].reshape(shape))
        start[dtype] = end
    return jax.tree.unflatten(structure, leaves)


def traced(tree: Any) -> bool:
    """Whether any array of a pytree is a tracer, that is, the caller is being transformed."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def index_leaves(tree: _T, index: Any) -> _T:
    """Index every leaf of a pytree like an array.

    One program takes a row, or consecutive rows, from all JAX arrays, instead of one program for every shape
    and dtype.
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


@jax.jit
def _take_row(tree: _T, row: jax.Array) -> _T:
    return jax.tree.map(lambda leaf: jax.lax.dynamic_index_in_dim(leaf, row, keepdims=False), tree)


@partial(jax.jit, static_argnums=2)
def _take_rows(tree: _T, start: jax.Array, count: int) -> _T:
    return jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, start, count), tree)

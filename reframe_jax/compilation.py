"""Helpers for JAX's transformations and compiled programs."""

import os
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.program_cache import can_keep, load_or_export, platform_of

_T = TypeVar("_T")
_LEVEL = "xla_backend_optimization_level"
OLD_EMITTERS = jax.__version_info__ < (0, 11)
COMPILER_OPTIONS: dict[str, int | bool] = {"xla_cpu_use_fusion_emitters": False} if OLD_EMITTERS else {}
COMPILER_OPTIONS |= {} if _LEVEL in os.environ.get("XLA_FLAGS", "") else {_LEVEL: 2}
"""Options of ``jax.jit`` for large programs outside of a trace; a level in ``XLA_FLAGS`` wins.

On a CPU, programs compile in less than half the time (``python -m benchmarks.first_answer``), and are about
as fast. jax 0.11 cannot select the older code generator for a single program; the environment variable
``XLA_FLAGS=--xla_backend_extra_options=xla_cpu_disable_new_fusion_emitters`` does so for all programs.
"""


class Program:
    """A large function, compiled for calls outside of a trace, with the options above.

    It is kept between processes, see :func:`reframe_jax.cache_programs`. Static arguments are given by name.
    For calls inside of a trace, where JAX does not allow these options, there is ``in_trace``.
    """

    def __init__(self, function: Callable[..., Any], static: tuple[str, ...]) -> None:
        self.function = function
        self.in_trace = jax.jit(function, static_argnames=static)
        self.jitted = jax.jit(function, static_argnames=static, compiler_options=COMPILER_OPTIONS)
        self._kept: dict[Any, tuple[Callable[..., Any], Any]] = {}

    def __call__(self, *arguments: Any, **static: Any) -> Any:
        """Call the program for these shapes, compiled before or now."""
        if not can_keep(static):
            return self.jitted(*arguments, **static)
        leaves, tree = jax.tree.flatten(arguments)
        leaves = _unbound(leaves)
        shapes = tuple((leaf.shape, leaf.dtype) for leaf in leaves)
        key = tree, shapes, platform_of(leaves), tuple(sorted(static.items()))
        if key not in self._kept:
            call, result = load_or_export(self.function, arguments, static)
            self._kept[key] = jax.jit(call, compiler_options=COMPILER_OPTIONS), jax.tree.structure(result)
        call, structure = self._kept[key]
        return jax.tree.unflatten(structure, call(*leaves))


def _unbound(leaves: list[Any]) -> list[Any]:
    """Return arrays that are bound to the default CPU device as NumPy arrays, without a copy.

    The results of kept programs are bound ("committed") to a device, other arrays are not. JAX would compile
    a program of results once for each case.
    """
    if jax.config.jax_default_device is not None or jax.default_backend() != "cpu":  # type: ignore[attr-defined]
        return leaves
    usual = {jax.devices()[0]}
    return [
        np.asarray(leaf)
        if isinstance(leaf, jax.Array)
        and leaf.committed
        and leaf.devices() == usual
        and not jnp.issubdtype(leaf.dtype, jax.dtypes.extended)
        else leaf
        for leaf in leaves
    ]


def in_float64() -> bool:
    """Whether JAX computes in float64 in this thread."""
    return bool(jax.dtypes.canonicalize_dtype(np.float64) == np.float64)


def narrow(tree: _T) -> _T:
    """Return JAX arrays with at most 32 bits, or at most 64 if JAX computes with 64 bits in this thread.

    NumPy arrays become JAX arrays without a program, of which JAX would compile one for every shape.
    """
    leaves = jax.tree.leaves(tree)
    if all(isinstance(leaf, np.ndarray) for leaf in leaves):
        return jax.device_put(tree)
    if in_float64() or all(leaf.dtype.itemsize < 8 for leaf in leaves):
        return tree
    with jax.enable_x64(True):
        return _narrowed(tree)


@jax.jit
def _narrowed(tree: _T) -> _T:
    narrower = {"float64": np.float32, "int64": np.int32}
    return jax.tree.map(lambda a: a.astype(narrower.get(a.dtype.name, a.dtype)), tree)


def traced(tree: Any) -> bool:
    """Return whether any array of a pytree is a tracer: the caller is under ``jit``, ``vmap`` or ``grad``."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def inside_trace(tree: Any) -> bool:
    """Return whether results computed from a pytree are tracers.

    Constants in a function that is traced are no tracers, but what is computed from them is one.
    """
    return traced((tree, jnp.asarray(0.0)))


def index_leaves(tree: _T, index: Any) -> _T:
    """Apply an index to the first axes of every array of a pytree.

    NumPy indexes JAX arrays on a CPU, because JAX would compile a program for every shape and dtype. On a
    GPU, one program indexes all arrays for a single row or consecutive rows.

    Raises:
        IndexError: for a row that does not exist, which a compiled program would replace with the last one.
    """
    leaves = jax.tree.leaves(tree)
    together = all(isinstance(leaf, jax.Array) and leaf.ndim for leaf in leaves)
    lengths = {leaf.shape[0] for leaf in leaves} if together else set()
    length = lengths.pop() if len(lengths) == 1 else None
    row = isinstance(index, int | np.integer) and not isinstance(index, bool)
    if row and length is not None and not -length <= index < length:
        raise IndexError(f"There is no row {index}: the arrays have {length} rows.")
    if together and not traced((tree, index)) and all(map(_on_one_cpu, leaves)):
        with jax.enable_x64(True):  # the dtypes remain
            return jax.device_put(jax.tree.map(lambda leaf: np.asarray(leaf)[index], tree))
    if row and length is not None:
        return _take_row(tree, index)
    if isinstance(index, slice) and length is not None:
        start, stop, step = index.indices(length)
        if step == 1:
            return _take_rows(tree, start, max(0, stop - start))
    return jax.tree.map(lambda leaf: leaf[index], tree)


def _on_one_cpu(array: jax.Array) -> bool:
    return [device.platform for device in array.devices()] == ["cpu"]


@jax.jit
def _take_row(tree: _T, row: jax.Array) -> _T:
    return jax.tree.map(lambda leaf: jax.lax.dynamic_index_in_dim(leaf, row, keepdims=False), tree)


@partial(jax.jit, static_argnums=2)
def _take_rows(tree: _T, start: jax.Array, count: int) -> _T:
    return jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, start, count), tree)

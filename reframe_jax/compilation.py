"""Helpers for JAX's transformations and compiled programs."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial, wraps
from types import EllipsisType
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.program_cache import can_keep, load_or_export

_T = TypeVar("_T")
_Item = int | slice | EllipsisType | None | np.ndarray | jax.Array
Index = _Item | tuple[_Item, ...] | list[int]
"""An index of an array."""

OLD_EMITTERS = jax.__version_info__ < (0, 11)
_FASTER: dict[str, int | bool] = {"xla_backend_optimization_level": 2, "xla_gpu_enable_triton_gemm": False}
_FASTER |= {"xla_gpu_experimental_enable_fusion_autotuner": False}
_FASTER |= {"xla_cpu_use_fusion_emitters": False} if OLD_EMITTERS else {}
COMPILER_OPTIONS = {name: _FASTER[name] for name in _FASTER if name not in os.environ.get("XLA_FLAGS", "")}
"""Options of ``jax.jit`` for large programs outside of a trace; those in ``XLA_FLAGS`` win.

Programs compile in less than half the time on a CPU (``python -m benchmarks.first_answer``), and are about as
fast; on a GPU in two thirds of the time, and are 5 % slower. jax 0.11 on a CPU cannot select the older code
generator for one program: ``XLA_FLAGS=--xla_backend_extra_options=xla_cpu_disable_new_fusion_emitters``.
"""
_COMPILERS = ThreadPoolExecutor(os.cpu_count())
_shapes_of = partial(jax.eval_shape, lambda tree: tree)
PROGRAMS: dict[Any, Any] = {}  # may be emptied: programs are then compiled again


class Program:
    """A large function, compiled with the options above, and kept between processes by ``cache_programs``.

    Called with shapes (``jax.ShapeDtypeStruct``), it starts its compilation in a thread and returns the
    shapes of its results; see :func:`pipeline`. JAX does not allow these options inside of a trace, where
    the function is a part of the program that is traced. Static arguments are given by name.
    """

    def __init__(self, function: Callable[..., Any], static: tuple[str, ...]) -> None:
        @wraps(function)
        def precise(*arguments: Any, **static: Any) -> Any:
            with jax.default_matmul_precision("highest"):  # a GPU would round single precision to ten bits
                return function(*arguments, **static)

        self.function = precise
        self.in_trace = jax.jit(precise, static_argnames=static)
        self.elsewhere = jax.jit(precise, static_argnames=static, compiler_options=COMPILER_OPTIONS)

    def __call__(self, *arguments: Any, **static: Any) -> Any:
        """Call the program for these shapes, compiled before or now."""
        leaves, tree = jax.tree.flatten(arguments)
        if traced(leaves) or _are_elsewhere(leaves):
            return (self.in_trace if traced(leaves) else self.elsewhere)(*arguments, **static)
        key = self, *_key(leaves, tree, static)
        if key not in PROGRAMS:
            shapes, kept = _shapes_of(arguments), can_keep(static)
            run = load_or_export(self.function, shapes, static) if kept else partial(self.function, **static)
            lowered = jax.jit(run, compiler_options=COMPILER_OPTIONS).lower(*shapes)
            PROGRAMS[key] = _COMPILERS.submit(lowered.compile), _shapes_of(lowered.out_info)
        compiled, results = PROGRAMS[key]
        return results if isinstance(leaves[0], jax.ShapeDtypeStruct) else compiled.result()(*arguments)


def pipeline(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile the programs that a function calls side by side; it must compute nothing besides.

    Before its first call, the function is called with shapes. While a program is compiled in a thread, Python
    traces the next one, so the first answer comes in three quarters of the time.
    """

    @wraps(function)
    def call(*arguments: Any, **static: Any) -> Any:
        leaves, tree = jax.tree.flatten(arguments)
        key = function, *_key(leaves, tree, static)
        if not (key in PROGRAMS or traced(leaves) or _are_elsewhere(leaves)):
            function(*_shapes_of(arguments), **static)
            PROGRAMS[key] = None
        return function(*arguments, **static)

    return call


def _are_elsewhere(leaves: list[Any]) -> bool:
    """Whether arrays are bound to other devices than the first one."""
    bound = next((leaf for leaf in leaves if isinstance(leaf, jax.Array) and leaf.committed), None)
    return bound is not None and bound.devices() != {jax.devices()[0]}


def _key(leaves: list[Any], tree: Any, static: dict[str, Any]) -> Any:
    shapes = tuple((leaf.shape, leaf.dtype) for leaf in leaves)
    return tree, shapes, in_float64(), jax.config.jax_default_device, *sorted(static.items())  # type: ignore[attr-defined]


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


def index_leaves(tree: _T, index: Index) -> _T:
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

"""Compute functions of many small problems as GPU kernels, with one thread for every problem.

XLA computes a function of small vectors and matrices of many problems as hundreds of operations, each of
which reads and writes the components of all problems in memory. A kernel keeps them in the registers of
threads. The functions stay the same: they are traced for one problem, and every operation is then applied to
vectors over the problems of a block (:mod:`.components`). Kernels are written in Pallas on Mosaic, for GPUs
from Hopper on.
"""

from collections.abc import Callable
from contextvars import ContextVar
from functools import cache, partial, wraps
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from reframe_jax.geometry.components import Components, components

_T = TypeVar("_T")
_THREADS = 128  # of a block
_FIRST: dict[Any, float] = {jnp.add: 0.0, jnp.maximum: -np.inf}  # results without terms
_in_kernel = ContextVar("in_kernel", default=False)  # whether a function is traced for a kernel


def in_registers(function: Callable[..., _T], axes: int) -> Callable[..., _T]:
    """Make a function of many problems one that a GPU computes as a kernel.

    The arguments and the results are pytrees of arrays, with components first. The last ``axes`` axes are
    those of problems, which do not depend on each other. In an argument, each of them but the last may have
    the size 1; an argument may also be a scalar. The function is computed as it is on other processors, and
    where the size of the last axis is no multiple of 128.
    """

    @wraps(function)
    def computed(*arguments: Any) -> Any:
        number = max(leaf.shape[-1:] for leaf in jax.tree.leaves(arguments))[0]
        if not _has_kernels() or number % _THREADS:
            return function(*arguments)
        return lax.platform_dependent(*arguments, cuda=partial(call_kernel, function, axes), default=function)

    return computed


@cache
def _has_kernels() -> bool:
    device = jax.devices()[0]
    return device.platform == "gpu" and float(getattr(device, "compute_capability", "0")) >= 9


def added_up(function: Callable[..., _T], axes: tuple[Any, ...], joins: Any = jnp.add) -> Callable[..., _T]:
    """Make a function that adds up over an axis of some arguments one that a kernel computes term by term.

    ``axes`` has the axis of every argument, or a pytree of axes; -1 for arguments without it. The result for
    one entry of the axis is a term of the sum, or of a maximum where ``joins``, a pytree as the result, has
    jnp.maximum. Without this loop, the code of a kernel would be long, and the registers would not suffice.
    """

    @wraps(function)
    def computed(*arguments: Any) -> Any:
        if not _in_kernel.get():
            return function(*arguments)
        leaves, tree = jax.tree.flatten(arguments)
        along = jax.tree.leaves(jax.tree.broadcast(axes, arguments))

        def term(k: Any) -> Any:
            cut = partial(lax.dynamic_slice_in_dim, slice_size=1, allow_negative_indices=False)
            own = (a if axis < 0 else cut(a, k, axis=axis) for a, axis in zip(leaves, along, strict=True))
            return function(*jax.tree.unflatten(tree, own))

        number = next(a.shape[axis] for a, axis in zip(leaves, along, strict=True) if axis >= 0)
        shapes = jax.eval_shape(term, 0)
        each = jax.tree.broadcast(joins, shapes)
        nothing = jax.tree.map(lambda a, join: jnp.full(a.shape, _FIRST[join], a.dtype), shapes, each)

        def add(k: Any, found: Any) -> Any:
            return jax.tree.map(lambda join, one, other: join(one, other), each, found, term(k))

        return lax.fori_loop(0, number, add, nothing)

    return computed


def call_kernel(function: Callable[..., Any], axes: int, *arguments: Any) -> Any:
    """Compute a function as :func:`in_registers` does, on a GPU."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import mosaic_gpu as plgpu

    leaves = jax.tree.leaves(arguments)
    problems = np.broadcast_shapes(*(leaf.shape[-axes:] for leaf in leaves if leaf.ndim))
    program, results = trace_for_one(function, axes, *arguments)
    flat, structure = jax.tree.flatten(results)

    def body(*refs: Any) -> None:
        threads = pl.ds(lax.axis_index("block") * _THREADS, _THREADS)
        others = [lax.axis_index(f"axis_{k}") for k in range(axes - 1)]

        def load(ref: Any, shape: tuple[int, ...], index: tuple[Any, ...]) -> Any:
            if not shape:
                return ref[0]
            place = (other if size > 1 else 0 for other, size in zip(others, shape[-axes:-1], strict=True))
            return ref[(*index[:-axes], *place, threads)]

        inputs = [
            components(_of_one(leaf, axes), partial(load, ref, leaf.shape))
            for leaf, ref in zip(leaves, refs, strict=False)
        ]
        kernel = _Kernel((_THREADS,))
        values = kernel.run(program, inputs)
        for result, ref, value in zip(flat, refs[len(leaves) :], values, strict=True):
            for index in np.ndindex(*result.shape):
                vector = kernel.vector(kernel.loaded(value[index]), result.dtype)
                ref[(*index[:-axes], *others, threads)] = vector

    found = plgpu.kernel(
        body,
        out_type=[jax.ShapeDtypeStruct(r.shape[:-axes] + problems, r.dtype) for r in flat],
        grid=(problems[-1] // _THREADS, *problems[:-1]),
        grid_names=("block", *(f"axis_{k}" for k in range(axes - 1))),
        compiler_params=plgpu.CompilerParams(lowering_semantics=plgpu.LoweringSemantics.Lane),
    )(*(jnp.atleast_1d(leaf.astype(jnp.float32) if leaf.dtype == bool else leaf) for leaf in leaves))
    return jax.tree.unflatten(structure, found)


def trace_for_one(function: Callable[..., Any], axes: int, *arguments: Any) -> tuple[Any, Any]:
    """Trace a function for one problem: its jaxpr, and the shapes of its results."""
    token = _in_kernel.set(True)
    try:
        one = jax.tree.map(lambda leaf: _of_one(leaf, axes), arguments)
        program, results = jax.make_jaxpr(function, return_shape=True)(*one)
    finally:
        _in_kernel.reset(token)
    return program, results


def _of_one(leaf: Any, axes: int) -> jax.ShapeDtypeStruct:
    """Return the shape of an argument for one problem."""
    return jax.ShapeDtypeStruct((*leaf.shape[:-axes], *[1] * axes) if leaf.ndim else (), leaf.dtype)


class _Kernel(Components):
    """Components of the threads of a block."""

    def apply(self, primitive: Any, params: dict[str, Any], *operands: Any) -> Any:
        """Apply a primitive; Mosaic expresses some of them by others."""
        x, name = operands[0], primitive.name
        if name == "sqrt":
            return x * lax.rsqrt(jnp.maximum(x, jnp.finfo(x.dtype).tiny))
        if name == "log1p":
            more = 1 + x  # the rounding error of the sum cancels
            return jnp.where(more == 1, x, jnp.log(more) * x / (more - 1))
        if name == "atan":
            return lax.atan2(x, jnp.ones_like(x))
        if name == "is_finite":
            return jnp.abs(x) < jnp.inf
        if name == "convert_element_type" and x.dtype == bool:
            wanted = np.dtype(params["new_dtype"])
            return x if wanted == x.dtype else jnp.where(x, 1, 0).astype(wanted)
        return super().apply(primitive, params, *operands)

    def any(self, condition: Any) -> Any:
        """Return whether a condition holds for any thread of the block."""
        return jnp.max(jnp.where(condition, 1.0, 0.0)) > 0

    def carried(self, vector: Any) -> Any:
        """Return a vector with one entry in a register of each thread."""
        from jax.experimental.pallas import mosaic_gpu as plgpu

        return plgpu.layout_cast(vector, plgpu.Layout.WG_STRIDED(vector.shape, vec_size=1))

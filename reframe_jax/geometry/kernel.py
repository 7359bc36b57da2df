"""Compute functions of many small problems as GPU kernels, with one thread for every problem.

XLA computes a function of small vectors and matrices of many problems as hundreds of operations, each of
which reads and writes the components of all problems in memory. A kernel keeps them in the registers of
threads. The functions stay the same: they are traced for one problem, and every operation is then applied to
components, each of which is a vector over the problems of a block. Operations that only move components need
no instructions. The kernels are written in Pallas on Mosaic, for GPUs from Hopper on.
"""

from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import cache, partial, reduce, wraps
from itertools import repeat
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core

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


@dataclass(frozen=True, eq=False)
class _Load:
    """A component of an argument, which is loaded where it is used."""

    load: Callable[[tuple[Any, ...]], Any]
    index: tuple[Any, ...]
    dtype: Any

    def moved(self, other: "_Load", place: Any) -> "_Load":
        """Return the component whose index is ``place`` where those of two components differ."""
        pairs = zip(self.index, other.index, strict=True)
        return replace(self, index=tuple(i if i == j else place for i, j in pairs))


def components(shape: Any, load: Callable[[tuple[Any, ...]], Any]) -> np.ndarray:
    """Return the components of an argument, which a function loads by their index."""
    return _array(shape.shape, lambda index: _Load(load, index, shape.dtype))


def _array(shape: tuple[int, ...], of_index: Callable[[tuple[int, ...]], Any]) -> np.ndarray:
    array = np.empty(shape, object)
    for index in np.ndindex(*shape):
        array[index] = of_index(index)
    return array


def _each(function: Callable[..., Any], *arrays: Any) -> np.ndarray:
    """Apply a function to the components of arrays."""
    broad = np.broadcast_arrays(*arrays)
    return _array(broad[0].shape, lambda index: function(*(array[index] for array in broad)))


class Components:
    """Computes jaxprs of one problem for vectors of problems.

    A value is an array of components. A component is a number, a scalar of JAX that all problems share, a
    vector of problems, or what loads it from an argument.
    """

    def __init__(self, problems: tuple[int, ...]) -> None:
        self.problems = problems
        self._loaded: dict[_Load, Any] = {}

    def apply(self, primitive: Any, params: dict[str, Any], *operands: Any) -> Any:
        """Apply an elementwise primitive to vectors, or to scalars."""
        return primitive.bind(*operands, **params)

    def any(self, condition: Any) -> Any:
        """Return whether a condition holds for any problem of a vector."""
        return jnp.any(condition)

    def carried(self, vector: Any) -> Any:
        """Return a vector in the form in which loops carry it."""
        return vector

    def loaded(self, component: Any) -> Any:
        """Load a component, if that is needed."""
        if not isinstance(component, _Load):
            return component
        if component not in self._loaded:
            value = component.load(component.index)
            self._loaded[component] = value > 0.5 if component.dtype == bool != value.dtype else value
        return self._loaded[component]

    def vector(self, component: Any, dtype: Any) -> Any:
        """Return a component as a vector of the problems."""
        if not isinstance(component, jax.Array):
            return jnp.full(self.problems, component, dtype)
        return jnp.broadcast_to(component, self.problems) if component.ndim == 0 else component

    def run(self, program: Any, arguments: list[np.ndarray]) -> list[np.ndarray]:
        """Compute the results of a closed jaxpr."""
        values = dict(zip(program.jaxpr.constvars, map(np.asarray, program.consts), strict=True))
        values |= dict(zip(program.jaxpr.invars, arguments, strict=True))

        def read(variable: Any) -> np.ndarray:
            return np.asarray(variable.val) if isinstance(variable, core.Literal) else values[variable]

        for equation in program.jaxpr.eqns:
            found = self._equation(equation, [read(variable) for variable in equation.invars])
            pairs = zip(equation.outvars, found, strict=True)
            values |= {variable: _settle(value, variable.aval.dtype) for variable, value in pairs}
        return [read(variable) for variable in program.jaxpr.outvars]

    def _equation(self, equation: Any, given: list[np.ndarray]) -> list[np.ndarray]:
        primitive, params, result = equation.primitive, equation.params, equation.outvars[0].aval
        name, dtypes = primitive.name, [v.aval.dtype for v in equation.invars]
        if name in ("jit", "custom_jvp_call"):
            return self.run(params["jaxpr" if name == "jit" else "call_jaxpr"], given)
        if name in ("while", "scan"):
            return self._loop(equation, given)
        if name in _REDUCED:
            entries = np.split(given[0], given[0].shape[params["axes"][0]], params["axes"][0])
            both = partial(_each, partial(self._elementwise, _REDUCED[name], {}, [bool, bool]))
            return [reduce(both, entries).reshape(result.shape)]
        if name == "argmin":
            found = self._argmin(given[0], params["axes"][0], dtypes[0], result.dtype)
            return [found.reshape(result.shape)]
        if name == "dynamic_slice":
            return [self._slice(params["slice_sizes"], dtypes, *given)]
        if name == "gather" and given[1].dtype == object:
            every = range(given[0].shape[params["dimension_numbers"].start_index_map[0]])
            entries = [_gather(params, given[0], np.full(given[1].shape, k)) for k in every]
            own = np.expand_dims(given[1][..., 0], params["dimension_numbers"].offset_dims)
            return [self._choose(entries, own, dtypes[1], result.dtype)]
        if name in _MOVES:
            found = _MOVES[name](params, *given)
            return found if primitive.multiple_results else [found]
        found = _each(partial(self._elementwise, primitive, params, dtypes), *given)
        return [np.broadcast_to(found, result.shape)]

    def _elementwise(self, primitive: Any, params: dict[str, Any], dtypes: list[Any], *operands: Any) -> Any:
        """Apply an elementwise primitive to components."""
        name, values = primitive.name, [self.loaded(operand) for operand in operands]
        known = [not isinstance(value, jax.Array) for value in values]
        if all(known):
            numbers = [np.asarray(v, dtype) for v, dtype in zip(values, dtypes, strict=True)]
            with np.errstate(all="ignore"), jax.ensure_compile_time_eval():
                of_numbers = _OF_NUMBERS.get(name, partial(primitive.bind, **params))
                return np.asarray(of_numbers(*numbers)).item()
        if name == "select_n" and known[0]:
            return values[1 + int(values[0])]
        # the unit matrices and the signs of formulas need no instructions
        if name in ("add", "mul") and known[0]:
            values, known = values[::-1], known[::-1]
        if name == "mul" and known[1] and values[1] == 0:
            return 0.0
        if name in _NEUTRAL and known[1] and values[1] == _NEUTRAL[name]:
            return values[0]
        vectors = any(getattr(value, "ndim", 0) for value in values)
        form = self.vector if vectors else jnp.asarray
        return self.apply(primitive, params, *map(form, values, dtypes))

    def _choose(self, entries: list[np.ndarray], index: np.ndarray, place: Any, dtype: Any) -> np.ndarray:
        """Choose, for every problem, the entry of its index, whose components have the type ``place``."""
        is_it = partial(self._elementwise, lax.eq_p, {}, [place, place])
        choose = partial(self._elementwise, lax.select_n_p, {}, [bool, dtype, dtype])
        found, *others = entries
        for k, entry in enumerate(others, 1):
            found = _each(choose, _each(is_it, index, k), found, entry)
        return found

    def _argmin(self, value: np.ndarray, axis: int, dtype: Any, place: Any) -> np.ndarray:
        lower = partial(self._elementwise, lax.lt_p, {}, [dtype, dtype])
        choose = [partial(self._elementwise, lax.select_n_p, {}, [bool, d, d]) for d in (dtype, place)]
        best, *entries = np.split(value, value.shape[axis], axis)
        found: Any = 0
        for k, entry in enumerate(entries, 1):
            here = _each(lower, entry, best)
            best, found = _each(choose[0], here, best, entry), _each(choose[1], here, found, k)
        return found

    def _slice(
        self, sizes: tuple[int, ...], dtypes: list[Any], value: np.ndarray, *starts: np.ndarray
    ) -> np.ndarray:
        """Cut one entry of an axis of a value, at an index that all problems share."""
        if sizes == value.shape:
            return value
        (axis,) = (k for k, size in enumerate(sizes) if size != value.shape[k])
        entries = np.split(value, value.shape[axis], axis)
        if not _is_axis(entries):
            return self._choose(entries, starts[axis], *dtypes[1::-1])
        start = self.loaded(starts[axis].item())
        return _each(lambda one, other: one.moved(other, start), *entries[:2])

    def _loop(self, equation: Any, given: list[np.ndarray]) -> list[np.ndarray]:
        """Run a loop; its values are carried one by one."""
        params, shapes = equation.params, [v.aval for v in equation.outvars]
        number, first = len(given) - len(shapes), params.get("cond_nconsts", 0)
        program = params["jaxpr" if "jaxpr" in params else "body_jaxpr"]

        def restored(flat: Any) -> list[np.ndarray]:
            parts = iter(flat)

            def part(is_bool: bool, _: Any) -> Any:
                return next(parts) > 0.5 if is_bool else next(parts)

            return [_array(shape.shape, partial(part, shape.dtype == bool)) for shape in shapes]

        def advance(flat: Any) -> tuple[Any, ...]:
            own = type(self)(self.problems)
            return own._flat(own.run(program, [*given[first:number], *restored(flat)]), shapes)

        def goes_on(flat: Any) -> Any:
            own = type(self)(self.problems)
            condition = own.run(params["cond_jaxpr"], [*given[:first], *restored(flat)])[0].item()
            return self.any(condition) if condition.ndim else condition

        start = self._flat(given[number:], shapes)
        if "length" in params:
            return restored(lax.fori_loop(0, params["length"], lambda _, flat: advance(flat), start))
        return restored(lax.while_loop(goes_on, advance, start))

    def _flat(self, values: list[np.ndarray], shapes: list[Any]) -> tuple[Any, ...]:
        """Return the components of values one by one, in the form in which loops carry them."""
        flat = []
        for shape, value in zip(shapes, values, strict=True):
            for component in map(self.loaded, np.broadcast_to(value, shape.shape).flat):
                if shape.ndim == 0:
                    flat.append(jnp.asarray(component, shape.dtype))
                    continue
                vector = self.vector(component, shape.dtype)
                flat.append(self.carried(jnp.where(vector, 1.0, 0.0) if shape.dtype == bool else vector))
        return tuple(flat)


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


def _is_axis(entries: list[np.ndarray]) -> bool:
    """Return whether entries are those of an axis of an argument, in their order."""
    if not all(isinstance(component, _Load) for entry in entries for component in entry.flat):
        return False
    one, other = (entry.flat[0] for entry in entries[:2])
    return all(entry.flat[0].index == one.moved(other, k).index for k, entry in enumerate(entries))


def _settle(value: np.ndarray, dtype: Any) -> np.ndarray:
    """Return an array of numbers instead of components, if all of them are numbers."""
    known = value.dtype == object and not any(isinstance(c, jax.Array | _Load) for c in value.flat)
    return value.astype(dtype) if known else value


def _broadcast(params: dict[str, Any], value: np.ndarray) -> np.ndarray:
    shape = np.ones(len(params["shape"]), int)
    shape[list(params["broadcast_dimensions"])] = value.shape
    return np.broadcast_to(value.reshape(shape), params["shape"])


def _gather(params: dict[str, Any], value: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Gather entries of an array, as XLA does."""
    dimensions, sizes = params["dimension_numbers"], params["slice_sizes"]
    inner, batch = dimensions.offset_dims, dimensions.operand_batching_dims
    gone = (*dimensions.collapsed_slice_dims, *batch)
    within, outside = (
        iter(s) for s in ([size for k, size in enumerate(sizes) if k not in gone], indices.shape[:-1])
    )
    number = indices.ndim - 1 + len(inner)
    places = np.indices([next(within if k in inner else outside) for k in range(number)])
    outer = [places[k] for k in range(number) if k not in inner]
    starts, along, index = indices[(*outer, ...)], iter(inner), []
    for k in range(value.ndim):
        first: Any = 0
        if k in dimensions.start_index_map:
            first = starts[..., dimensions.start_index_map.index(k)].astype(int)
        elif k in batch:
            first = outer[dimensions.start_indices_batching_dims[batch.index(k)]]
        index.append(first if k in gone else first + places[next(along)])
    return value[tuple(index)]


_MOVES: dict[str, Callable[..., Any]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda params, *values: np.concatenate(values, params["dimension"]),
    "gather": _gather,
    "reshape": lambda params, value: value.reshape(params["new_sizes"]),
    "slice": lambda params, value: value[
        tuple(map(slice, params["start_indices"], params["limit_indices"], params["strides"] or repeat(None)))
    ],
    "split": lambda params, value: np.split(value, np.cumsum(params["sizes"])[:-1], params["axis"]),
    "squeeze": lambda params, value: np.squeeze(value, params["dimensions"]),
    "stack": lambda params, *values: np.stack(values, params["axis"]),
    "transpose": lambda params, value: value.transpose(params["permutation"]),
    "unstack": lambda params, value: [
        entry.squeeze(params["axis"])
        for entry in np.split(value, value.shape[params["axis"]], params["axis"])
    ],
}
"""Primitives that only move components."""

_OF_NUMBERS = {"add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative}
"""Primitives for numbers; others are those of JAX, which are slow to compile."""

_REDUCED = {"reduce_or": lax.or_p, "reduce_and": lax.and_p}

_NEUTRAL = {"add": 0, "sub": 0, "mul": 1, "div": 1}  # second operands that change nothing

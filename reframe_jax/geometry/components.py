"""Compute the jaxpr of one small problem for vectors of problems, component by component."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import repeat
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax


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
    vector of problems, or what loads it from an argument. Moving components needs no instructions.
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
            literal = hasattr(variable, "val")
            return np.asarray(variable.val) if literal else values[variable]

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
    inside = [size for k, size in enumerate(sizes) if k not in gone]
    within, outside = iter(inside), iter(indices.shape[:-1])
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

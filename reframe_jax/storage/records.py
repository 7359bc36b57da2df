"""Describe options as JSON, with equal text for equal options in every process and on every machine."""

import dataclasses
import hashlib
import inspect
import math
import re
from collections.abc import Callable, Collection, Mapping
from enum import Enum
from functools import partial
from types import FunctionType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_LISTED = 64  # longest array that is described by its numbers; longer arrays get a checksum
_ROWS = 1024  # rows per hash step: windows overlap in memory, and a full copy may not fit


def describe_options(
    function: Callable[..., Any], given: Mapping[str, Any], *, without: Collection[str] = ()
) -> dict[str, Any]:
    """Return every keyword-only option of a function, with the given or the default value.

    A TypeError for an option that the function does not have lists its options.
    """
    parameters = inspect.signature(function).parameters.values()
    defaults = {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY and p.name not in without}
    if unknown := sorted(given.keys() - defaults.keys()):
        raise TypeError(
            f"{function.__name__} has no option {', '.join(unknown)}; choose from {', '.join(defaults)}."
        )
    return {name: describe(given.get(name, default)) for name, default in defaults.items()}


def describe(value: Any, within: tuple[int, ...] = ()) -> Any:
    """Convert a value, which the objects with the identities ``within`` contain, to JSON types.

    The description of numbers and arrays is their value, of dataclasses their fields, and of functions their
    name, bound arguments and closure. Long arrays are described by a checksum.
    """
    if value is None or isinstance(value, (bool, str)):
        return value
    if id(value) in within:
        return "itself"
    inner = partial(describe, within=(*within, id(value)))
    if isinstance(value, Enum):
        return f"{type(value).__name__}.{value.name}"
    if isinstance(value, (int, float)):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        return {"key": str(jax.random.key_impl(value)), "data": inner(jax.random.key_data(value))}
    if isinstance(value, (np.generic, np.ndarray, jax.Array)):
        array = np.asarray(value)
        if array.size > _LISTED:
            return {"shape": list(array.shape), "checksum": checksum({"": array})}
        return inner(array.tolist())
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name: inner(getattr(value, field.name)) for field in dataclasses.fields(value)}
        return {"type": type(value).__name__, **fields}
    if isinstance(value, Mapping):
        return {str(name): inner(item) for name, item in sorted(value.items(), key=str)}
    if isinstance(value, (tuple, list)):
        return [inner(item) for item in value]
    if isinstance(value, partial):
        return {"function": inner(value.func), "arguments": inner([value.args, value.keywords])}
    if inspect.ismethod(value):
        return {"function": inner(value.__func__), "of": inner(value.__self__)}
    if callable(value) and isinstance(inspect.unwrap(value), FunctionType):
        return _describe_function(inspect.unwrap(value), inner)
    if hasattr(value, "__qualname__"):
        return f"{value.__module__}.{value.__qualname__}"
    text = repr(value)
    if not re.search(r"\bat 0x[0-9a-f]+", text):
        return text
    return {"type": type(value).__qualname__, **inner(getattr(value, "__dict__", {}))}


def _describe_function(function: FunctionType, inner: Callable[[Any], Any]) -> dict[str, Any]:
    record: dict[str, Any] = {"function": f"{function.__module__}.{function.__qualname__}"}
    if function.__name__ == "<lambda>":  # many functions have this name
        code = function.__code__
        constants = [constant for constant in code.co_consts if not inspect.iscode(constant)]
        text = repr((code.co_code, code.co_names, constants))
        record["code"] = hashlib.sha256(text.encode()).hexdigest()
    cells = []
    for cell in function.__closure__ or ():
        try:
            cells.append(inner(cell.cell_contents))
        except ValueError:  # the closure cell is empty
            cells.append(None)
    defaults = inner([function.__defaults__ or (), function.__kwdefaults__ or {}])
    return {**record, "closure": cells, "defaults": defaults}


def checksum(arrays: Mapping[str, Any], *, start: str = "") -> str:
    """SHA-256 of a text and of named arrays: their names, types, shapes and bytes."""
    total = hashlib.sha256(start.encode())
    for name in sorted(arrays):
        array = np.asarray(arrays[name])
        total.update(f"{name} {array.dtype.str} {array.shape}".encode())
        rows = np.atleast_1d(array)
        for first in range(0, len(rows), _ROWS):
            total.update(np.ascontiguousarray(rows[first : first + _ROWS]).reshape(-1).view(np.uint8).data)
    return total.hexdigest()

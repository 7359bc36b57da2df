"""Compile simulations, and check their numeric options."""

from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.compilation import traced

__all__ = ["as_numbers", "check_numbers", "jit_simulation"]

# the older code generator compiles in two thirds of the time to equally fast code; jax 0.11 has only
# one generator
_CPU_OPTIONS: dict[str, Any] | None = (
    {"xla_cpu_use_fusion_emitters": False} if jax.__version_info__ < (0, 11) else None
)


def jit_simulation(static: Sequence[str]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """``jax.jit`` with named static arguments and compiler options for the processor.

    Only the outermost ``jit`` has compiler options. Matrix products of MJX have full precision, as in
    :mod:`reframe_jax.geometry.products`.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        plain = jax.jit(function, static_argnames=static)
        for_cpu = jax.jit(function, static_argnames=static, compiler_options=_CPU_OPTIONS)

        @wraps(function)
        def call(*args: Any, **options: Any) -> Any:
            on_cpu = jax.default_backend() == "cpu" and not traced((args, options))
            with jax.default_matmul_precision("highest"):
                return (for_cpu if on_cpu else plain)(*args, **options)

        return call

    return decorate


def as_numbers(tree: Any, dtype: Any) -> Any:
    """Convert every number of a pytree to an array of a dtype."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=dtype), tree)


def check_numbers(given: Any, kind: type) -> None:
    """Check that an argument is a dataclass of non-negative numbers; traced values are not checked.

    Args:
        given: the argument.
        kind: the expected dataclass.

    Raises:
        ValueError: for another type, or for a negative number or NaN, with the name of the field.
    """
    if not isinstance(given, kind):
        raise ValueError(f"Expected {kind.__name__}(...), not {given!r}.")
    for name, value in vars(given).items():
        if not traced(value) and not np.all(np.asarray(value) >= 0):
            raise ValueError(f"{name} of {kind.__name__} must not be negative or nan; found {value}.")

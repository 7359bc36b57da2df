"""Convert and check the numeric options of simulations."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.compilation import traced

__all__ = ["as_numbers", "check_numbers"]


def as_numbers(tree: Any, dtype: Any) -> Any:
    """Convert every number of a pytree to an array of a dtype."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=dtype), tree)


def check_numbers(given: Any, kind: type) -> None:
    """Check that an argument is a dataclass of non-negative numbers; traced values are not checked.

    Raises:
        ValueError: for another type, or for a negative number or NaN, with the name of the field.
    """
    if not isinstance(given, kind):
        raise ValueError(f"Expected {kind.__name__}(...), not {given!r}.")
    for name, value in vars(given).items():
        if not traced(value) and not np.all(np.asarray(value) >= 0):
            raise ValueError(f"{name} of {kind.__name__} must not be negative or nan; found {value}.")

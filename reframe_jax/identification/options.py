"""Options of the main entry: what they may be, and what the pipeline makes of them."""

from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.compilation import traced
from reframe_jax.identification.classify import Thresholds
from reframe_jax.identification.evidence import LagRule
from reframe_jax.motion.kinematics import Discretization
from reframe_jax.solvers import Box, Solver

__all__ = ["Lag", "as_dtype", "check_options", "lag_in_samples", "make_box"]

Lag = Literal["auto"] | int | float | np.ndarray | jax.Array
"""Samples, seconds or "auto"."""


def lag_in_samples(lag: Lag, steps: Any, discretization: Discretization) -> tuple[LagRule, Any]:
    """What velocities are taken from, and the lag in samples where it is given.

    Args:
        lag: as given to :func:`reframe_jax.identify`.
        steps: (K,) or (..., K) sample times, s.
        discretization: as given to it.

    Raises:
        ValueError: if the lag is none, or does not go with the discretization.
    """
    if isinstance(lag, str):
        if lag != "auto":
            raise ValueError(
                f"lag must be 'auto', a number of samples (int) or seconds (float), not {lag!r}."
            )
        return ("auto" if discretization == "chord" else "single"), None
    concrete = not isinstance(lag, jax.core.Tracer)
    value = lag if isinstance(lag, jax.Array) else np.asarray(lag)
    if value.ndim or value.dtype.kind not in "iuf" or (concrete and not 0 < float(value) < np.inf):
        raise ValueError(f"lag must be 'auto', a number of samples (int) or seconds (float), not {lag!r}.")
    if value.dtype.kind == "f":
        xp = jnp if traced((value, steps)) else np
        value = xp.maximum(xp.round(value / xp.median(steps, axis=-1)), 1)
    elif concrete and int(value) == 1:
        return "single", None
    if discretization != "chord":
        raise ValueError(
            "discretization 'left' takes velocities from consecutive poses: leave out lag, or give 1."
        )
    return "given", value.astype(np.int32)


def check_options(
    thresholds: Thresholds | None, solver: Solver | None, discretization: Discretization
) -> None:
    """Refuse thresholds, solvers and discretizations that are none.

    Raises:
        ValueError: saying what was expected.
    """
    if thresholds is not None:
        if not isinstance(thresholds, Thresholds):
            raise ValueError(f"thresholds must be Thresholds(angular=..., linear=...), not {thresholds!r}.")
        levels = (thresholds.angular, thresholds.linear)
        if not traced(levels) and not all(np.all(np.asarray(level) >= 0) for level in levels):
            raise ValueError(f"thresholds must be 0 or more, in rad/s and m/s, not {thresholds}.")
    if solver is not None and not hasattr(solver, "minimise"):
        raise ValueError(f"solver must be a search such as BasinHopping(ValleySteps(6)), not {solver!r}.")
    if discretization not in get_args(Discretization):
        raise ValueError(f"discretization must be 'chord' or 'left', not {discretization!r}.")


def make_box(bounds: Any, dtype: np.dtype) -> Box:
    """Where positions are searched, from ``bounds`` of :func:`reframe_jax.identify`.

    Raises:
        ValueError: if they are of a wrong shape, or span no box.
    """
    low, high = bounds if isinstance(bounds, tuple) else (-bounds, bounds)
    low, high = as_dtype(low, dtype), as_dtype(high, dtype)
    if low.shape not in ((), (3,)) or high.shape not in ((), (3,)):
        raise ValueError("bounds must be a length in m, or (low, high) with a number or (3,) each.")
    if not traced((low, high)) and not np.all(np.asarray(low) < np.asarray(high)):
        raise ValueError(f"bounds must span a box: low < high, not {low} and {high}.")
    ones = np.ones(3, dtype)
    return Box(low * ones, high * ones)


def as_dtype(value: Any, dtype: np.dtype) -> Any:
    """The value as an array of that type; arrays of JAX stay on their device."""
    return value.astype(dtype) if isinstance(value, jax.Array) else np.asarray(value, dtype)

"""Options of the main entry: what they may be, and what the pipeline makes of them."""

from typing import Any, Literal, TypedDict, get_args

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.compilation import traced
from reframe_jax.identification.classify import Thresholds
from reframe_jax.identification.evidence import LagRule
from reframe_jax.identification.inputs import read_numbers
from reframe_jax.identification.widening import SearchSpace
from reframe_jax.motion.kinematics import Discretization
from reframe_jax.solvers import Box, Solver

__all__ = ["IdentifyOptions", "Lag", "as_dtype", "check_options", "lag_in_samples", "make_space"]

_LONGEST = 2**30  # samples of a lag, far more than a window has
_NEAR, _FAR = 1.0, 16.0  # m, half the width of the boxes that are searched by default
_FARTHEST = 1e6  # m, of bounds: far more than any mechanism, and powers of it are finite

Lag = Literal["auto"] | int | float | np.ndarray | jax.Array
"""Samples, seconds or "auto"."""


class IdentifyOptions(TypedDict, total=False):
    """Keyword arguments of :func:`reframe_jax.identify` that functions which call it hand on."""

    lag: Lag
    norm: float
    discretization: Discretization
    thresholds: Thresholds | None
    bounds: ArrayLike | tuple[ArrayLike, ArrayLike] | None
    solver: Solver | None
    key: jax.Array | None
    compiled: bool | None


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
    value = read_numbers("lag", lag)
    if value.ndim or (concrete and not 0 < float(value) < np.inf):
        raise ValueError(f"lag must be 'auto', a number of samples (int) or seconds (float), not {lag!r}.")
    xp = jnp if traced((value, steps)) else np
    if value.dtype.kind == "f":
        step = xp.median(steps, axis=-1)
        number = xp.round(value / xp.where(step > 0, step, 1))
        value = xp.clip(xp.where(xp.isfinite(number), number, 1), 1, _LONGEST)
    elif concrete and int(value) == 1:
        return "single", None
    if discretization != "chord":
        raise ValueError(
            "discretization 'left' takes velocities from consecutive poses: leave out lag, or give 1."
        )
    longest = min(_LONGEST, np.iinfo(value.dtype).max) if value.dtype.kind in "iu" else _LONGEST
    return "given", xp.minimum(value, longest).astype(np.int32)


def check_options(
    thresholds: Thresholds | None,
    solver: Solver | None,
    discretization: Discretization,
    key: jax.Array | None = None,
) -> None:
    """Refuse thresholds, solvers, discretizations and keys that are none.

    Raises:
        ValueError: saying what was expected.
    """
    if thresholds is not None:
        if not isinstance(thresholds, Thresholds):
            raise ValueError(f"thresholds must be Thresholds(angular=..., linear=...), not {thresholds!r}.")
        levels = [read_numbers("thresholds", x) for x in (thresholds.angular, thresholds.linear)]
        if any(level.ndim for level in levels):
            raise ValueError(f"thresholds must be one number each, in rad/s and m/s, not {thresholds}.")
        if not traced(levels) and not all(np.all(np.asarray(level) >= 0) for level in levels):
            raise ValueError(f"thresholds must be 0 or more, in rad/s and m/s, not {thresholds}.")
    if solver is not None and (isinstance(solver, type) or not hasattr(solver, "minimise")):
        raise ValueError(f"solver must be a search such as BasinHopping(ValleySteps(6)), not {solver!r}.")
    if discretization not in get_args(Discretization):
        raise ValueError(f"discretization must be 'chord' or 'left', not {discretization!r}.")
    if key is not None and not _is_key(key):
        raise ValueError(f"key must be one key of random numbers, jax.random.key(seed), not {key!r}.")


def _is_key(key: Any) -> bool:
    if not isinstance(key, jax.Array):
        return False
    plain = key.dtype == np.uint32 and key.shape == (2,)
    return plain or (jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.shape == ())


def make_space(bounds: Any, dtype: np.dtype) -> SearchSpace:
    """Where positions are searched, from ``bounds`` of :func:`reframe_jax.identify`.

    Bounds that were given are kept; those by default are widened where the motion asks for it.

    Raises:
        ValueError: if they are of a wrong shape, or span no box.
    """
    if bounds is None:
        near, far = (as_dtype(np.full(3, size), dtype) for size in (_NEAR, _FAR))
        return SearchSpace(Box(-near, near), Box(-far, far))
    if isinstance(bounds, tuple) and len(bounds) != 2:
        raise ValueError(f"bounds must be a length in m, or (low, high), not {len(bounds)} of them.")
    if isinstance(bounds, tuple):
        low, high = (read_numbers("bounds", bound) for bound in bounds)
    else:
        high = read_numbers("bounds", bounds).astype(dtype)
        low = -high
    low, high = as_dtype(low, dtype), as_dtype(high, dtype)
    if low.shape not in ((), (3,)) or high.shape not in ((), (3,)):
        raise ValueError("bounds must be a length in m, or (low, high) with a number or (3,) each.")
    if not traced((low, high)):
        low, high = np.asarray(low), np.asarray(high)
        if not np.all(low < high):
            raise ValueError(f"bounds must span a box: low < high, not {low} and {high}.")
        if not (np.all(low >= -_FARTHEST) and np.all(high <= _FARTHEST)):
            raise ValueError(f"bounds must lie within {_FARTHEST:g} m, not {low} and {high}.")
    ones = np.ones(3, dtype)
    box = Box(low * ones, high * ones)
    return SearchSpace(box, box)


def as_dtype(value: Any, dtype: np.dtype) -> Any:
    """The value as an array of that type; arrays of JAX stay on their device."""
    return value.astype(dtype) if isinstance(value, jax.Array) else np.asarray(value, dtype)

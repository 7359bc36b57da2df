"""Check the options of ``identify``, and convert them to the form that compiled programs use."""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, TypedDict, get_args

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.compilation import traced
from reframe_jax.identification.classify import Thresholds
from reframe_jax.identification.inputs import read_numbers
from reframe_jax.identification.naming import codes_of
from reframe_jax.model.table import ENTRIES
from reframe_jax.motion.kinematics import Discretization
from reframe_jax.objectives.norms import check_exponent
from reframe_jax.solvers import Solver

_FARTHEST = 1e6  # m, largest bounds: larger than any mechanism, and its powers are finite in float32

Scales = Literal["auto", "mean"] | int | Sequence[int]
"""Time scales in samples; "auto" for all useful scales, "mean" to compare poses with their mean."""


class IdentifyOptions(TypedDict, total=False):
    """Keyword arguments that other functions pass on to :func:`reframe_jax.identify`."""

    scales: Scales
    norm: float
    discretization: Discretization
    thresholds: Thresholds | None
    bounds: ArrayLike | None
    solver: Solver | None
    key: jax.Array | None
    assume: str | None


class Options(NamedTuple):
    """The options of :func:`reframe_jax.identify`, with their defaults."""

    scales: Scales = "auto"
    assume: str | None = None
    norm: float = 0.0
    discretization: Discretization = "chord"
    thresholds: Thresholds | None = None
    bounds: "ArrayLike | None" = None
    solver: Solver | None = None
    key: jax.Array | None = None

    @property
    def by_steps(self) -> bool:
        """Whether the paper's search, over velocities of single steps, replaces that over time scales."""
        return check_exponent(self.norm) != 0 or self.solver is not None or self.discretization != "chord"


def take_scales(scales: Any, poses: int) -> np.int32:
    """Return the sum of the scales, whose bits are the powers of two; 0 for "mean", and -1 for "auto".

    Raises:
        ValueError: unless the numbers are 1 or powers of two below an eighth of the poses in a window.
    """
    if isinstance(scales, str):
        if scales in ("auto", "mean"):
            return np.int32(-1 if scales == "auto" else 0)
        raise ValueError(f"scales must be 'auto', 'mean' or numbers of samples, not {scales!r}.")
    values = np.atleast_1d(read_numbers("scales", scales))
    longest = max(1, (poses - 1) // 8)  # as in scale_moments
    whole = values.ndim == 1 and values.size and values.dtype.kind in "iu"
    if not whole or not all(0 < v <= longest and v & (v - 1) == 0 for v in values.tolist()):
        raise ValueError(
            f"scales must be powers of two from 1 to less than an eighth of the window (at most {longest}), "
            f"not {scales!r}."
        )
    return np.int32(sum(set(values.tolist())))


def check_options(options: Options, poses: int) -> tuple[np.int32, Any, np.ndarray]:
    """Check all options except the norm, and return scales, bounds and allowed entries for programs.

    The number of poses in a window limits the scales. The entries (E,) bool are those of the assumed
    constraint, or all.

    Raises:
        ValueError: for an invalid option; the message states what is expected.
    """
    scales, assume, _, discretization, thresholds, bounds, solver, key = options
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
    samples, reach = take_scales(scales, poses), check_bounds(bounds)
    if thresholds is not None and scales == "mean":
        raise ValueError("thresholds compare velocities, which displacements about the mean do not have.")
    if not isinstance(assume, str | None):
        raise ValueError(f"assume must be the name of a constraint, such as 'hinge', not {assume!r}.")
    codes = range(len(ENTRIES)) if assume is None else codes_of(assume)
    return samples, reach, np.isin(np.arange(len(ENTRIES)), codes)


def _is_key(key: Any) -> bool:
    if not isinstance(key, jax.Array):
        return False
    plain = key.dtype == np.uint32 and key.shape == (2,)
    return plain or (jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.shape == ())


def check_bounds(bounds: Any) -> Any:
    """Check half the width of the cube in which origins are searched, m; None for the default.

    Raises:
        ValueError: unless it is one positive length of at most 1e6 m.
    """
    if bounds is None:
        return None
    value = read_numbers("bounds", bounds)
    if value.ndim:
        wanted = "one length in m, half the width of a cube"
        raise ValueError(f"bounds must be {wanted}, not an array of shape {value.shape}.")
    if not traced(value) and not 0 < float(value) <= _FARTHEST:
        raise ValueError(f"bounds must be positive and at most {_FARTHEST:g} m, not {float(value):g}.")
    return value

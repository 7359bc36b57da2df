"""Few windows, identified with NumPy: nothing is compiled, so that the first answer comes at once."""

import math
from collections import Counter
from collections.abc import Callable
from typing import Any, TypeVar, cast

import jax
import numpy as np

from reframe_jax.arrays import with_numpy
from reframe_jax.identification.pipeline import identify_windows
from reframe_jax.identification.results import Identification
from reframe_jax.solvers import BasinHopping, Solver, ValleySteps

__all__ = ["FIRST_CALLS", "check_compiled", "compile_windows", "compute_uncompiled", "identify_uncompiled"]

FIRST_CALLS = 128
"""Calls of a process with the same options that are not worth a compilation: together they take less."""

_T = TypeVar("_T")
_CHUNK = 64  # windows that are identified at a time

_calls: Counter[Any] = Counter()


def compile_windows(compiled: bool | None, poses: Any, *options: Any) -> bool:
    """Whether to compile, as the user chose, or where that is worth it; counts the calls that had no choice.

    Args:
        compiled: of the user; None without a choice.
        poses: (..., K+1, 4, 4).
        options: for which a program is compiled; one with a solver that needs it always is.
    """
    if compiled is not None:
        return bool(compiled)
    many = math.prod(poses.shape[:-3]) > _CHUNK
    # whoever put them on a device wants them to be worked on there
    if many or getattr(poses, "committed", False):
        return True
    if not all(_runs_on_numpy(option) for option in options if hasattr(option, "minimise")):
        return True
    kind = poses.dtype, *options
    _calls[kind] += 1
    return _calls[kind] > FIRST_CALLS


def check_compiled(compiled: bool | None, solver: Solver | None = None) -> None:
    """Refuse a choice that is none, or that the solver does not leave.

    Raises:
        ValueError: saying what was expected.
    """
    if compiled not in (None, True, False):
        raise ValueError(f"compiled must be True, False or None, not {compiled!r}.")
    if compiled is not None and not compiled and solver is not None and not _runs_on_numpy(solver):
        raise ValueError(
            f"NumPy runs BasinHopping with ValleySteps only; {solver!r} needs JAX: leave out compiled=False."
        )


def _runs_on_numpy(solver: Solver) -> bool:
    """Whether the solver needs no derivatives, which are JAX's."""
    if type(solver) is not BasinHopping:
        return False
    return all(type(steps) is ValleySteps for steps in (solver.inner, solver.refine) if steps is not None)


def identify_uncompiled(
    poses: Any,
    steps: Any,
    lag: Any,
    thresholds: Any,
    space: Any,
    key: jax.Array | None,
    **options: Any,
) -> Identification:
    """Identify (..., K+1, 4, 4) poses as :func:`.identify_compiled` does, up to rounding."""
    thresholds, space = jax.device_get((thresholds, space))
    key = jax.random.key(0) if key is None else key
    batch, dtype = poses.shape[:-3], poses.dtype

    def identify(poses: Any, steps: Any, lag: Any) -> Identification:
        return identify_windows(poses, steps.astype(dtype), None, lag, thresholds, space, key, **options)

    return compute_uncompiled(
        identify, batch, poses, steps, None if lag is None else np.broadcast_to(lag, batch)
    )


def compute_uncompiled(
    function: Callable[..., _T], batch: tuple[int, ...], poses: Any, steps: Any, *more: Any
) -> _T:
    """Compute a function of windows with NumPy, so many at a time.

    Args:
        function: of (N, K+1, 4, 4) poses, steps and more, to a pytree whose arrays have N in front.
        batch: axes in front of all arrays.
        poses: (..., K+1, 4, 4).
        steps: (..., K), or (K,) for all.
        more: pytrees of other arrays, with the axes in front.

    Returns:
        What the function returns, with the axes in front; floats are of the type of the poses.
    """
    poses, steps, more = jax.device_get((poses, steps, more))
    shared = None if steps.ndim > 1 else steps
    tree = poses, steps if shared is None else None, *more
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[len(batch) :]), tree)
    parts = []
    with with_numpy():
        for start in range(0, len(flat[0]), _CHUNK):
            part = jax.tree.map(lambda leaf, start=start: leaf[start : start + _CHUNK], flat)
            parts.append(function(part[0], part[1] if shared is None else shared, *part[2:]))

    def joined(*leaves: np.ndarray) -> np.ndarray:
        leaf = np.concatenate(leaves)
        # NumPy makes float64 of int32 and float32 together
        leaf = leaf.astype(poses.dtype) if leaf.dtype == np.float64 else leaf
        return leaf.reshape((*batch, *leaf.shape[1:]))

    return cast(_T, jax.device_put(jax.tree.map(joined, *parts)))

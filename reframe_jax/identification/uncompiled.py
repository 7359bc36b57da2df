"""Few windows, identified with NumPy: nothing is compiled, so that the first answer comes at once."""

import math
from collections import Counter
from typing import Any

import jax
import numpy as np

from reframe_jax.arrays import with_numpy
from reframe_jax.identification.pipeline import identify_windows
from reframe_jax.identification.results import Identification
from reframe_jax.solvers import BasinHopping, Solver, ValleySteps

__all__ = ["FIRST_CALLS", "check_compiled", "identify_uncompiled", "is_worth_compiling"]

FIRST_CALLS = 128
"""Calls of a process with the same options that are not worth a compilation: together they take less."""

_CHUNK = 64  # windows that are identified at a time

_calls: Counter[Any] = Counter()


def is_worth_compiling(poses: Any, *options: Any) -> bool:
    """Whether windows should be left to compiled programs; counts the calls.

    Args:
        poses: (..., K+1, 4, 4).
        options: for which a program is compiled; one with a solver that needs it always is.
    """
    many = math.prod(poses.shape[:-3]) > _CHUNK
    # whoever put them on a device wants them to be worked on there
    if many or getattr(poses, "committed", False):
        return True
    if not all(_runs_on_numpy(option) for option in options if hasattr(option, "minimise")):
        return True
    kind = poses.dtype, *options
    _calls[kind] += 1
    return _calls[kind] > FIRST_CALLS


def check_compiled(compiled: bool | None, solver: Solver) -> None:
    """Refuse a choice that is none, or that the solver does not leave.

    Raises:
        ValueError: saying what was expected.
    """
    if compiled not in (None, True, False):
        raise ValueError(f"compiled must be True, False or None, not {compiled!r}.")
    if compiled is not None and not compiled and not _runs_on_numpy(solver):
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
    poses, steps, lag, thresholds, space = jax.device_get((poses, steps, lag, thresholds, space))
    key = jax.random.key(0) if key is None else key
    batch, shared = poses.shape[:-3], steps.ndim == 1
    poses, steps = poses.reshape(-1, *poses.shape[-3:]), steps.astype(poses.dtype)
    steps = steps if shared else steps.reshape(-1, steps.shape[-1])
    lag = None if lag is None else np.broadcast_to(lag, batch).reshape(-1)
    parts = []
    with with_numpy():
        for start in range(0, len(poses), _CHUNK):
            part = slice(start, start + _CHUNK)
            own = steps if shared else steps[part], None, None if lag is None else lag[part]
            parts.append(identify_windows(poses[part], *own, thresholds, space, key, **options))

    def joined(*leaves: np.ndarray) -> np.ndarray:
        leaf = np.concatenate(leaves)
        # NumPy makes float64 of int32 and float32 together
        precise = leaf.dtype == np.float64
        return leaf.reshape((*batch, *leaf.shape[1:])).astype(poses.dtype if precise else leaf.dtype)

    return jax.device_put(jax.tree.map(joined, *parts))

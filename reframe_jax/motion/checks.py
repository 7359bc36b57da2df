"""Check the poses and times of windows: a status code for each window, and a message for each code."""

from enum import IntEnum
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

MIN_VELOCITIES = 4
"""Fewest velocities in a window: for three velocities, some origin does not move along some axis."""

ROTATION_TOLERANCE = 1e-3
"""Largest allowed entry of R^T R - I, where R is the rotation matrix of a pose."""

_FARTHEST = 1e9  # m, largest position; map coordinates reach 1e7
_SHORTEST, _LONGEST = 1e-9, 1e6  # s, shortest and longest step
_SLACK = 1e-3  # relative tolerance of these limits, for rounding errors


class MessageCode(IntEnum):
    """Base of integer codes with a message for people."""

    message: str

    def __new__(cls, code: int, message: str = "") -> "MessageCode":
        """Make a code with a message, which explains the outcome."""
        made = int.__new__(cls, code)
        made._value_, made.message = code, message
        return made

    def __str__(self) -> str:
        """Return the name, such as OK."""
        return self.name


class Status(MessageCode):
    """Outcome of one window. A window with a code of 10 or more has no result; its numbers are NaN.

    The message of a code explains the outcome, and the expected input.
    """

    OK = 0, "A frame was identified."
    ON_BOUNDS = (
        1,
        "The position is on the boundary of the search: the true position may be outside (widen `bounds`), "
        "or the motion does not determine the position.",
    )
    NOT_EXCITED = (
        2,
        "No axis is free: the body was held, or its motion is too small compared with the noise (with "
        "`thresholds`: too slow) to distinguish free from constrained axes.",
    )
    NOT_FINITE = 10, "The window contains NaN or infinite numbers; expected finite poses and times."
    NOT_A_POSE = (
        11,
        "A pose is not a rigid transform; expected 4x4 matrices [R p; 0 0 0 1] with R a rotation "
        f"(R^T R = I to {ROTATION_TOLERANCE:g}, det R = +1).",
    )
    TIMES_NOT_INCREASING = 12, "Sample times do not increase; expected every step dt > 0."
    NO_MOTION = 13, "All poses of the window are equal; expected a window with motion."
    OUT_OF_RANGE = (
        14,
        f"Numbers are too large or too small; expected positions within {_FARTHEST:g} m, "
        f"steps from {_SHORTEST:g} to {_LONGEST:g} s, and no extremely large or small motion.",
    )

    @property
    def failed(self) -> bool:
        """Whether the window has no result: the code is 10 or more."""
        return self >= 10


def check_step(step: float) -> None:
    """Raise a ValueError for a time between two poses below 1e-9 s or above 1e6 s."""
    if not _SHORTEST * (1 - _SLACK) <= step <= _LONGEST * (1 + _SLACK):
        raise ValueError(Status.OUT_OF_RANGE.message)


@np.errstate(over="ignore", invalid="ignore")
def is_rigid(poses: Any) -> Any:
    """Return whether matrices (..., 4, 4), of NumPy or JAX, are rigid transforms: (...) bool."""
    xp = jnp if isinstance(poses, jax.Array) else np
    # by components, because products of many small matrices are slow
    columns = [[poses[..., i, j] for i in range(3)] for j in range(3)]
    skewed = xp.zeros_like(poses[..., 0, 0])
    for a in range(3):
        for b in range(a, 3):
            dot = sum(x * y for x, y in zip(columns[a], columns[b], strict=True))
            skewed = xp.maximum(skewed, xp.abs(dot - (1 if a == b else 0)))
    # the third column of an orthogonal matrix is plus or minus the cross product of the first two
    (x, y, z), (u, v, w), third = columns
    cross = (y * w - z * v, z * u - x * w, x * v - y * u)
    handed = sum(c * t for c, t in zip(cross, third, strict=True))
    bottom = xp.max(xp.abs(poses[..., 3, :] - np.asarray([0, 0, 0, 1], poses.dtype)), axis=-1)
    return (skewed < ROTATION_TOLERANCE) & (handed > 0) & (bottom < 1e-6)


def window_status(poses: Any, steps: Any) -> Any:
    """Return the code (...) int32 of each window's :class:`Status`: ``OK``, or the first error that applies.

    The poses are (..., K+1, 4, 4), m; the times between consecutive poses are (K,) or (..., K), s. Both are
    arrays of NumPy or of JAX.
    """
    xp = jnp if isinstance(poses, jax.Array) else np
    finite = xp.all(xp.isfinite(poses), axis=(-2, -1))
    still = xp.all(poses == poses[..., :1, :, :], axis=(-2, -1))
    near = xp.all(xp.abs(poses[..., :3, 3]) <= _FARTHEST * (1 + _SLACK), axis=-1)
    usual = (steps >= _SHORTEST * (1 - _SLACK)) & (steps <= _LONGEST * (1 + _SLACK))
    finite, rigid, still, near = xp.all(xp.stack([finite, is_rigid(poses), still, near]), axis=-1)
    known, rising, usual = xp.all(xp.stack([xp.isfinite(steps), steps > 0, usual]), axis=-1)
    codes = (
        (~(finite & known), Status.NOT_FINITE),
        (~rigid, Status.NOT_A_POSE),
        (~rising, Status.TIMES_NOT_INCREASING),
        (still, Status.NO_MOTION),
        (~(near & usual), Status.OUT_OF_RANGE),
    )
    status = xp.full(finite.shape, Status.OK, dtype=xp.int32)
    for wrong, code in reversed(codes):
        status = xp.where(wrong, np.int32(code), status)
    return status

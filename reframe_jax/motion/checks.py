"""Checks of windows: status codes inside a batch, sentences outside."""

from enum import IntEnum

import jax
import jax.numpy as jnp

__all__ = ["MIN_VELOCITIES", "ROTATION_TOLERANCE", "Status", "check_step", "window_status"]

MIN_VELOCITIES = 4
"""Fewest velocities in a window: three leave every covariance singular at some origin."""

ROTATION_TOLERANCE = 1e-3
"""Largest entry of R^T R - I in a pose."""

_FARTHEST = 1e9  # m, of positions; coordinates of maps reach 1e7
_SHORTEST, _LONGEST = 1e-9, 1e6  # s, of steps
_SLACK = 1e-3  # of these limits, for rounding


class Status(IntEnum):
    """Outcome of one window. Codes of 10 and above mean that it has no result: all its numbers are NaN."""

    OK = 0
    ON_BOUNDS = 1
    NOT_EXCITED = 2
    NOT_FINITE = 10
    NOT_A_POSE = 11
    TIMES_NOT_INCREASING = 12
    NO_MOTION = 13
    OUT_OF_RANGE = 14

    @property
    def failed(self) -> bool:
        """Whether the window has no result."""
        return self >= 10

    @property
    def message(self) -> str:
        """Explanation: what happened, and what was expected."""
        return _MESSAGES[self]


_MESSAGES = {
    Status.OK: "A frame was identified.",
    Status.ON_BOUNDS: (
        "The position lies on the bounds of the search: the true one may lie outside (widen `bounds`), "
        "or the motion does not determine it."
    ),
    Status.NOT_EXCITED: (
        "No axis is free: the body was held, or its motion is too small against the noise (with "
        "`thresholds`: too slow) to tell constrained axes from free ones."
    ),
    Status.NOT_FINITE: "The window contains NaN or infinite numbers; expected finite poses and times.",
    Status.NOT_A_POSE: (
        "A pose is not a rigid transform; expected 4x4 matrices [R p; 0 0 0 1] with R a rotation "
        f"(R^T R = I to {ROTATION_TOLERANCE:g}, det R = +1)."
    ),
    Status.TIMES_NOT_INCREASING: "Sample times do not increase; expected every step dt > 0.",
    Status.NO_MOTION: "All poses of the window are equal; expected a window in which something moves.",
    Status.OUT_OF_RANGE: (
        f"Numbers are too large or too small to compute with; expected positions within {_FARTHEST:g} m, "
        f"steps from {_SHORTEST:g} to {_LONGEST:g} s, and motion of ordinary size."
    ),
}


def check_step(step: float) -> None:
    """Refuse a sample time, s, with which nothing can be computed.

    Raises:
        ValueError: with the words of the status that a window would get.
    """
    if not _SHORTEST * (1 - _SLACK) <= step <= _LONGEST * (1 + _SLACK):
        raise ValueError(Status.OUT_OF_RANGE.message)


def window_status(poses: jax.Array, steps: jax.Array) -> jax.Array:
    """Status code of every window, from its input alone.

    Args:
        poses: (..., K+1, 4, 4).
        steps: (K,) or (..., K) sample times, s.

    Returns:
        (...) int32.
    """
    finite = jnp.all(jnp.isfinite(poses), axis=(-3, -2, -1)) & jnp.all(jnp.isfinite(steps), axis=-1)
    # entry by entry: products of many small matrices are slow
    columns = [[poses[..., i, j] for i in range(3)] for j in range(3)]
    skewed = jnp.zeros_like(poses[..., 0, 0])
    for a in range(3):
        for b in range(a, 3):
            dot = sum(x * y for x, y in zip(columns[a], columns[b], strict=True))
            skewed = jnp.maximum(skewed, jnp.abs(dot - (1 if a == b else 0)))
    # for an orthogonal matrix the third column is the cross product of the first two, or minus it
    (x, y, z), (u, v, w), third = columns
    cross = (y * w - z * v, z * u - x * w, x * v - y * u)
    handed = sum(c * t for c, t in zip(cross, third, strict=True))
    bottom = jnp.asarray([0, 0, 0, 1], dtype=poses.dtype)[(None,) * (poses.ndim - 2)]
    rigid = (
        (skewed < ROTATION_TOLERANCE)
        & (handed > 0)
        & jnp.all(jnp.abs(poses[..., 3, :] - bottom) < 1e-6, axis=-1)
    )
    outside = jnp.any(jnp.abs(poses[..., :3, 3]) > _FARTHEST * (1 + _SLACK), axis=(-2, -1))
    odd = (steps < _SHORTEST * (1 - _SLACK)) | (steps > _LONGEST * (1 + _SLACK))
    moving = jnp.any(poses != poses[..., :1, :, :], axis=(-3, -2, -1))
    codes = (
        (~finite, Status.NOT_FINITE),
        (~jnp.all(rigid, axis=-1), Status.NOT_A_POSE),
        (~jnp.all(steps > 0, axis=-1), Status.TIMES_NOT_INCREASING),
        (~moving, Status.NO_MOTION),
        (outside | jnp.any(odd, axis=-1), Status.OUT_OF_RANGE),
    )
    status = jnp.full(finite.shape, Status.OK, dtype=jnp.int32)
    for wrong, code in reversed(codes):
        status = jnp.where(wrong, jnp.int32(code), status)
    return status

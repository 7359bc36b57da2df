"""Status of rollouts: whether the real robot could execute the motion."""

from enum import IntEnum

import jax
import jax.numpy as jnp

from reframe_jax.simulation.arm.model import Arm
from reframe_jax.simulation.arm.rollout import Track

__all__ = ["RolloutStatus", "rollout_status"]

_SLIPPED = (5e-4, 5e-5)  # rad and m, largest slip of a rigid axis; valid rollouts reach half of it


class RolloutStatus(IntEnum):
    """Outcome of a rollout."""

    OK = 0
    SPEED_LIMIT = 1
    JOINT_LIMIT = 2
    SLIPPED = 3
    SINGULAR = 4
    DIVERGED = 10

    @property
    def message(self) -> str:
        """Explanation of the outcome."""
        return _MESSAGES[self]


_MESSAGES = {
    RolloutStatus.OK: "The robot can execute the motion.",
    RolloutStatus.SPEED_LIMIT: "A joint exceeded its speed limit.",
    RolloutStatus.JOINT_LIMIT: "A joint left its range: move the constraint, or reduce the motion.",
    RolloutStatus.SLIPPED: (
        "The rigid constraint was violated: the arm came near a singular configuration, or moved too fast "
        "for the time step."
    ),
    RolloutStatus.SINGULAR: "The arm stopped in a singular configuration: the goal is out of reach.",
    RolloutStatus.DIVERGED: "The simulation diverged: use a shorter time step, or a softer hand.",
}


def rollout_status(
    track: Track, free: jax.Array, compliance: jax.Array, arm: Arm
) -> tuple[jax.Array, jax.Array]:
    """Compute the status of rollouts.

    Args:
        track: tracks of N rollouts.
        free: (N, 6), 1 where an axis is free.
        compliance: (6,) rad/(N m) and m/N, compliance of the constrained axes; zero is rigid.
        arm: the robot.

    Returns:
        Smallest margin to a joint limit (N,), rad, and status (N,).
    """
    dtype = track.joints.dtype
    lower, upper = jnp.asarray(arm.limits, dtype=dtype)[:, None, None]
    margin = jnp.min(jnp.minimum(track.joints - lower, upper - track.joints), axis=(1, 2))
    fast = jnp.any(jnp.abs(track.velocity) > jnp.asarray(arm.speed, dtype=dtype)[None, None], axis=(1, 2))
    held = jnp.max(jnp.abs(track.slip), axis=1) * (1 - free)
    bound = jnp.asarray([_SLIPPED[0]] * 3 + [_SLIPPED[1]] * 3, dtype=dtype)
    slipped = jnp.any(held > jnp.where(compliance > 0, jnp.inf, bound)[None], axis=1)
    finite = jnp.all(jnp.isfinite(track.joints), axis=(1, 2))
    status = jnp.full(margin.shape, RolloutStatus.OK, dtype=jnp.int32)
    for wrong, code in (
        (fast, RolloutStatus.SPEED_LIMIT),
        (margin < 0, RolloutStatus.JOINT_LIMIT),
        (slipped, RolloutStatus.SLIPPED),
        (~finite, RolloutStatus.DIVERGED),
    ):
        status = jnp.where(wrong, jnp.int32(code), status)
    return margin, status

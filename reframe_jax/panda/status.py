"""Whether a rollout is one the robot could have made."""

from enum import IntEnum

import jax
import jax.numpy as jnp

from reframe_jax.panda.compiled import as_numbers
from reframe_jax.panda.imperfections import Imperfections
from reframe_jax.panda.model import Arm
from reframe_jax.panda.rollout import Track

__all__ = ["RolloutStatus", "judge"]

_SLIPPED = (1e-3, 1e-2)  # rad and m by which a rigid axis must not slip; a sound rollout stays 20 times below


class RolloutStatus(IntEnum):
    """Whether a rollout can be trusted."""

    OK = 0
    SPEED_LIMIT = 1
    JOINT_LIMIT = 2
    SLIPPED = 3
    SINGULAR = 4
    DIVERGED = 10

    @property
    def message(self) -> str:
        """What happened."""
        return _MESSAGES[self]


_MESSAGES = {
    RolloutStatus.OK: "The motion is one the robot can make.",
    RolloutStatus.SPEED_LIMIT: "A joint moved faster than the robot's can.",
    RolloutStatus.JOINT_LIMIT: "A joint left its range: move the constraint, or move less.",
    RolloutStatus.SLIPPED: (
        "The rigid constraint was not kept: the arm came near a singular configuration, or moved too fast "
        "for the step."
    ),
    RolloutStatus.SINGULAR: "The arm stopped in a singular configuration: the goal is out of its reach.",
    RolloutStatus.DIVERGED: "The simulation diverged: take a shorter step, or a softer hand.",
}


def judge(
    track: Track, free: jax.Array, imperfections: Imperfections, arm: Arm
) -> tuple[jax.Array, jax.Array]:
    """Least margin to a joint limit (N,), and status (N,)."""
    dtype = track.joints.dtype
    lower, upper = jnp.asarray(arm.limits, dtype=dtype)[:, None, None]
    margin = jnp.min(jnp.minimum(track.joints - lower, upper - track.joints), axis=(1, 2))
    fast = jnp.any(jnp.abs(track.velocity) > jnp.asarray(arm.speed, dtype=dtype)[None, None], axis=(1, 2))
    held = jnp.max(jnp.abs(track.slip), axis=1) * (1 - free)
    given = as_numbers(imperfections, dtype)
    soft = (given.compliance > 0) | (given.angular_compliance > 0)
    bound = jnp.asarray([_SLIPPED[0]] * 3 + [_SLIPPED[1]] * 3, dtype=dtype)
    slipped = jnp.any(held > bound[None], axis=1) & ~soft
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

"""Integrate constrained motions of the arm, and check whether the real robot could execute them.

The constraint is solved exactly at every step. With the equations of motion M dv/dt + c = tau + J_c^T f,
J_c = A(T) J, the axial velocities u = J_c v at the end of a step h obey, axis by axis,

    u = -(x + C f) / (T + h)      an axis held by a spring of compliance C, or rigidly (C = 0),
    u = -f / d                    a free axis with viscous friction d,
    f = 0                         a free axis,

where x is the slip of the axis, the integral of its velocity over the motion. A rigid axis thus returns to x
= 0 with the time constant T, and no constraint drifts, integrable or not. All three laws are linear, so each
step solves one linear system with a 6x6 matrix for the reaction f.

The dynamics are evaluated at the middle of the step, q + h v / 2. A constraint with turning axes is then
accurate to second order in h. The friction of the joints is implicit.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from reframe_jax.constraints.frame import Frame, locate, slip, twist_map
from reframe_jax.geometry.small import solve_positive, times
from reframe_jax.motion.checks import MessageCode
from reframe_jax.simulation.arm.imperfections import by_axis
from reframe_jax.simulation.arm.model import Arm, Motion, arm_motion, forward_kinematics

RELAXATION = 0.03
"""s, time constant with which a constrained axis returns; also the ratio of damping to stiffness."""

_SLIPPED = (5e-4, 5e-5)  # rad and m, largest slip of a rigid axis; valid rollouts reach half of it


class AxisLaw(NamedTuple):
    """The law along each of the six axes: u = -(offset + softness f) where ``acts`` is 1, f = 0 elsewhere."""

    acts: jax.Array  # (6,)
    offset: jax.Array  # (6,) rad/s or m/s
    softness: jax.Array  # (6,) rad/s per N m or m/s per N


def hold(free: jax.Array, slipped: jax.Array, step: float, compliance: jax.Array) -> AxisLaw:
    """Axis laws that hold the constrained axes rigidly or by springs, and leave the other axes free.

    ``free`` (6,) is 1 for free axes, ``slipped`` (6,) the slip of each axis in rad and m, and ``compliance``
    (6,) in rad/(N m) and m/N, zero for a rigid axis.
    """
    rate = 1 / (RELAXATION + step)
    return AxisLaw(acts=1 - free, offset=rate * slipped, softness=rate * compliance)


class Track(NamedTuple):
    """Motion and forces at the samples of a rollout.

    The forces are those of the environment on the tool, in the step before each sample.
    """

    joints: jax.Array  # (K+1, 7) rad
    velocity: jax.Array  # (K+1, 7) rad/s
    slip: jax.Array  # (K+1, 6) rad and m, displacement along the frame's axes since the start
    force: jax.Array  # (K+1, 6) N m and N, along the frame's axes, with forces at the frame's origin


class Steps(NamedTuple):
    """Number K of samples after the first, steps from one sample to the next, and length of a step, s."""

    samples: int
    substeps: int
    length: float


Drive = Callable[[Any, jax.Array, Motion], tuple[Any, jax.Array]]
"""Function of (state, time in s, arm) that returns (next state, joint torques (7,) in N m)."""


def integrate(
    arm: Arm,
    frame: Frame,
    start: jax.Array,
    drive: Drive,
    state: Any,
    law: Callable[[jax.Array], AxisLaw],
    steps: Steps,
    *,
    velocity: jax.Array | None = None,
) -> Track:
    """Integrate the motion of the arm under the constraint of one rollout.

    The drive, with an initial state, returns the joint torques once per step, at the middle of the step.
    ``law`` is a function from the slip (6,) of the axes to their laws. The motion starts at joint positions
    (7,), rad, with joint velocities (7,), rad/s, which must obey the constraint; zero by default.
    """
    dtype, step = start.dtype, steps.length
    damping = jnp.asarray(arm.damping, dtype=dtype)

    def advance(carry: Any, count: jax.Array) -> tuple[Any, None]:
        joints, velocity, slipped, before, state, _ = carry
        motion = arm_motion(joints + step / 2 * velocity, velocity, arm)
        now = locate(frame, motion.rotation, motion.position)
        slipped = slipped + slip(before, now)
        state, torque = drive(state, (count.astype(dtype) + 0.5) * step, motion)
        rule = law(slipped)
        rows = rule.acts[:, None] * times(twist_map(now), motion.jacobian)
        mass = motion.mass + step * jnp.diag(damping)
        push = torque - motion.bias - damping * velocity
        solved = solve_positive(mass[..., None], jnp.concatenate([rows.T, push[:, None]], axis=1))
        response, unheld = solved[:, :6], velocity + step * solved[:, 6]
        softness = jnp.where(rule.acts > 0, rule.softness, 1)
        wanted = rule.acts * rule.offset + times(rows, unheld)
        force = -solve_positive(step * times(rows, response) + jnp.diag(softness), wanted)
        velocity = unheld + step * times(response, force)
        return (joints + step * velocity, velocity, slipped, now, state, force), None

    def sample(carry: Any, index: jax.Array) -> tuple[Any, Track]:
        carry, _ = jax.lax.scan(advance, carry, index * steps.substeps + jnp.arange(steps.substeps))
        return carry, observe(carry)

    def observe(carry: Any) -> Track:
        joints, velocity, slipped, _, _, force = carry
        return Track(joints, velocity, slipped, force)

    zero = jnp.zeros(6, dtype=dtype)
    velocity = jnp.zeros_like(start) if velocity is None else velocity
    carry = (start, velocity, zero, locate(frame, *forward_kinematics(start, arm)), state, zero)
    _, track = jax.lax.scan(sample, carry, jnp.arange(steps.samples))
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), observe(carry), track)


class RolloutStatus(MessageCode):
    """Whether the real robot could execute a rollout, and otherwise why not; larger codes are worse."""

    OK = 0, "The robot can execute the motion."
    SPEED_LIMIT = 1, "A joint exceeded its speed limit."
    JOINT_LIMIT = 2, "A joint left its range: move the constraint, or reduce the motion."
    SLIPPED = (
        3,
        "The rigid constraint was violated: the arm came near a singular configuration, or moved too fast "
        "for the time step.",
    )
    SINGULAR = 4, "The arm stopped in a singular configuration: the goal is out of reach."
    DIVERGED = 10, "The simulation diverged: use a shorter time step, or a softer hand."


@partial(jax.jit, static_argnames="arm")
def rollout_status(track: Track, free: jax.Array, compliance: jax.Array, arm: Arm) -> jax.Array:
    """Compute the :class:`RolloutStatus` (N,) of N rollouts.

    ``free`` (6,) or (N, 6) is 1 for free axes, ``compliance`` (6,), rad/(N m) and m/N, is 0 for rigid axes.
    """
    dtype = track.joints.dtype
    lower, upper = jnp.asarray(arm.limits, dtype=dtype)[:, None, None]
    outside = jnp.any((track.joints < lower) | (track.joints > upper), axis=(1, 2))
    fast = jnp.any(jnp.abs(track.velocity) > jnp.asarray(arm.speed, dtype=dtype)[None, None], axis=(1, 2))
    held = jnp.max(jnp.abs(track.slip), axis=1) * (1 - free)
    bound = by_axis(_SLIPPED, dtype)
    slipped = jnp.any(held > jnp.where(compliance > 0, jnp.inf, bound)[None], axis=1)
    finite = jnp.all(jnp.isfinite(track.joints), axis=(1, 2))
    status = RolloutStatus
    codes = status.DIVERGED, status.SLIPPED, status.JOINT_LIMIT, status.SPEED_LIMIT
    return jnp.select([~finite, slipped, outside, fast], [*map(jnp.int32, codes)], jnp.int32(status.OK))

"""The compiled program of a demonstration: a hand guides the arm, and the robot records its poses."""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from reframe_jax.constraints.located import Frame, locate, multiply, twist_map
from reframe_jax.geometry import transforms
from reframe_jax.geometry.products import apply
from reframe_jax.simulation.arm.checks import as_numbers
from reframe_jax.simulation.arm.dynamics import arm_motion, solve_positive
from reframe_jax.simulation.arm.guide import Guide, find_excitation, guide_drive, make_hand, stop_at
from reframe_jax.simulation.arm.imperfections import Imperfections, measure
from reframe_jax.simulation.arm.model import Arm, forward_kinematics
from reframe_jax.simulation.arm.rollout import Steps, Track, hold, integrate
from reframe_jax.simulation.arm.status import rollout_status
from reframe_jax.simulation.synthetic import Excitation

__all__ = ["Onset", "Plan", "at_rest", "compliance_of", "demonstration_keys", "impact_velocity", "run_guided"]


@dataclass(frozen=True)
class Plan:
    """Static options of one compiled program."""

    steps: Steps
    dt: float
    excitation: str | Excitation
    arm: Arm


class Onset(NamedTuple):
    """Initial states of N demonstrations, and the time at which they end.

    Attributes:
        joints: (N, 7) rad, initial joint positions.
        velocity: (N, 7) rad/s, initial joint velocities, which obey the constraint.
        end: s, time at which the hand has come to rest; infinite for a hand that keeps moving.
    """

    joints: jax.Array
    velocity: jax.Array
    end: jax.Array


def at_rest(joints: jax.Array) -> Onset:
    """Start at rest at joint positions (N, 7) rad, and keep moving until the end of the recording."""
    return Onset(joints, jnp.zeros_like(joints), jnp.asarray(jnp.inf, dtype=joints.dtype))


def demonstration_keys(key: jax.Array, numbers: jax.Array) -> jax.Array:
    """Random keys (N, 4) of numbered demonstrations, for geometry, hand, excitation and sensors."""
    return jax.vmap(lambda number: jax.random.split(jax.random.fold_in(key, number), 4))(numbers)


@partial(jax.jit, static_argnames="plan")
def run_guided(
    frame: Frame,
    key: jax.Array,
    numbers: jax.Array,
    onset: Onset,
    guide: Guide,
    imperfections: Imperfections,
    *,
    plan: Plan,
) -> dict[str, jax.Array]:
    """Simulate the fields of a demonstration except the truth, with one program for every constraint."""
    keys = demonstration_keys(key, numbers)
    dtype = onset.joints.dtype
    roll = partial(_simulate_one, guide, imperfections, plan, onset.end)
    track = jax.vmap(roll)(frame, keys[:, 1:3], onset.joints, onset.velocity)
    poses = jax.vmap(lambda q, k: measure(q, imperfections, k, plan.arm))(track.joints, keys[:, 3])
    margin, status = rollout_status(track, frame.free, compliance_of(imperfections, dtype), plan.arm)
    return {
        "times": plan.dt * jnp.arange(plan.steps.samples + 1, dtype=dtype),
        "poses": poses,
        "exact_poses": transforms.make_pose(*forward_kinematics(track.joints, plan.arm)),
        "joint_positions": track.joints,
        "joint_velocities": track.velocity,
        "reaction": track.force,
        "slip": track.slip,
        "limit_margin": margin,
        "status_code": status,
    }


def compliance_of(imperfections: Imperfections, dtype: Any) -> jax.Array:
    """Compliance (6,) rad/(N m) and m/N along the axes of a constraint."""
    given = as_numbers(imperfections, dtype)
    return jnp.stack([given.angular_compliance] * 3 + [given.compliance] * 3)


def _simulate_one(
    guide: Guide,
    imperfections: Imperfections,
    plan: Plan,
    end: jax.Array,
    frame: Frame,
    keys: jax.Array,
    start: jax.Array,
    velocity: jax.Array,
) -> Track:
    """Simulate one demonstration."""
    dtype, step = start.dtype, plan.steps.length
    hand = make_hand(guide, keys[0], dtype)
    excitation = stop_at(end, find_excitation(plan.excitation, keys[1], frame.free))
    drive = guide_drive(guide, hand, frame, excitation, step)
    pose = transforms.make_pose(*forward_kinematics(start, plan.arm))
    compliance = compliance_of(imperfections, dtype)
    return integrate(
        plan.arm,
        frame,
        start,
        drive,
        pose,
        lambda slipped: hold(frame.free, slipped, step, compliance),
        plan.steps,
        velocity=velocity,
    )


@partial(jax.jit, static_argnames="arm")
def impact_velocity(frame: Frame, joints: jax.Array, velocity: jax.Array, *, arm: Arm) -> jax.Array:
    """Joint velocities (N, 7), rad/s, after constraints become active: an impact without rebound."""

    def one(frame: Frame, joints: jax.Array, velocity: jax.Array) -> jax.Array:
        motion = arm_motion(joints, velocity, arm)
        located = locate(frame, motion.rotation, motion.position)
        held = 1 - frame.free
        rows = held[:, None] * multiply(twist_map(located), motion.jacobian)
        response = solve_positive(motion.mass, rows.T)
        # free axes have zero rows; a one on their diagonal gives a zero impulse
        impulse = solve_positive(
            multiply(rows, response) + jnp.diag(frame.free), multiply(rows, velocity)[:, None]
        )
        return velocity - apply(response, impulse[:, 0])

    return jax.vmap(one)(frame, joints, velocity)

"""The compiled programs of a demonstration: a hand guides the arm, and the robot records its poses."""

from functools import partial

import jax
import jax.numpy as jnp

from reframe_jax.constraints.located import Frame, locate, multiply, twist_map
from reframe_jax.geometry import transforms
from reframe_jax.simulation.arm.dynamics import arm_motion, solve_positive
from reframe_jax.simulation.arm.guide import find_excitation, guide_drive, stop_at
from reframe_jax.simulation.arm.imperfections import Imperfections, compliance_of, measure
from reframe_jax.simulation.arm.model import Arm, forward_kinematics
from reframe_jax.simulation.arm.rollout import AxisLaw, Steps, Track, hold, integrate
from reframe_jax.simulation.synthetic import Excitation


def demonstration_keys(key: jax.Array, numbers: jax.Array) -> jax.Array:
    """Random keys (N, 4) of numbered demonstrations, for geometry, hand, excitation and sensors."""
    return jax.vmap(lambda number: jax.random.split(jax.random.fold_in(key, number), 4))(numbers)


@partial(jax.jit, static_argnames=("steps", "excitation", "arm"))
def run_guided(
    frame: Frame,
    key: jax.Array,
    numbers: jax.Array,
    joints: jax.Array,
    velocity: jax.Array,
    end: jax.Array,
    imperfections: Imperfections,
    *,
    steps: Steps,
    excitation: str | Excitation,
    arm: Arm,
) -> Track:
    """Simulate N demonstrations with given numbers (N,), with one program for every constraint.

    They start at joint positions and velocities (N, 7), rad and rad/s, which obey the constraints. At the
    time ``end`` (s), the hand has come to rest; an infinite time means that the hand keeps moving.
    """
    step, compliance = steps.length, compliance_of(imperfections, joints.dtype)

    def simulate_one(frame: Frame, keys: jax.Array, start: jax.Array, velocity: jax.Array) -> Track:
        velocities = stop_at(end, find_excitation(excitation, keys[1], frame.free))
        drive = guide_drive(keys[0], frame, velocities, step)
        pose = transforms.make_pose(*forward_kinematics(start, arm))

        def law(slipped: jax.Array) -> AxisLaw:
            return hold(frame.free, slipped, step, compliance)

        return integrate(arm, frame, start, drive, pose, law, steps, velocity=velocity)

    return jax.vmap(simulate_one)(frame, demonstration_keys(key, numbers)[:, 1:3], joints, velocity)


@partial(jax.jit, static_argnames="arm")
def record(
    joints: jax.Array, key: jax.Array, numbers: jax.Array, imperfections: Imperfections, *, arm: Arm
) -> tuple[jax.Array, jax.Array]:
    """Compute recorded and true poses (N, K+1, 4, 4), m, from joint positions (N, K+1, 7), rad."""
    keys = demonstration_keys(key, numbers)[:, 3]
    poses = jax.vmap(lambda q, key: measure(q, imperfections, key, arm))(joints, keys)
    return poses, transforms.make_pose(*forward_kinematics(joints, arm))


@partial(jax.jit, static_argnames="arm")
def impact_velocity(frame: Frame, joints: jax.Array, velocity: jax.Array, *, arm: Arm) -> jax.Array:
    """Compute joint velocities (N, 7), rad/s, after constraints become active: an impact without rebound."""

    def one(frame: Frame, joints: jax.Array, velocity: jax.Array) -> jax.Array:
        motion = arm_motion(joints, velocity, arm)
        located = locate(frame, motion.rotation, motion.position)
        rows = (1 - frame.free)[:, None] * multiply(twist_map(located), motion.jacobian)
        response = solve_positive(motion.mass, rows.T)
        # free axes have zero rows; a one on their diagonal gives a zero impulse
        stopping = multiply(rows, response) + jnp.diag(frame.free)
        impulse = solve_positive(stopping, multiply(rows, velocity)[:, None])
        return velocity - multiply(response, impulse)[:, 0]

    return jax.vmap(one)(frame, joints, velocity)

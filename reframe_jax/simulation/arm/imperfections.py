"""Errors of the robot and its sensors: the differences between a recording and the true motion."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from reframe_jax.geometry import rotations, transforms
from reframe_jax.geometry.products import matmul
from reframe_jax.simulation.arm.compiled import as_numbers
from reframe_jax.simulation.arm.model import Arm, forward_kinematics, link_transforms
from reframe_jax.simulation.synthetic import add_pose_noise

__all__ = ["ENCODER_GRADE", "MATCHED", "REALISTIC", "Imperfections", "measure"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Imperfections:
    """Imperfections of a demonstration, all zero by default.

    The compliances change the motion; all other imperfections change the recording only.

    Attributes:
        compliance: m/N, compliance of the tool and its mount along constrained translations.
        angular_compliance: rad/(N m), compliance along constrained rotations.
        encoder_noise: rad, standard deviation of every joint reading.
        encoder_step: rad, resolution of joint readings; 0 for no rounding.
        backlash: rad, width of the play between a joint and its encoder.
        calibration: m, standard deviation per component of the errors of link positions in the robot's
            kinematic model, constant in a demonstration.
        angular_calibration: rad, standard deviation per component of the errors of link orientations,
            including joint offsets.
        latency: s, delay of recorded orientations relative to recorded positions.
        pose_noise: m, standard deviation per component of the position noise. The rotation vector has noise
            with 3 rad/m times this value (paper, section 5.1).
        dropouts: probability that a sample is lost and the previous sample is repeated.
    """

    compliance: float | jax.Array = 0.0
    angular_compliance: float | jax.Array = 0.0
    encoder_noise: float | jax.Array = 0.0
    encoder_step: float | jax.Array = 0.0
    backlash: float | jax.Array = 0.0
    calibration: float | jax.Array = 0.0
    angular_calibration: float | jax.Array = 0.0
    latency: float | jax.Array = 0.0
    pose_noise: float | jax.Array = 0.0
    dropouts: float | jax.Array = 0.0


ENCODER_GRADE = Imperfections(encoder_noise=1e-5, encoder_step=1.2e-5)
"""A rigid set-up with 19-bit encoders and one step of noise: 10 to 20 um at the tool."""

REALISTIC = Imperfections(encoder_noise=1e-5, encoder_step=1.2e-5, compliance=1e-4, angular_compliance=2.5e-3)
"""The same encoders, and the compliance of a robot that is bolted to a mechanism.

The compliance gives about a third of the RMS velocities along constrained rotations in the paper's Table 4.
"""

MATCHED = Imperfections(encoder_noise=1e-5, encoder_step=1.2e-5, compliance=1e-4, angular_compliance=8e-3)
"""A compliance that reproduces the RMS velocities along constrained axes in the paper's Table 4.

The values apply to motions as fast as in the paper (``excitation="brisk"``): 1-6 mm/s, and 20-60 mrad/s on
the Panda or up to 75 mrad/s on the FR3.
"""


def measure(
    joints: jax.Array, velocity: jax.Array, dt: float, what: Imperfections, key: jax.Array, arm: Arm
) -> jax.Array:
    """Simulate the poses that the robot records.

    Args:
        joints: (K+1, 7) rad, true joint positions.
        velocity: (K+1, 7) rad/s, true joint velocities.
        dt: s, time between samples.
        what: the imperfections.
        key: JAX random key of the imperfections.
        arm: the robot.

    Returns:
        Recorded poses (K+1, 4, 4), m.
    """
    dtype = joints.dtype
    keys = jax.random.split(key, 6)
    given = as_numbers(what, dtype)
    noise = given.encoder_noise * jax.random.normal(keys[0], joints.shape, dtype)

    def read(angles: jax.Array) -> jax.Array:
        return _round(_play(angles, given.backlash) + noise, given.encoder_step)

    links = _as_built(arm, given.calibration, given.angular_calibration, keys[1])
    late = _delayed_joints(joints, velocity, given.latency, dt)
    _, position = forward_kinematics(read(joints), arm, links=links)
    rotation, _ = forward_kinematics(read(late), arm, links=links)
    poses = transforms.make_pose(rotation, position)
    noisy = add_pose_noise(poses, keys[2], given.pose_noise)
    # without noise, the logarithm and exponential would only add rounding errors
    poses = jnp.where(given.pose_noise > 0, noisy, poses)
    return _repeat_last(poses, jax.random.uniform(keys[3], joints.shape[:1], dtype) < given.dropouts)


def _play(angles: jax.Array, width: jax.Array) -> jax.Array:
    """The play operator (backlash): the output moves only if the input pushes it."""

    def advance(output: jax.Array, angle: jax.Array) -> tuple[jax.Array, jax.Array]:
        output = jnp.clip(output, angle - width / 2, angle + width / 2)
        return output, output

    return jax.lax.scan(advance, angles[0], angles)[1]


def _round(angles: jax.Array, step: jax.Array) -> jax.Array:
    unit = jnp.where(step > 0, step, 1)
    return jnp.where(step > 0, jnp.round(angles / unit) * unit, angles)


def _as_built(arm: Arm, spread: jax.Array, angular: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Links of the robot as built, which differ from its kinematic model."""
    rotations_key, positions_key = jax.random.split(key)
    fixed, offset = (jnp.asarray(part, dtype=spread.dtype) for part in link_transforms(arm))
    turn = angular * jax.random.normal(rotations_key, offset.shape, spread.dtype)
    shift = spread * jax.random.normal(positions_key, offset.shape, spread.dtype)
    return matmul(fixed, rotations.rotation_exp(turn)), offset + shift


def _delayed_joints(joints: jax.Array, velocity: jax.Array, age: jax.Array, dt: float) -> jax.Array:
    """Joint positions at a delay before every sample, by cubic interpolation; constant before the start."""
    count = joints.shape[0]
    when = jnp.clip(jnp.arange(count, dtype=joints.dtype) - age / dt, 0, count - 1)
    left = jnp.clip(jnp.floor(when).astype(jnp.int32), 0, count - 2)
    s = (when - left.astype(joints.dtype))[:, None]
    a, b = joints[left], joints[left + 1]
    va, vb = dt * velocity[left], dt * velocity[left + 1]
    cubic = a + s * va + s**2 * (3 * (b - a) - 2 * va - vb) + s**3 * (2 * (a - b) + va + vb)
    return jnp.where(age > 0, cubic, joints)


def _repeat_last(poses: jax.Array, lost: jax.Array) -> jax.Array:
    """Replace lost poses by the last valid pose; the first pose is never lost."""
    index = jnp.arange(poses.shape[0])
    kept = jnp.where(lost & (index > 0), 0, index)
    return poses[jax.lax.cummax(kept)]

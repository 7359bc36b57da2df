"""Errors of the robot and its sensors, which separate a recording from the true motion."""

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
    """Imperfections of a demonstration, all off by default.

    The compliances act on the motion, everything else on the recording.

    Attributes:
        compliance: m/N, by which the tool and its mount give way along constrained translations.
        angular_compliance: rad/(N m), along constrained rotations.
        encoder_noise: rad, standard deviation of every joint reading.
        encoder_step: rad, to which joint readings are rounded; 0 for none.
        backlash: rad, width of the play between a joint and its encoder.
        calibration: m, standard deviation of each component of the links' positions in the kinematic
            model the robot uses, drawn once for a demonstration.
        angular_calibration: rad, the same for the links' orientations, joint offsets included.
        latency: s, by which orientations are older than the positions recorded with them.
        pose_noise: m, standard deviation of each component of the position; those of the rotation
            vector have 3 times as many rad (paper, section 5.1).
        dropouts: probability that a sample is lost and the previous one repeated.
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
"""A rigid set-up read by 19-bit encoders with one step of noise: 10 to 20 um at the tool."""

REALISTIC = Imperfections(encoder_noise=1e-5, encoder_step=1.2e-5, compliance=1e-4, angular_compliance=2.5e-3)
"""Encoders as above, and the give of a robot bolted to a mechanism: about a third of the rms that the
paper's Table 4 shows along constrained rotations."""

MATCHED = Imperfections(encoder_noise=1e-5, encoder_step=1.2e-5, compliance=1e-4, angular_compliance=8e-3)
"""Give so large that, moved as fast as in the paper (``excitation="brisk"``), constrained axes have the
rms of its Table 4: 1-6 mm/s and 20-60 mrad/s on the Panda, up to 75 mrad/s on the FR3."""


def measure(
    joints: jax.Array, velocity: jax.Array, dt: float, what: Imperfections, key: jax.Array, arm: Arm
) -> jax.Array:
    """Return poses as the robot would record them.

    Args:
        joints: (K+1, 7) rad, true joint positions.
        velocity: (K+1, 7) rad/s, their derivatives.
        dt: s, time between samples.
        what: the imperfections.
        key: of their random numbers.
        arm: the robot.

    Returns:
        (K+1, 4, 4), m.
    """
    dtype = joints.dtype
    keys = jax.random.split(key, 6)
    given = as_numbers(what, dtype)
    noise = given.encoder_noise * jax.random.normal(keys[0], joints.shape, dtype)

    def read(angles: jax.Array) -> jax.Array:
        return _round(_play(angles, given.backlash) + noise, given.encoder_step)

    links = _as_built(arm, given.calibration, given.angular_calibration, keys[1])
    late = _at_earlier(joints, velocity, given.latency, dt)
    _, position = forward_kinematics(read(joints), arm, links=links)
    rotation, _ = forward_kinematics(read(late), arm, links=links)
    poses = transforms.make_pose(rotation, position)
    noisy = add_pose_noise(poses, keys[2], given.pose_noise)
    # the logarithm and exponential of the noise would round poses that have none
    poses = jnp.where(given.pose_noise > 0, noisy, poses)
    return _repeat_last(poses, jax.random.uniform(keys[3], joints.shape[:1], dtype) < given.dropouts)


def _play(angles: jax.Array, width: jax.Array) -> jax.Array:
    """The play operator: an output that follows only when the input pushes it."""

    def advance(output: jax.Array, angle: jax.Array) -> tuple[jax.Array, jax.Array]:
        output = jnp.clip(output, angle - width / 2, angle + width / 2)
        return output, output

    return jax.lax.scan(advance, angles[0], angles)[1]


def _round(angles: jax.Array, step: jax.Array) -> jax.Array:
    unit = jnp.where(step > 0, step, 1)
    return jnp.where(step > 0, jnp.round(angles / unit) * unit, angles)


def _as_built(arm: Arm, spread: jax.Array, angular: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Links of a robot that is not exactly what its model says."""
    rotations_key, positions_key = jax.random.split(key)
    fixed, offset = (jnp.asarray(part, dtype=spread.dtype) for part in link_transforms(arm))
    turn = angular * jax.random.normal(rotations_key, offset.shape, spread.dtype)
    shift = spread * jax.random.normal(positions_key, offset.shape, spread.dtype)
    return matmul(fixed, rotations.rotation_exp(turn)), offset + shift


def _at_earlier(joints: jax.Array, velocity: jax.Array, age: jax.Array, dt: float) -> jax.Array:
    """Joint positions an age before every sample, by cubic interpolation; the first one before the start."""
    count = joints.shape[0]
    when = jnp.clip(jnp.arange(count, dtype=joints.dtype) - age / dt, 0, count - 1)
    left = jnp.clip(jnp.floor(when).astype(jnp.int32), 0, count - 2)
    s = (when - left.astype(joints.dtype))[:, None]
    a, b = joints[left], joints[left + 1]
    va, vb = dt * velocity[left], dt * velocity[left + 1]
    cubic = a + s * va + s**2 * (3 * (b - a) - 2 * va - vb) + s**3 * (2 * (a - b) + va + vb)
    return jnp.where(age > 0, cubic, joints)


def _repeat_last(poses: jax.Array, lost: jax.Array) -> jax.Array:
    """Poses with the lost ones replaced by the last that was not; the first is never lost."""
    index = jnp.arange(poses.shape[0])
    kept = jnp.where(lost & (index > 0), 0, index)
    return poses[jax.lax.cummax(kept)]

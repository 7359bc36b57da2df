"""Simulate motions with random geometry and the errors of a tracker.

All functions work under ``vmap`` and ``jit`` with explicit keys. The integrator compiles once per number of
samples and excitation, independent of the constraint, its geometry, the sample time and the errors.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from reframe_jax.constraints.catalogue import constraint
from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.geometry import rotations, transforms
from reframe_jax.geometry.products import apply, matmul
from reframe_jax.simulation.synthetic import Excitation, Simulation, pitch_of, simulate

__all__ = ["PoseErrors", "disturb", "random_constraint", "random_motion"]

_REACH = 0.5  # m, half the width of the cubes in which positions are drawn


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PoseErrors:
    """Errors of a tracker, as numbers or scalar arrays, so that errors can be batched.

    Attributes:
        sigma: m, standard deviation of white noise in each component of the position.
        rotation_ratio: rad/m, ratio of orientation errors to position errors, for every error of this class.
        outliers: fraction of poses that are outliers, each for one sample.
        jump: m, standard deviation of an outlier in each component of the position.
        slow: m, standard deviation of drift, a first-order autoregressive process.
        slow_time: s, time after which the correlation of the drift has decreased to 1/e.
        rounding: m, rounding of positions, 0 for none. Quaternions are rounded to ``rotation_ratio`` / 2
            times this value, which gives orientation errors in the ratio ``rotation_ratio``.
    """

    sigma: float | jax.Array = 0.0
    rotation_ratio: float | jax.Array = 3.0
    outliers: float | jax.Array = 0.0
    jump: float | jax.Array = 0.05
    slow: float | jax.Array = 0.0
    slow_time: float | jax.Array = 1.0
    rounding: float | jax.Array = 0.0


@jax.jit
def disturb(poses: jax.Array, key: jax.Array, errors: PoseErrors, dt: float | jax.Array) -> jax.Array:
    """Add the errors of a tracker to poses (K+1, 4, 4), m, with a sample time, s.

    Orientation errors are rotations about the axes of the ground: R becomes exp(e) R. The noise depends on
    the key only; other error sizes scale the same noise.
    """
    errors = jax.tree.map(lambda size: jnp.asarray(size, dtype=poses.dtype), errors)
    white_key, which_key, jump_key, slow_key = jax.random.split(key, 4)
    shape, dtype = (poses.shape[0], 6), poses.dtype
    sizes = jnp.concatenate([jnp.full(3, errors.rotation_ratio), jnp.ones(3, dtype)])[None]
    jumps = jax.random.bernoulli(which_key, errors.outliers, shape[:1]).astype(dtype)[:, None]
    error = errors.sigma * jax.random.normal(white_key, shape, dtype)
    error = error + errors.jump * jumps * jax.random.normal(jump_key, shape, dtype)
    memory = jnp.exp(-dt / errors.slow_time).astype(dtype)
    error = error + errors.slow * _autoregression(jax.random.normal(slow_key, shape, dtype), memory)
    turn, shift = jnp.split(sizes * error, 2, axis=-1)
    rotation = matmul(rotations.rotation_exp(turn), poses[:, :3, :3])
    quaternion = _rounded(rotations.rotation_to_quaternion(rotation), errors.rotation_ratio / 2, errors)
    quaternion = quaternion / jnp.linalg.norm(quaternion, axis=-1, keepdims=True)
    rotation = jnp.where(errors.rounding > 0, rotations.quaternion_to_rotation(quaternion), rotation)
    return transforms.make_pose(rotation, _rounded(poses[:, :3, 3] + shift, 1.0, errors))


def random_constraint(
    label: str, key: jax.Array, *, linear_type: LinearType | None = None
) -> tuple[ConstraintFrame, jax.Array]:
    """Draw a constraint with random geometry, and a random first pose (4, 4) of the body, m.

    The frame has a random orientation, and its origin is within 0.5 m of the body's origin along each axis at
    the start. The body has a random orientation, and its origin is within 0.5 m of the ground's origin. The
    angular and the linear axes are fixed in the same body, so the constraint is the same for every first
    pose. All labels have the same geometry for a key, but may express it in another body. ``linear_type`` is
    as in :meth:`ConstraintFrame.named`.
    """
    entry = constraint(label)
    kind = entry.linear_type if linear_type is None else linear_type
    rotvec, in_body, in_ground, start = _geometry(key)
    in_the_ground = kind is not None and kind.position_body == AngularType.G
    position = in_ground if in_the_ground else in_body
    frame = ConstraintFrame.named(entry.label, linear_type=kind, rotvec=rotvec, position=position)
    return frame, start


def random_motion(
    label: str,
    key: jax.Array,
    *,
    samples: int,
    dt: float,
    excitation: str | Excitation = "hand",
    errors: PoseErrors = PoseErrors(),
) -> Simulation:
    """Simulate a motion under a constraint with random geometry, with the errors of a tracker.

    For a given key and a given ``samples * dt``, the geometry and the motion are the same at every sample
    time and for all errors.

    Args:
        label: label or name of a constraint.
        key: JAX random key of the geometry, the excitation and the errors.
        samples: K, number of steps.
        dt: sample time, s; not an array.
        excitation: a name of :data:`reframe_jax.simulation.synthetic.EXCITATIONS`, or a function of time.
        errors: errors of the tracker; none by default.

    Returns:
        The recording with K + 1 poses; the first of its ``exact_poses`` is the first pose.

    Raises:
        KeyError: for an unknown label.
        ValueError: for an unknown excitation.
    """
    geometry_key, motion_key, error_key = jax.random.split(key, 3)
    frame, start = random_constraint(label, geometry_key)
    options: Any = {"duration": samples * dt, "dt": dt, "excitation": excitation, "pitch": pitch_of(label)}
    exact = simulate(frame, motion_key, start=start, **options).exact_poses
    times = dt * jnp.arange(samples + 1, dtype=exact.dtype)
    return Simulation(times, disturb(exact, error_key, errors, dt), exact, frame)


@jax.jit
def _geometry(key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Orientation (3,) rad, position (3,) m in the body and in the ground, and first pose (4, 4)."""
    turn_key, start_key, here_key, there_key = jax.random.split(key, 4)
    rotation = rotations.quaternion_to_rotation(_random_quaternion(start_key))
    in_body, away = (
        jax.random.uniform(k, (3,), minval=-_REACH, maxval=_REACH, dtype=float) for k in (here_key, there_key)
    )
    rotvec = rotations.rotation_log(rotations.quaternion_to_rotation(_random_quaternion(turn_key)))
    return rotvec, in_body, apply(rotation, in_body) + away, transforms.make_pose(rotation, away)


def _random_quaternion(key: jax.Array) -> jax.Array:
    """Quaternion (4,) with a uniform distribution over all rotations."""
    four = jax.random.normal(key, (4,), dtype=float)
    return four / jnp.linalg.norm(four)


def _autoregression(white: jax.Array, memory: jax.Array) -> jax.Array:
    """Autoregressive noise (K, n) of unit variance, with a given correlation of consecutive samples."""
    fresh = jnp.sqrt(1 - memory**2)

    def advance(last: jax.Array, new: jax.Array) -> tuple[jax.Array, jax.Array]:
        now = memory * last + fresh * new
        return now, now

    return jnp.concatenate([white[:1], jax.lax.scan(advance, white[0], white[1:])[1]])


def _rounded(values: jax.Array, ratio: float | jax.Array, errors: PoseErrors) -> jax.Array:
    """Round values to the nearest multiple of the rounding times a ratio; zero means no rounding."""
    digit = jnp.asarray(errors.rounding * ratio)
    unit = jnp.where(digit > 0, digit, 1)
    return jnp.where(digit > 0, unit * jnp.round(values / unit), values)

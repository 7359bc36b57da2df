"""Simulate the errors of a tracker; works under ``vmap`` and ``jit`` with explicit keys."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from reframe_jax.geometry import rotations, transforms
from reframe_jax.geometry.products import matmul

__all__ = ["PoseErrors", "disturb"]


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
    white = jax.random.normal(slow_key, shape, dtype)

    def advance(last: jax.Array, new: jax.Array) -> tuple[jax.Array, jax.Array]:
        now = memory * last + jnp.sqrt(1 - memory**2) * new
        return now, now

    drift = jnp.concatenate([white[:1], jax.lax.scan(advance, white[0], white[1:])[1]])
    error = error + errors.slow * drift
    turn, shift = jnp.split(sizes * error, 2, axis=-1)
    rotation = matmul(rotations.rotation_exp(turn), poses[:, :3, :3])
    digit = errors.rounding * errors.rotation_ratio / 2
    quaternion = round_to(rotations.rotation_to_quaternion(rotation), digit)
    quaternion = quaternion / jnp.linalg.norm(quaternion, axis=-1, keepdims=True)
    rotation = jnp.where(errors.rounding > 0, rotations.quaternion_to_rotation(quaternion), rotation)
    return transforms.make_pose(rotation, round_to(poses[:, :3, 3] + shift, errors.rounding))


def round_to(values: jax.Array, digit: float | jax.Array) -> jax.Array:
    """Round values to the nearest multiple of a digit; zero means no rounding."""
    unit = jnp.where(digit > 0, digit, 1)
    return jnp.where(digit > 0, unit * jnp.round(values / unit), values)

"""Velocities along the axes of identified frames."""

from functools import partial

import jax
import jax.numpy as jnp

from reframe_jax.constraints.located import ground_offset
from reframe_jax.constraints.types import LinearType
from reframe_jax.geometry.products import apply, matmul
from reframe_jax.identification.evidence import LagRule
from reframe_jax.identification.options import Lag, lag_in_samples
from reframe_jax.identification.results import Identification
from reframe_jax.motion import kinematics
from reframe_jax.motion.chords import chord_velocities, moving_chords
from reframe_jax.motion.kinematics import Discretization
from reframe_jax.motion.outliers import repair_poses
from reframe_jax.motion.smoothing import smooth_noise

__all__ = ["frame_velocities"]

_IN_BODY = int(LinearType.GB)  # type whose path is that of a point of the body


def frame_velocities(
    poses: jax.Array,
    steps: jax.Array,
    found: Identification,
    discretization: Discretization = "chord",
    lag: Lag = "auto",
) -> tuple[jax.Array, jax.Array]:
    """Velocities along the axes of the identified frames, over time: what is left where they are zero.

    For one window; use ``jax.vmap`` for many.

    Args:
        poses: (K+1, 4, 4), m.
        steps: (K,) sample times, s.
        found: identification of these poses.
        discretization: the one it was made with.
        lag: the one it was made with; how many samples that came to is in ``found``.

    Returns:
        Angular velocities (K, 3), rad/s, and linear velocities of the origin (K, 3), m/s: in row k those
        between the poses k and k + ``found.lag``. Rows that the identification left out are NaN: the last
        ones, which reach beyond the window, those at outliers, and rest. The RMS of the others are ``rms``
        of the two frames; roughly where the frames are ``refined`` or the position was left a choice.

    Raises:
        ValueError: if the lag is none, or does not go with the discretization.
    """
    rule, _ = lag_in_samples(lag, steps, discretization)
    return _frame_velocities(poses, steps, found, rule, discretization)


@partial(jax.jit, static_argnames=("rule", "discretization"))
def _frame_velocities(
    poses: jax.Array, steps: jax.Array, found: Identification, rule: LagRule, discretization: Discretization
) -> tuple[jax.Array, jax.Array]:
    if rule == "single":
        rates = kinematics.angular_velocities(poses, steps, discretization)[found.angular.type_code]
        maps = kinematics.linear_velocity_maps(poses, steps, discretization)[found.linear.type_code]
        position = found.linear.position
    else:
        centre = jnp.mean(poses[:, :3, 3], axis=0)
        chords = _chords(poses.at[:, :3, 3].add(-centre), steps, found, rule)
        rates = kinematics.rates_of(chords)[:, 0, :, found.angular.type_code, 0].T
        maps = jnp.moveaxis(chords[..., found.linear.type_code, 0], 2, 0)
        position = found.linear.position - ground_offset(centre)[found.linear.type_code]
    velocities = maps[..., 0] + apply(maps[..., 1:], position)
    return matmul(rates, found.angular.axes), matmul(velocities, found.linear.axes)


def _chords(poses: jax.Array, steps: jax.Array, found: Identification, rule: LagRule) -> jax.Array:
    """Velocity maps (3, 4, K, 4, 1) of the chords that took part; NaN elsewhere."""
    times = jnp.concatenate([jnp.zeros_like(steps[:1]), jnp.cumsum(steps)])
    number = jnp.full(1, len(times), jnp.int32)
    repaired, _ = repair_poses(poses[None], times[None], number)
    rotation, position = kinematics.split_poses(repaired)
    counted, lag = found.counted[:, None], found.lag[None]
    noise = found.noise.position[None], found.noise.rotation[None]
    if rule == "auto":
        rotation, position, _ = smooth_noise(rotation, position, times[:, None], counted, number, noise, lag)
    _, paths = kinematics.paths_of(rotation, position, steps[None])
    weights = moving_chords(rotation, position, counted, lag, noise)
    # all that count alike: takes back the weighting
    chords = chord_velocities(paths, times[:, None], lag, weights) * jnp.sqrt(jnp.mean(weights))
    return jnp.where(weights[None, None, :, None] > 0, chords, jnp.nan)

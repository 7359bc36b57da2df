"""Prepare windows for the model: poses without outliers, their noise, features and moments."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.model.features import Features, pose_features
from reframe_jax.model.moments import Moments, scale_moments
from reframe_jax.motion import kinematics
from reframe_jax.motion.checks import window_status
from reframe_jax.motion.noise import constant_components, estimate_noise, unit_of_rounding
from reframe_jax.motion.outliers import repair_poses
from reframe_jax.motion.paths import sections_of

_REACH = 2.0  # half the width of the cube of origins: 2 m, or twice the extent of the motion if that is more

Array = jax.Array


class Prepared(NamedTuple):
    """N windows, prepared for the model."""

    status: Array  # (N,) codes of ``Status``
    centre: Array  # (N, 3) m, mean position of the recorded poses, which is subtracted from all positions
    poses: Array  # (N, P, 4, 4) m, relative to ``centre``
    counted: Array  # (N, P) bool, poses that are neither outliers nor padding
    section: Array | None  # (N, P) int, sections between gaps; None for chosen scales
    steps: Array  # (1, K) or (N, K) durations of the steps, s
    # (N,) number of poses before the padding
    count: Array  # type: ignore[assignment]  # tuple.count
    noise: Array  # (N, 2) m and rad, standard deviation of the white noise of every component
    features: Features  # of the poses; see :mod:`reframe_jax.model`
    moments: Moments  # second moments of the features at all scales
    box: Array  # (N,) m, half the width of the cube of origins


def prepare_windows(
    poses: Array,
    steps: Array,
    count: Array | None,
    bounds: Array | None,
    scales: Array,
    single_steps: bool = False,
) -> Prepared:
    """Check windows, leave out outliers, estimate the noise, and compute the moments of the features.

    Args:
        poses: (N, P, 4, 4) m.
        steps: (K,) or (N, K) durations of the steps, s.
        count: (N,) number of poses in each window, if the poses after them are padding; else None.
        bounds: () m, half the width of the cube of origins; None or NaN for the default.
        scales: () int, see :func:`.take_scales`. Only with -1, outliers are left out and gaps have an effect.
        single_steps: whether the scales are 1, for a smaller program.
    """
    status = window_status(poses, steps)
    failed = status >= 10
    # a failed window gets valid numbers, so that no NaN enters a derivative
    poses = jnp.where(failed[:, None, None, None], _harmless(poses), poses)
    steps = jnp.where(jnp.isfinite(steps) & (steps > 0), steps, 1)
    steps = steps[None] if steps.ndim == 1 else steps
    number = jnp.full(len(poses), poses.shape[1], jnp.int32) if count is None else count
    own = jnp.arange(poses.shape[1], dtype=jnp.int32)[None] < number[:, None]
    total = jnp.sum(jnp.where(own[..., None], poses[:, :, :3, 3], 0), axis=1)
    centre = jax.lax.stop_gradient(total / number.astype(poses.dtype)[:, None])
    poses = poses.at[:, :, :3, 3].add(-centre[:, None])
    rotation, position = kinematics.split_poses(poses)
    counted = own.T
    unit = jax.lax.stop_gradient(unit_of_rounding(position, counted))
    # rounding hides the error of a constant component: without it, the component would count as exact
    constant = jax.lax.stop_gradient(constant_components(position, counted))
    hidden = np.random.default_rng(0).uniform(-0.5, 0.5, (poses.shape[1], 3)).T[:, :, None]
    position = position + jnp.where(constant[:, None], unit * jnp.asarray(hidden, position.dtype), 0)
    times = jnp.concatenate([jnp.zeros_like(steps[:, :1]), jnp.cumsum(steps, axis=1)], axis=1)
    times = jnp.broadcast_to(times, own.shape).T
    section = None
    if not single_steps:
        rotation, position, counted = repair_poses(rotation, position, times, number, unit, scales < 0)
        section = jnp.broadcast_to(sections_of(steps) * (scales < 0), own.shape)
    still = jax.lax.stop_gradient((position, kinematics.turns_of(rotation), times))
    noise = jnp.stack(estimate_noise(*still, counted, unit), axis=1)
    distance = jnp.sqrt(jnp.max(jnp.where(counted, jnp.sum(jnp.square(still[0]), axis=0), 0), axis=0))
    # poses without order give no estimate of the noise except the rounding error
    size = jnp.stack([distance, jnp.full_like(distance, np.pi)], axis=1)
    noise = jnp.where(scales == 0, 4 * float(jnp.finfo(poses.dtype).eps) * size, noise)
    features = pose_features(rotation, position, steps, counted, count)
    moments = scale_moments(features.values, counted.T, count, section, scales == 0)
    box = jnp.maximum(_REACH, _REACH * distance)
    if bounds is not None:
        box = jnp.where(jnp.isnan(bounds), box, jnp.asarray(bounds, box.dtype))
    return Prepared(status, centre, poses, counted.T, section, steps, number, noise, features, moments, box)


def _harmless(poses: Array) -> Array:
    """Return valid poses (P, 4, 4) for failed windows: a body that turns and slides."""
    phase = np.linspace(0, 6, poses.shape[1])
    window = np.tile(np.eye(4), (poses.shape[1], 1, 1))
    cos, sin = np.cos(0.3 * np.sin(phase)), np.sin(0.3 * np.sin(phase))
    window[:, 0, 0], window[:, 0, 1], window[:, 1, 0], window[:, 1, 1] = cos, -sin, sin, cos
    window[:, 0, 3] = 0.1 * np.cos(1.7 * phase)
    return jnp.asarray(window, poses.dtype)

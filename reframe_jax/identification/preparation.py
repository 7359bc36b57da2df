"""Prepare windows for the model: poses without outliers, their noise, features and moments."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry.small import pick
from reframe_jax.model.features import Features, pose_features
from reframe_jax.model.moments import Moments, scale_moments
from reframe_jax.motion import kinematics
from reframe_jax.motion.checks import window_status
from reframe_jax.motion.noise import constant_components, estimate_noise, unit_of_rounding
from reframe_jax.motion.outliers import find_outliers, find_repeats
from reframe_jax.motion.paths import sections_of

REACH = 2.0  # half the width of the cube of origins: 2 m, or twice the extent of the motion if that is more

Array = jax.Array


class Prepared(NamedTuple):
    """N windows, prepared for the model."""

    status: Array  # (N,) codes of ``Status``
    centre: Array  # (N, 3) m, mean position of the recorded poses, which is subtracted from all positions
    poses: Array  # (N, P, 4, 4) m, relative to ``centre``
    counted: Array  # (N, P) bool, given poses that are neither outliers nor padding
    # ---- the rest is without outliers and repeated poses
    section: Array  # (N, P) int, sections between gaps; one section for chosen scales
    steps: Array  # (N, K) durations of the steps, s
    length: Array  # (N,) number of poses
    noise: Array  # (N, 2) m and rad, standard deviation of the white noise of every component
    features: Features  # of the poses; see :mod:`reframe_jax.model`
    moments: Moments  # second moments of the features at all scales
    box: Array  # (N,) m, half the width of the cube of origins


def prepare_windows(
    windows: tuple[Array, Array, Array], bounds: Array, scales: Array, *, single_steps: bool
) -> Prepared:
    """Check windows, leave out outliers, estimate the noise, and compute the moments of the features.

    Windows are their number of poses (N,), after which poses are padding, poses (N, P, 4, 4), m, and the
    steps (N, K), s. The bounds () m are NaN for the default. Only with scales of -1, see
    :func:`.take_scales`, outliers are left out and gaps have an effect. With ``single_steps``, scales are 1.
    """
    count, poses, steps = windows
    status = window_status(poses, steps)
    # a failed window gets valid numbers, so that no NaN enters a derivative
    poses = jnp.where((status >= 10)[:, None, None, None], _harmless(poses), poses)
    steps = jnp.where(jnp.isfinite(steps) & (steps > 0), steps, 1)
    here = jnp.arange(poses.shape[1], dtype=jnp.int32)[:, None]
    own = here < count
    total = jnp.sum(jnp.where(own.T[..., None], poses[:, :, :3, 3], 0), axis=1)
    centre = total / count.astype(poses.dtype)[:, None]
    poses = poses.at[:, :, :3, 3].add(-centre[:, None])
    rotation, position = kinematics.split_poses(poses)
    path = jnp.concatenate([rotation.reshape(9, *own.shape), position])
    unit = jax.lax.stop_gradient(unit_of_rounding(position, own))
    # rounding hides the error of a constant component: without it, the component would count as exact, unless
    # the tracker measures no tilt either
    constant = jax.lax.stop_gradient(constant_components(path, own))
    constant = constant[9:] & ~jnp.any(constant[:9], axis=0)
    random = np.random.default_rng(0).uniform(-0.5, 0.5, (poses.shape[1], 3)).T[:, :, None]
    hidden = jnp.where(constant[:, None], unit * jnp.asarray(random, position.dtype), 0)
    # sections are those of the recording: outliers that are left out make no gap
    section = sections_of(path, steps.T, count) * (scales < 0)
    counted, window = own, (path.at[9:].add(hidden), steps.T, section, count)
    if not single_steps:
        repeated = find_repeats(path, own) & (scales < 0)
        window = _leave_out(window, repeated)
        outliers = find_outliers(*window[:2], window[3], unit, scales < 0)
        counted = own & ~pick(outliers, jnp.cumsum(~repeated, axis=0, dtype=jnp.int32) - 1, 0)
        window = _leave_out(window, outliers)
    path, gaps, section, count = window
    rotation, position, own = path[:9].reshape(3, 3, *own.shape), path[9:], here < count
    times = jnp.pad(jnp.cumsum(gaps, axis=0), ((1, 0), (0, 0)))
    still = jax.lax.stop_gradient((position, kinematics.turns_of(rotation), times))
    deviations, jitter = estimate_noise(*still, own, unit)
    noise = deviations.T
    distance = jnp.sqrt(jnp.max(jnp.where(own, jnp.sum(jnp.square(still[0]), axis=0), 0), axis=0))
    # poses without order give no estimate of the noise except the rounding error
    size = jnp.stack([distance, jnp.full_like(distance, np.pi)], axis=1)
    noise = jnp.where(scales == 0, 4 * float(jnp.finfo(poses.dtype).eps) * size, noise)
    # times that jitter would bend the paths of twists
    own_steps = here[:-1] < count - 1
    mean = jnp.sum(jnp.where(own_steps, gaps, 0), axis=0) / (count - 1).astype(gaps.dtype)
    clock = jnp.where(jitter & own_steps & (scales < 0), mean, gaps)
    features = pose_features(rotation, position, clock.T, count, scales == 0)
    moments = scale_moments(features.values, own.T, count, section.T, scales == 0, times.T)
    box = jnp.maximum(REACH, REACH * distance)
    box = jnp.where(jnp.isnan(bounds), box, jnp.asarray(bounds, box.dtype))
    return Prepared(status, centre, poses, counted.T, section.T, gaps.T, count, noise, features, moments, box)


_Window = tuple[Array, Array, Array, Array]  # path (12, P, N), steps (K, N) in s, sections (P, N), count (N,)


def _leave_out(window: _Window, left: Array) -> _Window:
    """Leave out poses (P, N) bool of windows; padding takes their place."""
    path, steps, section, count = window
    here = jnp.arange(len(left), dtype=jnp.int32)[:, None]

    def shorten(_: None) -> _Window:
        order = jnp.sort(jnp.where(left, len(left) - 1, here), axis=0)
        fewer = count - jnp.sum(left, axis=0, dtype=jnp.int32)
        gaps = jnp.diff(pick(jnp.pad(jnp.cumsum(steps, axis=0), ((1, 0), (0, 0))), order, 0), axis=0)
        gaps = pick(gaps, jnp.minimum(here[:-1], fewer - 2), 0)
        return pick(path, order, 1), jnp.where(fewer < count, gaps, steps), pick(section, order, 0), fewer

    return jax.lax.cond(jnp.any(left), shorten, lambda _: window, None)


def _harmless(poses: Array) -> Array:
    """Return valid poses (P, 4, 4) for failed windows: a body that turns and slides."""
    phase = np.linspace(0, 6, poses.shape[1])
    window = np.tile(np.eye(4), (poses.shape[1], 1, 1))
    cos, sin = np.cos(0.3 * np.sin(phase)), np.sin(0.3 * np.sin(phase))
    window[:, 0, 0], window[:, 0, 1], window[:, 1, 0], window[:, 1, 1] = cos, -sin, sin, cos
    window[:, 0, 3] = 0.1 * np.cos(1.7 * phase)
    return jnp.asarray(window, poses.dtype)

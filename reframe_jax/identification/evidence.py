"""What windows leave for the search: poses to paths, noise, chords and moments.

The evidence has one shape whatever the length of the windows.
"""

from dataclasses import dataclass
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp

from reframe_jax.compilation import once
from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.geometry import symmetric
from reframe_jax.identification.results import (
    PoseNoise,
)
from reframe_jax.motion import kinematics
from reframe_jax.motion.checks import window_status
from reframe_jax.motion.chords import chord_velocities, moving_chords, spread_of
from reframe_jax.motion.kinematics import Discretization
from reframe_jax.motion.noise import choose_lag, estimate_noise
from reframe_jax.motion.outliers import repair_poses
from reframe_jax.motion.smoothing import noise_share, smooth_noise
from reframe_jax.objectives.moments import component_moments

__all__ = [
    "FLOOR",
    "IN_BODY",
    "IN_GROUND",
    "Evidence",
    "LagRule",
    "covariance_moments",
    "reduce_windows",
    "usable_moments",
    "window_moments",
]

LagRule = Literal["auto", "given", "single"]
"""Chords chosen from the noise; of a given number of samples; or consecutive poses, each of which counts."""


FLOOR = 16  # of the covariance, in units of rounding: keeps noise-free windows positive definite


IN_BODY, IN_GROUND = int(LinearType.GB), int(LinearType.BG)  # types whose origin's path is followed


def window_moments(
    poses: jax.Array, steps: jax.Array, discretization: Discretization = "chord"
) -> tuple[jax.Array, jax.Array]:
    """What a window leaves for the search: moments of its angular and linear velocities.

    Args:
        poses: (..., K+1, 4, 4), m.
        steps: (K,) or (..., K) sample times, s.
        discretization: see :func:`reframe_jax.motion.kinematics.linear_velocity_maps`.

    Returns:
        Angular moments (6, 1, ..., 2) and linear moments (6, 10, ..., 4), the last axis over frame
        types. A floor of a few roundings is added to the covariance, below which nothing can be told.
    """
    rates, maps = kinematics.velocity_components(poses, steps, discretization)
    return covariance_moments(rates), covariance_moments(maps)


def covariance_moments(maps: jax.Array, power: int = 1) -> jax.Array:
    """Moments, the types last, of maps (3, columns, K, types, ...), with a floor: rounding ** power."""
    moments = jnp.moveaxis(component_moments(maps), 2, -1)
    squares = [moments[i, j] for i in (0, 3, 5) for j in ((0,) if moments.shape[1] == 1 else (0, 4, 7, 9))]
    rounding = (FLOOR * float(jnp.finfo(moments.dtype).eps)) ** power
    floor = rounding * jax.lax.stop_gradient(jnp.sum(jnp.stack(squares), axis=0))
    return moments.at[jnp.asarray([0, 3, 5]), 0].add(floor[None])


def usable_moments(failed: jax.Array, maps: jax.Array, power: int = 1) -> jax.Array:
    """Moments of maps, see :func:`covariance_moments`; harmless ones for the windows (N,) that failed."""
    unit = jnp.asarray([1, 0, 0, 1, 0, 1], dtype=maps.dtype)[:, None, None, None]
    return once(jnp.where(failed[:, None], unit, covariance_moments(maps, power)))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Evidence:
    """What N windows leave for the search, whatever their length.

    Attributes:
        status: (N,) codes of ``Status``.
        centre: (N, 3) m, mean position of {b}; everything else is relative to it.
        counted: (N, K+1) bool, poses that are neither outliers nor padding.
        noise: of the poses.
        share: (N,) of the noise that is left after averaging neighbours, 1 without.
        lag: (N,) samples between the poses of a chord.
        samples: (N,) independent chords.
        poses: (N,) number of poses that count.
        angular, linear: moments of the chord velocities, (6, 1, N, 2) and (6, 10, N, 4); see
            :mod:`reframe_jax.objectives.moments`.
        angular_spread, linear_spread: moments of the paths about their mean, of the same shapes.
        mean_paths: (3, 4, N, 2) mean paths of the types GB and BG.
        positions: (6, N) m^2, covariance of the positions.
        travel: (2, N) rad^2 and m^2, sum of the squares of all steps.
        rates, maps: the chord velocities themselves, for float32, which cannot hold their squares; else None.
    """

    status: jax.Array
    centre: jax.Array
    counted: jax.Array
    noise: PoseNoise
    share: jax.Array
    lag: jax.Array
    samples: jax.Array
    poses: jax.Array
    angular: jax.Array
    linear: jax.Array
    angular_spread: jax.Array
    linear_spread: jax.Array
    mean_paths: jax.Array
    positions: jax.Array
    travel: jax.Array
    rates: jax.Array | None
    maps: jax.Array | None


def reduce_windows(
    poses: jax.Array,
    steps: jax.Array,
    count: jax.Array | None,
    lag: jax.Array | None,
    rule: LagRule,
    discretization: Discretization,
) -> Evidence:
    """Reduce windows to what the search needs of them.

    Args:
        poses: (N, K+1, 4, 4), m.
        steps: (K,) or (N, K) sample times, s.
        count: (N,) number of poses in each window where the rest is padding, else None.
        lag: (N,) or () samples, for the rule "given".
        rule: what velocities are taken from.
        discretization: see :func:`reframe_jax.motion.kinematics.linear_velocity_maps`; another than
            "chord" only for the rule "single".
    """
    windows, samples = poses.shape[0], poses.shape[1] - 1
    status = window_status(poses, steps)
    failed = status >= 10
    # a failed window computes with harmless numbers, so that no NaN enters a derivative
    poses = jnp.where(failed[:, None, None, None], jnp.eye(4, dtype=poses.dtype)[None, None], poses)
    steps = jnp.where(jnp.isfinite(steps) & (steps > 0), steps, 1)
    number = jnp.full(windows, samples + 1, jnp.int32) if count is None else count
    own = (jnp.arange(samples + 1, dtype=jnp.int32)[None] < number[:, None])[:, :, None]
    total = jnp.sum(jnp.where(own, poses[:, :, :3, 3], 0), axis=1)
    centre = jax.lax.stop_gradient(total / number.astype(poses.dtype)[:, None])
    poses = poses.at[:, :, :3, 3].add(-centre[:, None])
    shared = jnp.broadcast_to(steps, (1, samples)) if steps.ndim == 1 else steps
    times = jnp.concatenate([jnp.zeros_like(shared[:, :1]), jnp.cumsum(shared, axis=1)], axis=1)
    times = jnp.broadcast_to(times, (windows, samples + 1))
    if rule == "single":
        counted = own[:, :, 0]
    else:
        poses, counted = repair_poses(poses, times, number)
    rotation, position = kinematics.split_poses(once(poses))
    counts = counted.T
    measured = jax.lax.stop_gradient((rotation, position))
    noise = estimate_noise(measured[1], kinematics.turns_of(measured[0]), counts)
    one = jnp.ones(windows, jnp.int32)
    width = 0 * one
    if rule == "auto":
        lag = choose_lag(*measured, counts, noise, number)
        rotation, position, width = once(
            smooth_noise(rotation, position, times.T, counts, number, noise, lag)
        )
    lag = one if rule == "single" or lag is None else jnp.minimum(one * lag, number - 1)
    maps, paths = once(kinematics.paths_of(rotation, position, shared, count))
    if rule == "single" and discretization != "chord":
        _, maps = once(kinematics.velocity_components(poses, steps, discretization))
    turns = kinematics.rates_of(maps)[:, 0, :, AngularType.B] * shared.T[None]
    if rule == "single":
        weights = (counts[1:] & counts[:-1]).astype(poses.dtype)
    else:
        weights = moving_chords(*jax.lax.stop_gradient((rotation, position)), counts, lag, noise)
    plain = jnp.all(lag == 1) & jnp.all(weights == 1)

    def chords(_: None) -> jax.Array:
        if rule == "single":
            share = weights / jnp.maximum(jnp.mean(weights, axis=0, keepdims=True), 1 / samples)
            return maps * jnp.sqrt(share)[None, None, :, None]
        return chord_velocities(paths, times.T, lag, weights)

    if count is None and rule == "single":
        velocities = maps
    else:
        velocities = once(jax.lax.cond(plain, lambda _: maps, chords, None))
    rates = kinematics.rates_of(velocities)
    spread, mean = spread_of(paths, counts)
    spread = once(spread)
    about = spread[:, 0, :, IN_BODY]
    moments = partial(usable_moments, failed)
    pairs = (counts[1:] & counts[:-1])[None]
    travel = [
        jnp.sum(jnp.where(pairs, jnp.square(s), 0), axis=(0, 1)) for s in (turns, jnp.diff(position, axis=1))
    ]
    precise = poses.dtype != jnp.float32
    return Evidence(
        status=status,
        centre=centre,
        counted=counted,
        noise=PoseNoise(position=noise[0], rotation=noise[1]),
        share=noise_share(width, poses.dtype),
        lag=lag,
        samples=jnp.maximum(jnp.sum(weights > 0, axis=0, dtype=poses.dtype), 1) / lag.astype(poses.dtype),
        poses=jnp.sum(counts, axis=0, dtype=jnp.int32),
        angular=moments(rates),
        linear=moments(velocities),
        angular_spread=moments(kinematics.rates_of(spread)),
        linear_spread=moments(spread),
        mean_paths=jnp.stack([mean[:, :, t] for t in (IN_BODY, IN_GROUND)], axis=-1),
        positions=jnp.stack([jnp.mean(about[i] * about[j], axis=0) for i, j in symmetric.INDEX_PAIRS]),
        travel=jnp.stack(travel),
        rates=None if precise else rates,
        maps=None if precise else velocities,
    )

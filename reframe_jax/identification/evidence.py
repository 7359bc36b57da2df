"""What windows leave for the search: poses to paths, noise, chords and moments.

The evidence has one shape whatever the length of the windows.
"""

from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple

import jax
import numpy as np

from reframe_jax.arrays import add, jnp, lax
from reframe_jax.compilation import as_one_kernel, once
from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.geometry import symmetric
from reframe_jax.identification.floored_moments import usable_moments
from reframe_jax.identification.results import PoseNoise
from reframe_jax.motion import kinematics
from reframe_jax.motion.checks import window_status
from reframe_jax.motion.chords import chord_velocities, moving_chords, spread_of
from reframe_jax.motion.kinematics import Discretization
from reframe_jax.motion.noise import choose_lag, constant_components, estimate_noise, unit_of_rounding
from reframe_jax.motion.outliers import repair_poses
from reframe_jax.motion.single_axis import (
    SingleAxis,
    TurnMoments,
    find_single_axis,
    keep_axis,
    turn_moments,
)
from reframe_jax.motion.smoothing import noise_share, smooth_noise

__all__ = [
    "IN_BODY",
    "IN_GROUND",
    "Evidence",
    "LagRule",
    "reduce_windows",
]

LagRule = Literal["auto", "given", "single"]
"""Chords chosen from the noise; of a given number of samples; or consecutive poses, each of which counts."""


_UNSEEN = 1e-7  # m, rounding of positions that never change: that of a metre in float32
_SHORT = 1 << 16  # numbers of poses, of windows that one kernel follows on a processor
_ROUNDED = 1.5  # the rounding of positions, below which their noise is that


IN_BODY, IN_GROUND = int(LinearType.GB), int(LinearType.BG)  # types whose origin's path is followed


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Evidence:
    """What N windows leave for the search, whatever their length.

    Attributes:
        status: (N,) codes of ``Status``.
        centre: (N, 3) m, mean position of {b}; everything else is relative to it.
        counted: (N, K+1) bool, poses that are neither outliers nor padding.
        noise: of the poses.
        rounded: (N,) bool, whether rounding of the positions is their noise.
        floor: (N,) m^2/s^2, what it adds to the variance of velocities in every direction: a coordinate that
            rounding made constant is not known any better than the others.
        axis: about which the body turns, for windows that turn about a single one; ``alone``: (N,) bool,
            whether noise that leads away from it was taken out of the linear velocities.
        share: (N,) of the noise that is left after averaging neighbours, 1 without.
        lag: (N,) samples between the poses of a chord.
        samples: (N,) independent chords.
        poses: (N,) number of poses that count.
        angular, linear: moments of the chord velocities, (6, 1, N, 2) and (6, 10, N, 4); see
            :mod:`reframe_jax.objectives.moments`.
        angular_spread, linear_spread: moments of the paths about their mean, of the same shapes.
        mean_paths: (3, 4, N, 2) mean paths of the types GB and BG.
        turning: what moves with the angle about the axis.
        positions: (6, N) m^2, covariance of the positions.
        travel: (2, N) rad^2 and m^2, sum of the squares of all steps.
        rates, maps: the chord velocities themselves, for float32, which cannot hold their squares; else None.
    """

    status: jax.Array
    centre: jax.Array
    counted: jax.Array
    noise: PoseNoise
    rounded: jax.Array
    floor: jax.Array
    axis: SingleAxis
    alone: jax.Array
    share: jax.Array
    lag: jax.Array
    samples: jax.Array
    poses: jax.Array
    angular: jax.Array
    linear: jax.Array
    angular_spread: jax.Array
    linear_spread: jax.Array
    mean_paths: jax.Array
    turning: TurnMoments
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
    status = window_status(poses, steps)
    failed = status >= 10
    # a failed window computes with harmless numbers, so that no NaN enters a derivative
    poses = jnp.where(failed[:, None, None, None], jnp.eye(4, dtype=poses.dtype)[None, None], poses)
    steps = jnp.where(jnp.isfinite(steps) & (steps > 0), steps, 1)
    steps = jnp.broadcast_to(steps, (1, *steps.shape)) if steps.ndim == 1 else steps
    number = jnp.full(poses.shape[0], poses.shape[1], jnp.int32) if count is None else count
    spacing = _spacing(poses)
    poses, centre = _centred(poses, number)
    times = jnp.concatenate([jnp.zeros_like(steps[:, :1]), jnp.cumsum(steps, axis=1)], axis=1)
    times = jnp.broadcast_to(times, (len(poses), times.shape[1]))
    if rule == "single":
        counted = jnp.arange(poses.shape[1], dtype=jnp.int32)[None] < number[:, None]
    else:
        poses, counted = repair_poses(poses, times, number)
    windows = _Windows(status, poses, counted, centre, spacing, steps, times, number)
    follow = partial(_follow, rule=rule, whole=count is None, discretization=discretization)
    return as_one_kernel(follow, windows, lag, most=_SHORT)


class _Windows(NamedTuple):
    """N windows without outliers.

    Attributes:
        status: (N,) codes of ``Status``.
        poses: (N, K+1, 4, 4) m, about their mean position; outliers replaced.
        counted: (N, K+1) bool, poses that are neither outliers nor padding.
        centre: (N, 3) m, that mean position.
        spacing: (N,) m, between neighbouring numbers where positions are largest.
        steps: (1, K) or (N, K) s.
        times: (N, K+1) s.
        number: (N,) of poses, padding left out.
    """

    status: jax.Array
    poses: jax.Array
    counted: jax.Array
    centre: jax.Array
    spacing: jax.Array
    steps: jax.Array
    times: jax.Array
    number: jax.Array


def _follow(
    windows: _Windows, lag: jax.Array | None, *, rule: LagRule, whole: bool, discretization: Discretization
) -> Evidence:
    """Follow the motion of windows; the other arguments are those of :func:`reduce_windows`.

    Args:
        windows: without outliers.
        lag: (N,) or () samples, for the rule "given".
        rule: what velocities are taken from.
        whole: whether no window has padding.
        discretization: of velocities.
    """
    failed, steps, times = windows.status >= 10, windows.steps, windows.times
    motion = _motion(windows, lag, rule)
    noise = motion.share * motion.noise[0], motion.share * motion.noise[1]
    axis = find_single_axis(motion.rotation, motion.position, motion.counted, noise)
    alone = axis.found & (motion.lag > 1) & (rule == "auto")
    count = None if whole else windows.number
    maps, paths, rates, turns = _paths(motion, steps, count, axis._replace(found=alone), rule)
    if discretization != "chord":
        rates, maps = once(kinematics.velocity_components(windows.poses, steps, discretization))
    rates, velocities = _velocities(motion, times.T, (rates, turns), (maps, paths), rule, whole)
    turned, _ = spread_of(turns, motion.counted)
    spread, mean = spread_of(paths, motion.counted)
    turned, spread = once((turned, spread))
    about = spread[:, 0, :, IN_BODY]
    moments = partial(usable_moments, failed)
    rounding = motion.share * motion.rounding
    span = times[:, -1] / steps.shape[1] * motion.lag.astype(times.dtype)
    floor = 2 * jnp.square(rounding / span)
    precise = times.dtype != jnp.float32
    moving = jnp.sum(motion.weights > 0, axis=0, dtype=times.dtype)
    return Evidence(
        status=windows.status,
        centre=windows.centre,
        counted=windows.counted,
        noise=PoseNoise(position=motion.noise[0], rotation=motion.noise[1]),
        rounded=motion.rounding > 0,
        floor=floor,
        axis=axis,
        alone=alone,
        share=motion.share,
        lag=motion.lag,
        samples=jnp.maximum(moving, 1) / motion.lag.astype(times.dtype),
        poses=jnp.sum(motion.counted, axis=0, dtype=jnp.int32),
        angular=moments(rates),
        linear=moments(velocities, floor=floor),
        angular_spread=moments(turned),
        linear_spread=moments(spread, floor=jnp.square(rounding)),
        mean_paths=jnp.stack([mean[:, :, t] for t in (IN_BODY, IN_GROUND)], axis=-1),
        turning=turn_moments(
            axis.in_ground, turned[:, 0, :, AngularType.G], spread[:, :, :, IN_BODY], times.T, motion.counted
        ),
        positions=jnp.stack([jnp.mean(about[i] * about[j], axis=0) for i, j in symmetric.INDEX_PAIRS]),
        travel=_travel(motion, jnp.diff(turns[:, 0, :, AngularType.B], axis=1)),
        rates=None if precise else rates,
        maps=None if precise else velocities,
    )


class _Motion(NamedTuple):
    """The motion of N windows as it is used.

    Attributes:
        rotation, position: (3, 3, K+1, N) and (3, K+1, N) m, averaged over neighbours where that pays.
        counted: (K+1, N) bool, poses that are neither outliers nor padding.
        noise: (N,) m and (N,) rad, of the measured poses.
        rounding: (N,) m, standard deviation of the rounding of positions where it is their noise, else 0.
        share: (N,) of the noise that is left.
        lag: (N,) samples.
        weights: (K, N) of the chords.
    """

    rotation: jax.Array
    position: jax.Array
    counted: jax.Array
    noise: tuple[jax.Array, jax.Array]
    rounding: jax.Array
    share: jax.Array
    lag: jax.Array
    weights: jax.Array


def _centred(poses: jax.Array, number: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Poses about their mean position, and that mean, (N, 3) m; as many of each window count as it has."""
    own = (jnp.arange(poses.shape[1], dtype=jnp.int32)[None] < number[:, None])[:, :, None]
    total = jnp.sum(jnp.where(own, poses[:, :, :3, 3], 0), axis=1)
    centre = lax.stop_gradient(total / number.astype(poses.dtype)[:, None])
    return add(poses, np.s_[:, :, :3, 3], -centre[:, None]), centre


def _motion(windows: _Windows, lag: jax.Array | None, rule: LagRule) -> _Motion:
    """Leave out rest, choose the lag, and average out noise, as far as the rule says so."""
    times, number = windows.times.T, windows.number
    rotation, position = kinematics.split_poses(once(windows.poses))
    counts = windows.counted.T
    measured = lax.stop_gradient((rotation, position))
    noise, rounding = _noise(*measured, counts, windows.spacing)
    one = jnp.ones_like(number)
    width = jnp.zeros_like(number)
    if rule == "auto":
        lag = choose_lag(*measured, counts, noise, number)
        rotation, position, width = once(smooth_noise(rotation, position, times, counts, number, noise, lag))
    share = noise_share(width, position.dtype)
    if rule == "single" or lag is None:
        weights = (counts[1:] & counts[:-1]).astype(position.dtype)
        return _Motion(rotation, position, counts, noise, rounding, share, one, weights)
    lag = jnp.minimum(one * lag, number - 1)
    weights = moving_chords(*lax.stop_gradient((rotation, position)), counts, lag, noise)
    return _Motion(rotation, position, counts, noise, rounding, share, lag, weights)


def _spacing(poses: jax.Array) -> jax.Array:
    """Distance between neighbouring numbers where positions are largest, (N,) m.

    Numbers that float32 holds exactly have most likely passed through it.
    """
    position = lax.stop_gradient(poses[:, :, :3, 3])
    single = jnp.finfo(jnp.float32)
    narrow = lax.reduce_precision(position, single.nexp, single.nmant)
    passed = jnp.all(narrow == position, axis=(1, 2))
    eps = jnp.where(passed, float(single.eps), float(jnp.finfo(position.dtype).eps))
    return eps.astype(position.dtype) * jnp.max(jnp.abs(position), axis=(1, 2))


def _noise(
    rotation: jax.Array, position: jax.Array, counted: jax.Array, spacing: jax.Array
) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
    """The noise of poses, (N,) m and (N,) rad, and what rounding has of it where that is most, else 0."""
    turns = kinematics.turns_of(rotation)
    of_position, of_rotation = estimate_noise(position, turns, counted)
    constant = constant_components(position, counted)
    # of positions that never change, as of a sensor of orientation alone, no noise can be seen
    spacing = jnp.where(jnp.all(constant, axis=0), jnp.maximum(spacing, _UNSEEN), spacing)
    rounding = jnp.maximum(unit_of_rounding(position, counted), spacing) / 12**0.5
    of_position = jnp.maximum(of_position, rounding)
    # a coordinate that never changes, of a body that turns in every way, is not known any better
    still = jnp.any(constant, axis=0)
    turning = ~jnp.any(constant_components(turns, counted[1:] & counted[:-1], 1), axis=0)
    rounding = jnp.where(still & turning, of_position, rounding)
    return (of_position, of_rotation), jnp.where(of_position < _ROUNDED * rounding, rounding, 0)


def _paths(
    motion: _Motion, steps: jax.Array, count: jax.Array | None, axis: SingleAxis, rule: LagRule
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Velocities of single steps and paths, linear ones first, then angular ones.

    The linear ones of windows with a single axis are those of rotations that keep it, the angular ones are
    those of the rotations as they are.
    """
    rotation = motion.rotation
    if rule == "auto":
        rotation = once(lax.cond(jnp.any(axis.found), keep_axis, lambda same, _: same, rotation, axis))
    maps, paths = once(kinematics.paths_of(rotation, motion.position, steps, count))
    rates, turns = once((kinematics.rates_of(maps), kinematics.rates_of(paths)))
    if rule != "auto":
        return maps, paths, rates, turns

    def as_measured(kept: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        rates = kinematics.turn_rates(motion.rotation, steps, count)
        turns = kinematics.turn_paths(rates, steps)
        return jnp.where(axis.found, rates[:, None], kept[0]), jnp.where(axis.found, turns[:, None], kept[1])

    rates, turns = once(lax.cond(jnp.any(axis.found), as_measured, lambda kept: kept, (rates, turns)))
    return maps, paths, rates, turns


def _velocities(
    motion: _Motion,
    times: jax.Array,
    angular: tuple[jax.Array, jax.Array],
    linear: tuple[jax.Array, jax.Array],
    rule: LagRule,
    whole: bool,
) -> tuple[jax.Array, jax.Array]:
    """Velocities of all chords, from those of single steps and from paths, of both groups.

    Args:
        motion: of the windows.
        times: (K+1, N) s.
        angular: angular velocities of single steps, and their paths.
        linear: linear velocities of single steps, and their paths.
        rule: "single" for single steps.
        whole: whether no window has padding.
    """
    steps = angular[0], linear[0]
    if rule == "single" and whole:
        return steps
    weights = motion.weights

    def chords(_: None) -> tuple[jax.Array, jax.Array]:
        if rule == "single":
            share = weights / jnp.maximum(jnp.mean(weights, axis=0, keepdims=True), 1 / len(weights))
            scale = jnp.sqrt(share)[None, None, :, None]
            return steps[0] * scale, steps[1] * scale
        of_angular, of_linear = (
            chord_velocities(path, times, motion.lag, weights) for path in (angular[1], linear[1])
        )
        # a window whose chords are its steps has the same numbers whatever the other windows are
        own = plain[None, None, None, None]
        return jnp.where(own, steps[0], of_angular), jnp.where(own, steps[1], of_linear)

    plain = (motion.lag == 1) & jnp.all(weights == 1, axis=0)
    return once(lax.cond(jnp.all(plain), lambda _: steps, chords, None))


def _travel(motion: _Motion, turns: jax.Array) -> jax.Array:
    """Sum of the squares of all steps, (2, N) rad^2 and m^2, from their rotation vectors (3, K, N)."""
    pairs = (motion.counted[1:] & motion.counted[:-1])[None]
    moves = turns, jnp.diff(motion.position, axis=1)
    return jnp.stack([jnp.sum(jnp.where(pairs, jnp.square(move), 0), axis=(0, 1)) for move in moves])

"""Identification of windows that have been checked: pure functions of arrays.

poses -> paths, noise, chords -> moments: :func:`reduce_windows`; its result, the evidence, has one shape
whatever the length of the windows. Moments -> optimum of every type -> degrees of freedom ->
Identification: :func:`solve_evidence`.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.compilation import once
from reframe_jax.constraints.located import ground_offset
from reframe_jax.constraints.types import LinearType
from reframe_jax.geometry import rotations, symmetric
from reframe_jax.geometry.products import matmul3
from reframe_jax.identification.classify import (
    Thresholds,
    degrees_of_freedom,
    excess_over,
    free_rotations,
    nearest_origin,
    tie_margin,
    tied_types,
)
from reframe_jax.identification.freedom import freedom_patterns, type_weights
from reframe_jax.identification.results import (
    AllCandidates,
    AngularFrame,
    Candidates,
    Identification,
    LinearFrame,
    PoseNoise,
)
from reframe_jax.identification.twins import find_twins
from reframe_jax.motion import kinematics
from reframe_jax.motion.checks import Status, window_status
from reframe_jax.motion.chords import chord_velocities, moving_chords, spread_of
from reframe_jax.motion.kinematics import Discretization
from reframe_jax.motion.noise import choose_lag, estimate_noise
from reframe_jax.motion.outliers import repair_poses
from reframe_jax.objectives.moments import component_moments, covariance_at
from reframe_jax.objectives.norms import log_power_mean, principal_axes
from reframe_jax.objectives.velocity import PositionObjective
from reframe_jax.solvers import Box, Solution, Solver, ValleySteps
from reframe_jax.solvers.implicit import attach_derivative

__all__ = ["Evidence", "LagRule", "identify_windows", "reduce_windows", "solve_evidence", "window_moments"]

LagRule = Literal["auto", "given", "single"]
"""Chords chosen from the noise; of a given number of samples; or consecutive poses, each of which counts."""

_FLOOR = 16  # of the covariance, in units of rounding: keeps noise-free windows positive definite
_TOUCH_UP = 16  # steps that follow when velocities are seen from the optimum
_REFINING = 5  # steps from the optimum of velocities to that of displacements
_WHITE = 2.0  # noises that constrained axes show at most where the noise is white
_IN_BODY, _IN_GROUND = int(LinearType.GB), int(LinearType.BG)  # types whose origin's path is followed


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
    return _moments(rates), _moments(maps)


def _moments(maps: jax.Array, power: int = 1) -> jax.Array:
    """Moments, the types last, of maps (3, columns, K, types, ...), with a floor: rounding ** power."""
    moments = jnp.moveaxis(component_moments(maps), 2, -1)
    squares = [moments[i, j] for i in (0, 3, 5) for j in ((0,) if moments.shape[1] == 1 else (0, 4, 7, 9))]
    rounding = (_FLOOR * float(jnp.finfo(moments.dtype).eps)) ** power
    floor = rounding * jax.lax.stop_gradient(jnp.sum(jnp.stack(squares), axis=0))
    return moments.at[jnp.asarray([0, 3, 5]), 0].add(floor[None])


def _seen_from(maps: jax.Array, axes: jax.Array, origin: jax.Array | None = None) -> jax.Array:
    """The maps (3, columns, K, types, N) along axes (N, types, 3, 3), from an origin (3, N, types).

    Squares do not fit float32: one axis moves 1e5 times faster than another, and rounding of the one
    hides the square of the other. Seen along its axes from the optimum, each velocity is squared by
    itself, and float32 is as good as its digits. (The same as a square root of the moments, cheaper.)
    """
    e = jnp.transpose(axes, (2, 3, 1, 0))[:, :, None, None]
    turned = e[0][:, :] * maps[0, None] + e[1][:, :] * maps[1, None] + e[2][:, :] * maps[2, None]
    if origin is None:
        return turned
    p = jnp.swapaxes(origin, 1, 2)[:, None, None]
    moved = turned[:, 0] + turned[:, 1] * p[0] + turned[:, 2] * p[1] + turned[:, 3] * p[2]
    return jnp.concatenate([moved[:, None], turned[:, 1:]], axis=1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Evidence:
    """What N windows leave for the search, whatever their length.

    Attributes:
        status: (N,) codes of ``Status``.
        centre: (N, 3) m, mean position of {b}; everything else is relative to it.
        counted: (N, K+1) bool, poses that are neither outliers nor padding.
        noise: of the poses.
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
    if rule == "single":
        counted = own[:, :, 0]
    else:
        times_of_all = jnp.broadcast_to(times, (windows, samples + 1))
        poses, counted = repair_poses(poses, times_of_all, number)
    poses = once(poses)
    maps, paths = once(kinematics.velocity_paths(poses, steps, count))
    if rule == "single" and discretization != "chord":
        _, maps = once(kinematics.velocity_components(poses, steps, discretization))
    rotation, position = paths[:, 1:, :, _IN_BODY], paths[:, 0, :, _IN_BODY]
    counts = counted.T
    turns = jnp.stack([maps[2, 2], maps[0, 3], maps[1, 1]])[:, :, 0] * shared.T[None]
    at_rest = jax.lax.stop_gradient((rotation, position, turns))
    noise = estimate_noise(at_rest[1], at_rest[2], counts)
    one = jnp.ones(windows, jnp.int32)
    if rule == "auto":
        lag = choose_lag(at_rest[0], at_rest[1], counts, noise, number)
    lag = one if rule == "single" or lag is None else jnp.minimum(one * lag, number - 1)
    if rule == "single":
        weights = (counts[1:] & counts[:-1]).astype(poses.dtype)
    else:
        weights = moving_chords(at_rest[0], at_rest[1], counts, lag, noise)
    plain = jnp.all(lag == 1) & jnp.all(weights == 1)

    def chords(_: None) -> jax.Array:
        if rule == "single":
            share = weights / jnp.maximum(jnp.mean(weights, axis=0, keepdims=True), 1 / samples)
            return maps * jnp.sqrt(share)[None, None, :, None]
        every = jnp.broadcast_to(times.T, (samples + 1, windows))
        return chord_velocities(paths, every, lag, weights)

    if count is None and rule == "single":
        velocities = maps
    else:
        velocities = once(jax.lax.cond(plain, lambda _: maps, chords, None))
    rates = kinematics.rates_of(velocities)
    spread, mean = spread_of(paths, counts)
    spread = once(spread)
    about = spread[:, 0, :, _IN_BODY]
    unit = jnp.asarray([1, 0, 0, 1, 0, 1], dtype=poses.dtype)[:, None, None, None]

    def moments(maps: jax.Array) -> jax.Array:
        return once(jnp.where(failed[:, None], unit, _moments(maps)))

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
        lag=lag,
        samples=jnp.maximum(jnp.sum(weights > 0, axis=0, dtype=poses.dtype), 1) / lag.astype(poses.dtype),
        poses=jnp.sum(counts, axis=0, dtype=jnp.int32),
        angular=moments(rates),
        linear=moments(velocities),
        angular_spread=moments(kinematics.rates_of(spread)),
        linear_spread=moments(spread),
        mean_paths=jnp.stack([mean[:, :, t] for t in (_IN_BODY, _IN_GROUND)], axis=-1),
        positions=jnp.stack([jnp.mean(about[i] * about[j], axis=0) for i, j in symmetric.INDEX_PAIRS]),
        travel=jnp.stack(travel),
        rates=None if precise else rates,
        maps=None if precise else velocities,
    )


def identify_windows(
    poses: jax.Array,
    steps: jax.Array,
    count: jax.Array | None,
    lag: jax.Array | None,
    thresholds: Thresholds | None,
    box: Box,
    key: jax.Array,
    rule: LagRule,
    exponent: float,
    discretization: Discretization,
    solver: Solver,
) -> Identification:
    """Identify windows whose shapes and options have been checked, all at once.

    Arguments of :func:`reduce_windows` and :func:`solve_evidence`.
    """
    evidence = reduce_windows(poses, steps, count, lag, rule, discretization)
    return solve_evidence(evidence, thresholds, box, key, rule, exponent, solver)


def solve_evidence(
    evidence: Evidence,
    thresholds: Thresholds | None,
    box: Box,
    key: jax.Array,
    rule: LagRule,
    exponent: float,
    solver: Solver,
) -> Identification:
    """Find the optimum of every type, the best of each group, and what is free.

    Args:
        evidence: of N windows.
        thresholds: above which an axis is free; None to let the noise of the recording decide.
        box: where positions are searched, m.
        key: of the solver's random numbers.
        rule: that the evidence was made by; for "auto" the frames are refined where the noise is white.
        exponent: of the power mean over axes.
        solver: search for the position.
    """
    failed = evidence.status >= 10
    angular_rms, angular_axes = _angular_optima(evidence)
    angular_norm = _norm(angular_rms, exponent)
    a = jnp.argmin(angular_norm, axis=-1).astype(jnp.int32)
    optimum = _linear_optima(evidence, box, key, exponent, solver)
    norm = _norm(optimum.rms, exponent)
    n = jnp.argmin(norm, axis=-1).astype(jnp.int32)
    seen = _Frames(angular_axes, optimum.position, optimum.axes, optimum.local_axes)
    refined = jnp.zeros(n.shape, dtype=bool)
    if rule == "auto" and evidence.maps is None:
        whole = _refine(evidence, optimum.position, box, exponent)
        patterns, distance = _patterns(evidence, a, whole)
        refined = jax.lax.stop_gradient(_is_white(_of_type(n, distance), _likeliest(patterns, n), n))
        rough = seen
        seen = jax.tree.map(
            lambda new, old: jnp.where(refined.reshape(-1, *[1] * (old.ndim - 1)), new, old), whole, rough
        )
        # nothing more to do where the noise of all windows is white
        patterns = jax.lax.cond(
            jnp.all(refined),
            lambda _: patterns,
            lambda _: jnp.where(refined[None, None, :, None], patterns, _patterns(evidence, a, rough)[0]),
            None,
        )
    else:
        patterns, _ = _patterns(evidence, a, seen)
    patterns = jax.lax.stop_gradient(patterns)
    if thresholds is None:
        angular_dof, linear_dof = _likeliest(patterns, n)
    else:
        angular_dof = degrees_of_freedom(angular_rms, thresholds.angular)
        linear_dof = degrees_of_freedom(optimum.rms, thresholds.linear)
    angular = Candidates(
        rotvec=_orientation(seen.angular_axes, angular_dof),
        dof=angular_dof,
        rms=angular_rms,
        norm=angular_norm,
        free_rotation=free_rotations(angular_dof),
    )
    # rotation about axes that are classified as constrained is taken for noise
    idle = jnp.min(jnp.max(jnp.where(angular_dof == 0, angular_rms, 0), axis=-1), axis=-1)
    free, position = nearest_origin(
        optimum.objective.moments,
        seen.local_axes,
        linear_dof,
        optimum.rms,
        seen.position,
        idle[:, None],
    )
    origin = ground_offset(evidence.centre)
    linear = Candidates(
        rotvec=_orientation(seen.axes, linear_dof),
        dof=linear_dof,
        rms=optimum.rms,
        norm=norm,
        free_rotation=free_rotations(linear_dof),
        position=origin + position,
        free_position=free,
        on_bounds=jnp.any(box.at_face(position), axis=-1),
        agreement=optimum.solution.agreement,
    )
    searched, solution = jax.tree.map(partial(_of_type, n), (optimum.searched, optimum.solution))
    twin, has_twin = find_twins(
        searched, box, solution, _pick(linear_dof, n), jax.lax.stop_gradient(idle), evidence.samples
    )
    here = _pick(origin + position, n)
    twin = jnp.where(has_twin[:, None], _pick(origin, n) + twin, jax.lax.stop_gradient(here))
    angular_tied = tied_types(angular_rms, angular_dof, a, evidence.samples)
    # unless exactly two axes are free, both angular types express the same constraint (section 3.3)
    angular_tied = angular_tied | (jnp.sum(_pick(angular_dof, a), axis=-1) != 2)[:, None]
    of_types = _type_probability(optimum.rms, linear_dof, n, evidence.samples)
    winner = _pick(jnp.moveaxis(patterns, (2, 3), (0, 1)), n)
    found = Identification(
        angular=AngularFrame(
            type_code=a,
            rotvec=_pick(angular.rotvec, a),
            dof=_pick(angular.dof, a),
            free_probability=_at_least(jnp.sum(winner, axis=2)),
            rms=_pick(angular.rms, a),
            norm=_pick(angular.norm, a),
            norms=angular.norm,
            tied=angular_tied,
            free_rotation=_pick(angular.free_rotation, a),
        ),
        linear=LinearFrame(
            type_code=n,
            rotvec=_pick(linear.rotvec, n),
            position=here,
            twin=twin,
            has_twin=has_twin,
            dof=_pick(linear.dof, n),
            free_probability=_at_least(jnp.sum(winner, axis=1)),
            rms=_pick(linear.rms, n),
            norm=_pick(linear.norm, n),
            norms=linear.norm,
            tied=tied_types(optimum.rms, linear_dof, n, evidence.samples),
            free_rotation=_pick(linear.free_rotation, n),
            free_position=_pick(free, n),
        ),
        candidates=AllCandidates(angular=angular, linear=linear),
        class_probability=of_types[:, :, None, None] * jnp.moveaxis(patterns, (2, 3), (0, 1)),
        noise=evidence.noise,
        lag=evidence.lag,
        refined=refined,
        counted=evidence.counted,
        status_code=jnp.zeros_like(evidence.status),
    )
    still = jnp.sum(found.angular.dof, axis=-1) + jnp.sum(found.linear.dof, axis=-1) == 0
    on_bounds = jnp.any(box.at_face(_pick(position, n)), axis=-1)
    outcome = jnp.where(on_bounds, Status.ON_BOUNDS, Status.OK)
    outcome = jnp.where(still, Status.NOT_EXCITED, outcome)
    found = jax.tree.map(partial(_blank, failed), found)
    return replace(found, status_code=jnp.where(failed, evidence.status, outcome.astype(jnp.int32)))


@dataclass(frozen=True)
class _LinearOptima:
    """The optimum of every linear type; (N, 4, ...).

    Attributes:
        searched: the problems, and ``solution``: what the solver said of them.
        objective: the problems as seen along ``local_axes``.
        position: (N, 4, 3) m, from the centre for types in the ground.
        axes, local_axes: (N, 4, 3, 3), the axes in the body of the type, and in those of the objective.
        rms: (N, 4, 3) m/s.
    """

    searched: PositionObjective
    solution: Solution
    objective: PositionObjective
    position: jax.Array
    axes: jax.Array
    local_axes: jax.Array
    rms: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Frames:
    """Frames of all types.

    Attributes:
        angular_axes: (N, 2, 3, 3).
        position: (N, 4, 3) m, from the centre for types in the ground.
        axes, local_axes: (N, 4, 3, 3), see :class:`_LinearOptima`.
    """

    angular_axes: jax.Array
    position: jax.Array
    axes: jax.Array
    local_axes: jax.Array


def _pick(array: jax.Array, index: jax.Array) -> jax.Array:
    """From (N, T, ...) what belongs to one type each, (N, ...)."""
    index = index.reshape(*index.shape, *([1] * (array.ndim - index.ndim)))
    return jnp.take_along_axis(array, index, axis=1)[:, 0]


def _of_type(types: jax.Array, leaf: jax.Array) -> jax.Array:
    """From (..., N, T) what belongs to one type each, (..., N)."""
    index = types.reshape(*([1] * (leaf.ndim - 2)), -1, 1)
    return jnp.take_along_axis(leaf, index, axis=-1)[..., 0]


def _blank(failed: jax.Array, leaf: jax.Array) -> jax.Array:
    """NaN, zero or false in the failed windows."""
    empty = jnp.nan if jnp.issubdtype(leaf.dtype, jnp.floating) else 0
    wrong = failed.reshape(failed.shape + (1,) * (leaf.ndim - 1))
    return jnp.where(wrong, jnp.asarray(empty, dtype=leaf.dtype), leaf)


def _again(evidence: Evidence, maps: jax.Array) -> jax.Array:
    """Moments of velocities seen along their own axes, with a floor that leaves float32 its digits."""
    unit = jnp.asarray([1, 0, 0, 1, 0, 1], dtype=maps.dtype)[:, None, None, None]
    return once(jnp.where((evidence.status >= 10)[:, None], unit, _moments(maps, 2)))


def _angular_optima(evidence: Evidence) -> tuple[jax.Array, jax.Array]:
    """RMS velocity along the axes of both types, (N, 2, 3) rad/s, and the axes, (N, 2, 3, 3)."""
    rms, axes = principal_axes(_constant(evidence.angular))
    if evidence.rates is not None:
        first = jax.lax.stop_gradient(axes)
        rms, axes = principal_axes(_constant(_again(evidence, _seen_from(evidence.rates, first))))
        axes = matmul3(first, axes)
    return rms, axes


def _constant(moments: jax.Array) -> symmetric.Symmetric:
    """Covariance of velocities that have no position."""
    zero = jnp.zeros_like(moments[0, 0])
    return covariance_at(moments, (zero, zero, zero))


def _linear_optima(
    evidence: Evidence, box: Box, key: jax.Array, exponent: float, solver: Solver
) -> _LinearOptima:
    """Search the position of every type; the axes follow from it."""
    objective = PositionObjective(evidence.linear, exponent)
    searched = jax.lax.stop_gradient(objective)
    solution = jax.tree.map(jax.lax.stop_gradient, solver.minimise(searched, box, key))
    if evidence.maps is None:
        x = attach_derivative(solution.x, objective, box)
        rms, axes = principal_axes(objective.covariance(x))
        return _LinearOptima(searched, solution, objective, jnp.moveaxis(x, 0, -1), axes, axes, rms)
    origin = solution.x
    first = jax.lax.stop_gradient(principal_axes(objective.covariance(origin))[1])
    objective = PositionObjective(_again(evidence, _seen_from(evidence.maps, first, origin)), exponent)
    low, high = box.bounds(origin)
    here = Box(low - origin, high - origin)
    shift, _ = ValleySteps(_TOUCH_UP)(jax.lax.stop_gradient(objective), here, jnp.zeros_like(origin))
    shift = attach_derivative(shift, objective, here)
    rms, local = principal_axes(objective.covariance(shift))
    position = jnp.moveaxis(origin + shift, 0, -1)
    return _LinearOptima(searched, solution, objective, position, matmul3(first, local), local, rms)


def _refine(evidence: Evidence, position: jax.Array, box: Box, exponent: float) -> _Frames:
    """The frames in which the paths leave their mean least: displacements between all pairs of poses.

    For white noise these are better than velocities by a factor of 1.5 to 10, the more so the higher the
    rate; for slow errors they are worse.

    Args:
        evidence: of the windows.
        position: (N, 4, 3) m, where to start.
        box: of the search.
        exponent: of the power mean over axes.
    """
    objective = PositionObjective(evidence.linear_spread, exponent)
    start = jax.lax.stop_gradient(jnp.moveaxis(position, -1, 0))
    x, _ = ValleySteps(_REFINING)(jax.lax.stop_gradient(objective), box, start)
    x = attach_derivative(x, objective, box)
    _, axes = principal_axes(objective.covariance(x))
    _, angular_axes = principal_axes(_constant(evidence.angular_spread))
    return _Frames(angular_axes, jnp.moveaxis(x, 0, -1), axes, axes)


def _is_white(distance: jax.Array, dof: tuple[jax.Array, jax.Array], winner: jax.Array) -> jax.Array:
    """Whether the constrained axes show white noise and nothing else, (N,).

    Args:
        distance: (6, N) in noises, along the axes of the winner.
        dof: as :func:`_likeliest` returns it.
        winner: (N,) linear type.
    """
    held = jnp.concatenate([dof[0][:, 0], _pick(dof[1], winner)], axis=1) == 0
    quiet = jnp.all(~held.T | (distance < _WHITE), axis=0)
    return quiet & jnp.any(held, axis=1)


def _patterns(evidence: Evidence, kind: jax.Array, frames: _Frames) -> tuple[jax.Array, jax.Array]:
    """Probability of every pattern of degrees of freedom for each linear type, and what it comes from.

    Args:
        evidence: of the windows.
        kind: (N,) the best angular type.
        frames: of all types.

    Returns:
        (4, 4, N, 4), and (6, N, 4): how far each axis moved, in noises.
    """
    position, axes = frames.position, frames.axes
    rounding, tiny = _FLOOR * float(jnp.finfo(axes.dtype).eps), float(jnp.finfo(axes.dtype).tiny)
    turned = _pick(symmetric.to_matrix(_constant(evidence.angular_spread)), kind)
    angular_axes = _pick(frames.angular_axes, kind)
    squares = jnp.sum(angular_axes * matmul3(turned, angular_axes), axis=-2)
    whole = jnp.trace(turned, axis1=-2, axis2=-1)
    noise = jnp.square(evidence.noise.rotation)[:, None] + rounding * whole[:, None]
    # a body that does not turn at all, to the last digit, has no noise either
    angular = jnp.sqrt(jnp.maximum(squares, 0) / jnp.maximum(noise, tiny))
    x = jnp.moveaxis(position, -1, 0)
    spread = symmetric.to_matrix(covariance_at(evidence.linear_spread, (x[0], x[1], x[2])))
    squares = jnp.sum(axes * matmul3(spread, axes), axis=-2)
    variance, lever = _noise_along(evidence, position, axes)
    variance = jnp.maximum(variance + rounding * jnp.trace(spread, axis1=-2, axis2=-1)[..., None], tiny)
    linear = jnp.sqrt(jnp.maximum(squares, 0) / variance)
    gain = jnp.sqrt(lever * whole[:, None, None] / variance)
    angular = jnp.broadcast_to(angular[:, None], linear.shape)
    turning = jnp.broadcast_to(jnp.sqrt(noise)[:, None], linear.shape)
    distance, sizes = (
        jnp.moveaxis(jnp.concatenate(pair, axis=-1), -1, 0)
        for pair in ((angular, linear), (turning, jnp.sqrt(variance)))
    )
    samples = evidence.poses.astype(axes.dtype)[:, None]
    return freedom_patterns(distance, sizes, jnp.moveaxis(gain, -1, 0), samples), distance


def _noise_along(evidence: Evidence, position: jax.Array, axes: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Noise of a frame's origin along its axes, (N, 4, 3) m^2, and the square of the lever it acts through.

    Noise in orientation acts through the lever from the origin of {b} to that of the frame, as far as the
    lever is perpendicular to the axis; in the types whose path is summed up along the motion (BB and GG) the
    noise of the steps adds up as well.
    """
    p = position
    square = jnp.sum(jnp.square(p), axis=-1)
    positions = symmetric.to_matrix(tuple(evidence.positions))  # type: ignore[arg-type]
    mean = jnp.moveaxis(evidence.mean_paths, (2, 3), (0, 1))  # (N, 2, 3, 4)
    x = jnp.moveaxis(p, -1, 0)
    on_body = evidence.linear_spread[:, :, :, _IN_BODY]
    without = on_body.at[:, :4].set(0)  # what the lever does, and the position of {b} does not
    turning = symmetric.to_matrix(covariance_at(without, tuple(x[:, :, _IN_BODY])))  # type: ignore[arg-type]
    passing = symmetric.to_matrix(
        covariance_at(evidence.linear_spread[:, :, :, _IN_GROUND], tuple(x[:, :, _IN_GROUND]))  # type: ignore[arg-type]
    )
    spread = jnp.stack([jnp.zeros_like(turning), turning, positions, passing], axis=1)
    turned = matmul3(mean[:, 0, :, 1:], p[:, _IN_BODY, :, None])[..., 0]
    passed = mean[:, 1, :, 0] + matmul3(mean[:, 1, :, 1:], p[:, _IN_GROUND, :, None])[..., 0]
    centre = jnp.stack([p[:, 0], turned, p[:, 2], passed], axis=1)
    total = jnp.trace(spread, axis1=-2, axis2=-1) + jnp.sum(jnp.square(centre), axis=-1)
    total = total.at[:, _IN_BODY].set(square[:, _IN_BODY])
    along = jnp.sum(axes * matmul3(spread, axes), axis=-2)
    along = along + jnp.square(matmul3(centre[..., None, :], axes)[..., 0, :])
    lever = jnp.maximum(total[..., None] - along, 0)
    of_position = jnp.square(evidence.noise.position)[:, None, None]
    of_rotation = jnp.square(evidence.noise.rotation)[:, None, None]
    variance = of_position + of_rotation * lever
    summed = np.asarray([t.orientation_body == t.position_body for t in LinearType])[None, :, None]
    turns, shifts = (square[:, None, None] / 2 for square in evidence.travel)
    return variance + jnp.where(summed, turns * variance + shifts * of_rotation, 0), lever


def _likeliest(patterns: jax.Array, winner: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Degrees of freedom of both angular types, (N, 2, 3), and of all linear ones, (N, 4, 3)."""
    best = jnp.argmax(patterns.reshape(16, *patterns.shape[2:]), axis=0).astype(jnp.int32)  # (N, 4)
    rotations_free = jnp.take_along_axis(best, winner[:, None], axis=1) // 4
    ranks = jnp.arange(3, dtype=jnp.int32)[None, None]
    angular = (ranks >= 3 - rotations_free[..., None]).astype(jnp.int32)
    linear = (ranks >= 3 - (best % 4)[..., None]).astype(jnp.int32)
    return jnp.broadcast_to(angular, (len(winner), 2, 3)), linear


def _at_least(number: jax.Array) -> jax.Array:
    """Probability that each axis is free, (N, 3), from that of every number of free axes, (N, 4)."""
    return jnp.cumsum(number[:, :0:-1], axis=1)


def _type_probability(rms: jax.Array, dof: jax.Array, winner: jax.Array, samples: jax.Array) -> jax.Array:
    """Probability of every linear type, (N, 4)."""
    held = (jnp.take_along_axis(dof, winner[:, None, None], axis=1) == 0).astype(rms.dtype)
    best = jnp.take_along_axis(rms, winner[:, None, None], axis=1)
    return type_weights(excess_over(best, rms, held), tie_margin(held[:, 0], samples))


def _norm(rms: jax.Array, exponent: float) -> jax.Array:
    return jnp.exp(log_power_mean(jnp.moveaxis(jnp.log(rms), -1, 0), exponent))


def _orientation(axes: jax.Array, dof: jax.Array) -> jax.Array:
    """Rotation vector of the axes; turning axes of one kind into each other contributes no derivative."""
    fixed = jax.lax.stop_gradient(axes)
    turn = matmul3(jnp.swapaxes(fixed, -1, -2), axes)
    at_rest = jax.lax.stop_gradient(turn)
    distinct = (dof[..., :, None] != dof[..., None, :]).astype(axes.dtype)
    return rotations.rotation_log(matmul3(fixed, at_rest + distinct * (turn - at_rest)))

"""Identification of windows that have been checked: a pure function of arrays.

poses -> velocity maps -> moments -> optimum of every type -> classification -> Identification
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from reframe_jax.compilation import once
from reframe_jax.constraints.located import ground_offset
from reframe_jax.geometry import rotations, symmetric
from reframe_jax.geometry.products import matmul3
from reframe_jax.identification.classify import (
    Thresholds,
    degrees_of_freedom,
    free_rotations,
    nearest_origin,
    tied_types,
)
from reframe_jax.identification.results import (
    AllCandidates,
    AngularFrame,
    Candidates,
    Identification,
    LinearFrame,
)
from reframe_jax.identification.twins import find_twins
from reframe_jax.motion import kinematics
from reframe_jax.motion.checks import Status, window_status
from reframe_jax.motion.kinematics import Discretization
from reframe_jax.objectives.moments import component_moments, covariance_at
from reframe_jax.objectives.norms import log_power_mean, principal_axes
from reframe_jax.objectives.velocity import PositionObjective
from reframe_jax.solvers import Box, Solution, Solver, ValleySteps
from reframe_jax.solvers.implicit import attach_derivative

__all__ = ["identify_windows", "window_moments"]

_FLOOR = 16  # of the covariance, in units of rounding: keeps noise-free windows positive definite
_TOUCH_UP = 16  # steps that follow when velocities are seen from the optimum


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


def _moments(maps: jax.Array, exponent: int = 1) -> jax.Array:
    """Moments, the types last, of maps (3, columns, K, types, ...), with a floor: rounding ** exponent."""
    moments = jnp.moveaxis(component_moments(maps), 2, -1)
    squares = [moments[i, j] for i in (0, 3, 5) for j in ((0,) if moments.shape[1] == 1 else (0, 4, 7, 9))]
    rounding = (_FLOOR * float(jnp.finfo(moments.dtype).eps)) ** exponent
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


def identify_windows(
    poses: jax.Array,
    steps: jax.Array,
    thresholds: Thresholds,
    box: Box,
    key: jax.Array,
    exponent: float,
    discretization: Discretization,
    solver: Solver,
) -> Identification:
    """Identify windows whose shapes and options have been checked, all at once.

    Args:
        poses: (N, K+1, 4, 4), m.
        steps: (K,) or (N, K) sample times, s.
        thresholds: see :class:`reframe_jax.Thresholds`.
        box: where positions are searched, m.
        key: of the solver's random numbers.
        exponent: of the power mean over axes.
        discretization: see :func:`reframe_jax.motion.kinematics.linear_velocity_maps`.
        solver: search for the position.
    """
    samples = poses.shape[-3] - 1
    status = window_status(poses, steps)
    failed = status >= 10
    # a failed window computes with harmless numbers, so that no NaN enters a derivative
    poses = jnp.where(failed[:, None, None, None], jnp.eye(4, dtype=poses.dtype)[None, None], poses)
    steps = jnp.where(jnp.isfinite(steps) & (steps > 0), steps, 1)
    centre = jax.lax.stop_gradient(jnp.mean(poses[:, :, :3, 3], axis=1))
    centred = poses.at[:, :, :3, 3].add(-centre[:, None])
    rates, maps = once(kinematics.velocity_components(once(centred), steps, discretization))
    unit = jnp.asarray([1, 0, 0, 1, 0, 1], dtype=poses.dtype)[:, None, None, None]

    def moments_of(maps: jax.Array, exponent: int = 1) -> jax.Array:
        return once(jnp.where(failed[:, None], unit, _moments(maps, exponent)))

    angular = _angular_candidates(rates, moments_of, thresholds, exponent)
    # rotation about axes that are classified as constrained is taken for noise
    noise = jnp.min(jnp.max(jnp.where(angular.dof == 0, angular.rms, 0), axis=-1), axis=-1)
    linear, searched, solution = _linear_candidates(
        maps, moments_of, thresholds, noise, box, key, exponent, solver
    )
    origin = ground_offset(centre)
    assert linear.position is not None
    assert linear.free_position is not None
    assert linear.on_bounds is not None
    linear = _replace(linear, position=origin + linear.position)

    def winner(norms: jax.Array) -> jax.Array:
        return jnp.argmin(norms, axis=-1).astype(jnp.int32)

    def pick(array: jax.Array, index: jax.Array) -> jax.Array:
        index = index.reshape(*index.shape, *([1] * (array.ndim - index.ndim)))
        return jnp.take_along_axis(array, index, axis=1)[:, 0]

    a, n = winner(angular.norm), winner(linear.norm)
    position = pick(linear.position, n)
    searched, solution = jax.tree.map(partial(_of_type, n), (searched, solution))
    limit, quiet = jax.lax.stop_gradient((thresholds.linear, noise))
    twin, has_twin = find_twins(searched, box, solution, pick(linear.dof, n), limit, quiet, samples)
    twin = jnp.where(has_twin[:, None], pick(origin, n) + twin, jax.lax.stop_gradient(position))
    angular_tied = tied_types(angular.rms, angular.dof, a, samples)
    # unless exactly two axes are free, both angular types express the same constraint (section 3.3)
    angular_tied = angular_tied | (jnp.sum(pick(angular.dof, a), axis=-1) != 2)[:, None]
    found = Identification(
        angular=AngularFrame(
            type_code=a,
            rotvec=pick(angular.rotvec, a),
            dof=pick(angular.dof, a),
            rms=pick(angular.rms, a),
            norm=pick(angular.norm, a),
            norms=angular.norm,
            tied=angular_tied,
            free_rotation=pick(angular.free_rotation, a),
        ),
        linear=LinearFrame(
            type_code=n,
            rotvec=pick(linear.rotvec, n),
            position=position,
            twin=twin,
            has_twin=has_twin,
            dof=pick(linear.dof, n),
            rms=pick(linear.rms, n),
            norm=pick(linear.norm, n),
            norms=linear.norm,
            tied=tied_types(linear.rms, linear.dof, n, samples),
            free_rotation=pick(linear.free_rotation, n),
            free_position=pick(linear.free_position, n),
        ),
        candidates=AllCandidates(angular=angular, linear=linear),
        status_code=jnp.zeros_like(status),
    )
    still = jnp.sum(found.angular.dof, axis=-1) + jnp.sum(found.linear.dof, axis=-1) == 0
    outcome = jnp.where(pick(linear.on_bounds, n), Status.ON_BOUNDS, Status.OK)
    outcome = jnp.where(still, Status.NOT_EXCITED, outcome)
    found = jax.tree.map(partial(_blank, failed), found)
    return _replace(found, status_code=jnp.where(failed, status, outcome.astype(jnp.int32)))


def _of_type(types: jax.Array, leaf: jax.Array) -> jax.Array:
    """From (..., N, T) what belongs to one type each, (..., N)."""
    index = types.reshape(*([1] * (leaf.ndim - 2)), -1, 1)
    return jnp.take_along_axis(leaf, index, axis=-1)[..., 0]


def _blank(failed: jax.Array, leaf: jax.Array) -> jax.Array:
    """NaN, zero or false in the failed windows."""
    empty = jnp.nan if jnp.issubdtype(leaf.dtype, jnp.floating) else 0
    wrong = failed.reshape(failed.shape + (1,) * (leaf.ndim - 1))
    return jnp.where(wrong, jnp.asarray(empty, dtype=leaf.dtype), leaf)


def _replace(record: Any, **changes: Any) -> Any:
    return type(record)(**{**vars(record), **changes})


Moments = Callable[[jax.Array, int], jax.Array]
"""Maps and the power of their floor to moments; windows that failed get harmless ones."""


def _angular_candidates(
    rates: jax.Array, moments_of: Moments, thresholds: Thresholds, exponent: float
) -> Candidates:
    rms, axes = principal_axes(_constant(moments_of(rates, 1)))
    if rates.dtype == jnp.float32:
        first = jax.lax.stop_gradient(axes)
        rms, axes = principal_axes(_constant(moments_of(_seen_from(rates, first), 2)))
        axes = matmul3(first, axes)
    dof = degrees_of_freedom(rms, thresholds.angular)
    return Candidates(
        rotvec=_orientation(axes, dof),
        dof=dof,
        rms=rms,
        norm=_norm(rms, exponent),
        free_rotation=free_rotations(dof),
    )


def _constant(moments: jax.Array) -> symmetric.Symmetric:
    """Covariance of velocities that have no position."""
    zero = jnp.zeros_like(moments[0, 0])
    return covariance_at(moments, (zero, zero, zero))


def _linear_candidates(
    maps: jax.Array,
    moments_of: Moments,
    thresholds: Thresholds,
    noise: jax.Array,
    box: Box,
    key: jax.Array,
    exponent: float,
    solver: Solver,
) -> tuple[Candidates, PositionObjective, Solution]:
    """Search the position of every type; the axes follow from it.

    Also returns what was searched, and what the solver said.
    """
    objective = PositionObjective(moments_of(maps, 1), exponent)
    searched = jax.lax.stop_gradient(objective)
    solution = jax.tree.map(jax.lax.stop_gradient, solver.minimise(searched, box, key))
    if maps.dtype == jnp.float32:
        origin = solution.x
        first = jax.lax.stop_gradient(principal_axes(objective.covariance(origin))[1])
        objective = PositionObjective(moments_of(_seen_from(maps, first, origin), 2), exponent)
        low, high = box.bounds(origin)
        here = Box(low - origin, high - origin)
        moved, _ = ValleySteps(_TOUCH_UP)(jax.lax.stop_gradient(objective), here, jnp.zeros_like(origin))
        moved = attach_derivative(moved, objective, here)
        rms, local = principal_axes(objective.covariance(moved))
        axes, x = matmul3(first, local), origin + moved
    else:
        x = attach_derivative(solution.x, objective, box)
        rms, local = principal_axes(objective.covariance(x))
        axes = local
    dof = degrees_of_freedom(rms, thresholds.linear)
    at_minimum = jnp.moveaxis(x, 0, -1)
    free, position = nearest_origin(objective.moments, local, dof, rms, at_minimum, noise[:, None])
    found = Candidates(
        rotvec=_orientation(axes, dof),
        dof=dof,
        rms=rms,
        norm=_norm(rms, exponent),
        free_rotation=free_rotations(dof),
        position=position,
        free_position=free,
        on_bounds=jnp.any(box.at_face(position), axis=-1),
        agreement=solution.agreement,
    )
    return found, searched, solution


def _norm(rms: jax.Array, exponent: float) -> jax.Array:
    return jnp.exp(log_power_mean(jnp.moveaxis(jnp.log(rms), -1, 0), exponent))


def _orientation(axes: jax.Array, dof: jax.Array) -> jax.Array:
    """Rotation vector of the axes; turning axes of one kind into each other contributes no derivative."""
    fixed = jax.lax.stop_gradient(axes)
    turn = matmul3(jnp.swapaxes(fixed, -1, -2), axes)
    at_rest = jax.lax.stop_gradient(turn)
    distinct = (dof[..., :, None] != dof[..., None, :]).astype(axes.dtype)
    return rotations.rotation_log(matmul3(fixed, at_rest + distinct * (turn - at_rest)))

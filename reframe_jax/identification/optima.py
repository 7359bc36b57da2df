"""The optimum of every frame type: its axes and its origin."""

from dataclasses import dataclass

import jax

from reframe_jax.arrays import jnp, lax
from reframe_jax.geometry import rotations, symmetric
from reframe_jax.geometry.products import matmul3
from reframe_jax.identification.evidence import Evidence, LagRule
from reframe_jax.identification.floored_moments import usable_moments
from reframe_jax.identification.widening import SearchSpace, clear_gain, widen_search
from reframe_jax.objectives.moments import covariance_at
from reframe_jax.objectives.norms import log_power_mean, principal_axes
from reframe_jax.objectives.velocity import PositionObjective
from reframe_jax.solvers import Box, Solution, Solver, ValleySteps
from reframe_jax.solvers.implicit import attach_derivative

__all__ = [
    "Frames",
    "Optima",
    "constant_covariance",
    "find_optima",
    "follow_last",
    "follow_where",
    "orient_axes",
    "pick_problem",
    "pick_type",
    "put_third_axis",
    "refine_frames",
]

_TOUCH_UP = 16  # steps that follow when velocities are seen from the optimum


_REFINING = 5  # steps from the optimum of velocities to that of displacements


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Optima:
    """The optimum of every frame type, and which type of each group is the best.

    Attributes:
        angular_rms: (N, 2, 3) rad/s.
        angular_axes: (N, 2, 3, 3).
        angular_norm: (N, 2) rad/s.
        angular_winner: (N,) type of the lowest norm.
        searched: the problems of the linear types, and ``solution``: what the solver said of them.
        objective: the problems as seen along ``local_axes``.
        position: (N, 4, 3) m, from the centre for types in the ground.
        axes, local_axes: (N, 4, 3, 3), the axes in the body of the type, and in those of the objective.
        rms: (N, 4, 3) m/s.
        norm: (N, 4) m/s.
        linear_winner: (N,) type of the lowest norm.
        box: where each origin was searched, m.
        widened: (N,) bool, whether that was the far box.
        margin: (N,) by how much log J falls outwards at least where an origin lies on a face because of the
            motion: what :func:`.clear_gain` says, but for bounds that were given.
    """

    angular_rms: jax.Array
    angular_axes: jax.Array
    angular_norm: jax.Array
    angular_winner: jax.Array
    searched: PositionObjective
    solution: Solution
    objective: PositionObjective
    position: jax.Array
    axes: jax.Array
    local_axes: jax.Array
    rms: jax.Array
    norm: jax.Array
    linear_winner: jax.Array
    box: Box
    widened: jax.Array
    margin: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Frames:
    """Frames of all types.

    Attributes:
        angular_axes: (N, 2, 3, 3).
        position: (N, 4, 3) m, from the centre for types in the ground.
        axes, local_axes: (N, 4, 3, 3), see :class:`Optima`.
    """

    angular_axes: jax.Array
    position: jax.Array
    axes: jax.Array
    local_axes: jax.Array


def pick_type(array: jax.Array, index: jax.Array) -> jax.Array:
    """From (N, T, ...) what belongs to one type each, (N, ...)."""
    chosen = index[:, None] == jnp.arange(array.shape[1], dtype=index.dtype)[None]
    return _sum_where(chosen.reshape(*chosen.shape, *([1] * (array.ndim - 2))), array, 1)


def follow_where(chosen: jax.Array, value: jax.Array) -> jax.Array:
    """The value (N, ...) as it is, with derivatives for the chosen windows (N,) only.

    For what a ``where`` takes from the chosen windows only. Elsewhere it may divide by zero, and reverse mode
    would multiply that by a derivative of zero. ``chosen`` may have more of the axes of ``value``.
    """
    chosen = chosen.reshape(*chosen.shape, *([1] * (value.ndim - chosen.ndim)))
    return jnp.where(chosen, value, lax.stop_gradient(value))


def follow_last(chosen: jax.Array, value: jax.Array) -> jax.Array:
    """The same of a value (..., N), windows last."""
    return jnp.where(chosen, value, lax.stop_gradient(value))


def pick_problem(types: jax.Array, leaf: jax.Array) -> jax.Array:
    """From (..., N, T) what belongs to one type each, (..., N)."""
    chosen = types[:, None] == jnp.arange(leaf.shape[-1], dtype=types.dtype)[None]
    return _sum_where(chosen.reshape(*[1] * (leaf.ndim - 2), *chosen.shape), leaf, -1)


def _sum_where(chosen: jax.Array, array: jax.Array, axis: int) -> jax.Array:
    """The one entry that is chosen along an axis. A sum compiles sooner than a gather."""
    if array.dtype == bool:
        return jnp.any(chosen & array, axis=axis)
    return jnp.sum(jnp.where(chosen, array, 0), axis=axis, dtype=array.dtype)


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


def _again(evidence: Evidence, maps: jax.Array, floor: jax.Array | None = None) -> jax.Array:
    """Moments of velocities seen along their own axes, with a floor that leaves float32 its digits."""
    return usable_moments(evidence.status >= 10, maps, 2, floor)


def _angular_optima(evidence: Evidence) -> tuple[jax.Array, jax.Array]:
    """RMS velocity along the axes of both types, (N, 2, 3) rad/s, and the axes, (N, 2, 3, 3)."""
    rms, axes = principal_axes(constant_covariance(evidence.angular))
    if evidence.rates is not None:
        first = lax.stop_gradient(axes)
        rms, axes = principal_axes(constant_covariance(_again(evidence, _seen_from(evidence.rates, first))))
        axes = matmul3(first, axes)
    return rms, axes


def constant_covariance(moments: jax.Array) -> symmetric.Symmetric:
    """Covariance of velocities that have no position."""
    zero = jnp.zeros_like(moments[0, 0])
    return covariance_at(moments, (zero, zero, zero))


def find_optima(
    evidence: Evidence,
    space: SearchSpace,
    key: jax.Array,
    rule: LagRule,
    exponent: float,
    solver: Solver,
) -> Optima:
    """Search the position of every linear type; the axes of all types follow in closed form.

    Args:
        evidence: of N windows.
        space: where positions are searched, m.
        key: of the solver's random numbers.
        rule: that the evidence was made by; for "auto" errors may be slow.
        exponent: of the power mean over axes.
        solver: search for the position.
    """
    angular_rms, angular_axes = _angular_optima(evidence)
    angular_norm = _norm(angular_rms, exponent)
    objective = PositionObjective(evidence.linear, exponent)
    searched = lax.stop_gradient(objective)
    solution = jax.tree.map(lax.stop_gradient, solver.minimise(searched, space.near, key))
    margin = clear_gain(lax.stop_gradient(evidence.samples), rule == "auto")
    solution, box, widened = widen_search(searched, space, solution, margin, evidence.axis.found, key)
    if evidence.maps is None:
        x = _follow_moments(solution.x, objective, box)
        rms, axes = principal_axes(objective.covariance(x))
        local = axes
    else:
        first = lax.stop_gradient(principal_axes(objective.covariance(solution.x))[1])
        seen = _seen_from(evidence.maps, first, solution.x)
        objective = PositionObjective(_again(evidence, seen, evidence.floor), exponent)
        low, high = box.bounds(solution.x)
        here = Box(low - solution.x, high - solution.x)
        start = jnp.zeros_like(solution.x)
        shift, _ = ValleySteps(_TOUCH_UP)(lax.stop_gradient(objective), here, start)
        shift = _follow_moments(shift, objective, here)
        rms, local = principal_axes(objective.covariance(shift))
        axes, x = matmul3(first, local), solution.x + shift
    norm = _norm(rms, exponent)
    return Optima(
        angular_rms=angular_rms,
        angular_axes=angular_axes,
        angular_norm=angular_norm,
        angular_winner=jnp.argmin(angular_norm, axis=-1).astype(jnp.int32),
        searched=searched,
        solution=solution,
        objective=objective,
        position=jnp.moveaxis(x, 0, -1),
        axes=axes,
        local_axes=local,
        rms=rms,
        norm=norm,
        linear_winner=jnp.argmin(norm, axis=-1).astype(jnp.int32),
        box=box,
        widened=widened,
        margin=jnp.where(space.widens, margin, 0),
    )


def _follow_moments(x: jax.Array, objective: PositionObjective, box: Box) -> jax.Array:
    """The optima x, (3, N, 4) m, as differentiable functions of the moments.

    They are the same in every unit of velocity. In units of the geometric mean of the RMS velocities, the
    third powers of variances that derivatives divide by fit float32.
    """
    size = lax.stop_gradient(jnp.exp(2 * PositionObjective(objective.moments).value(x)))
    return attach_derivative(
        x, PositionObjective(objective.moments / size[None, None], objective.exponent), box
    )


def refine_frames(evidence: Evidence, position: jax.Array, box: Box, exponent: float) -> Frames:
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
    start = lax.stop_gradient(jnp.moveaxis(position, -1, 0))
    x, _ = ValleySteps(_REFINING)(lax.stop_gradient(objective), box, start)
    x = _follow_moments(x, objective, box)
    _, axes = principal_axes(objective.covariance(x))
    _, angular_axes = principal_axes(constant_covariance(evidence.angular_spread))
    angular_axes = _about_single_axis(evidence, angular_axes)
    return Frames(angular_axes, jnp.moveaxis(x, 0, -1), axes, axes)


def _about_single_axis(evidence: Evidence, axes: jax.Array) -> jax.Array:
    """The angular axes (N, 2, 3, 3) with the fastest one put where the rotations keep it, if they do."""
    third = jnp.stack([evidence.axis.in_ground.T, evidence.axis.in_body.T], axis=1)
    return put_third_axis(axes, third, evidence.axis.found)


def put_third_axis(axes: jax.Array, third: jax.Array, chosen: jax.Array) -> jax.Array:
    """The axes (N, 2, 3, 3) with the third along (N, 2, 3), either way round, for the windows (N,) chosen."""
    third, own = follow_where(chosen, third), follow_where(chosen, axes)
    same = jnp.sum(third * own[..., 2], axis=-1, keepdims=True)
    third = jnp.where(same < 0, -third, third)
    first = own[..., 0] - third * jnp.sum(third * own[..., 0], axis=-1, keepdims=True)
    square = jnp.sum(jnp.square(first), axis=-1, keepdims=True)
    length = jnp.sqrt(follow_where(square > 0, square))
    found = chosen[:, None] & (length[..., 0] > 0.5)
    first = first / jnp.where(length > 0, length, 1)
    turned = jnp.stack([first, jnp.cross(third, first), third], axis=-1)
    return jnp.where(found[..., None, None], turned, axes)


def _norm(rms: jax.Array, exponent: float) -> jax.Array:
    return jnp.exp(log_power_mean(jnp.moveaxis(jnp.log(rms), -1, 0), exponent))


def orient_axes(axes: jax.Array, dof: jax.Array) -> jax.Array:
    """Rotation vector of the axes; turning axes of one kind into each other contributes no derivative."""
    fixed = lax.stop_gradient(axes)
    turn = matmul3(jnp.swapaxes(fixed, -1, -2), axes)
    at_rest = lax.stop_gradient(turn)
    distinct = (dof[..., :, None] != dof[..., None, :]).astype(axes.dtype)
    return rotations.rotation_log(matmul3(fixed, at_rest + distinct * (turn - at_rest)))

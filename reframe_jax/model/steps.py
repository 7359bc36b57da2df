"""Steps of the fit, for many problems at a time: components first, problems last.

The unknowns of a problem are a frame V in its main body, an origin x, the tilt t of the axis between the
bodies
and a pitch h. Three blocks of coordinates can be held: rotations along columns of V, translations of the
origin
along columns of V, and the position of the body along the tilted axis, less h times the rotation about the
axis.
The objective is sum_s n_s log det of the held covariances; see :mod:`.fit`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.model.small import (
    cross,
    inverse_and_determinant,
    largest,
    once,
    rotate,
    sandwich,
    solve_positive,
    times,
    total,
)

__all__ = ["Problem", "Unknowns", "axis_row", "descend", "path_of", "row_size", "tilted_axis"]

Array = jax.Array
_DAMPING = 1e-3  # first, of the diagonal
_LONGEST = 0.5  # rad or m, of one step

_LEVI_CIVITA = np.array(
    [[[(i - j) * (j - k) * (k - i) / 2 for k in range(3)] for j in range(3)] for i in range(3)]
)
_BEND = np.einsum("mkj,nli->mnklji", _LEVI_CIVITA, _LEVI_CIVITA).reshape(9, 81)
"""Second derivative of a form of directions with respect to their rotation: of O_kl C_ji."""


class Unknowns(NamedTuple):
    """Unknowns: ``frame`` (3, 3, ...), ``origin`` (3, ...) m, ``tilt`` (2, ...), ``pitch`` (...) m/rad."""

    frame: Array
    origin: Array
    tilt: Array
    pitch: Array


class Problem(NamedTuple):
    """What is given, in axes of the main body.

    Attributes:
        turns: (3, 3, S, ...) moments of the rotation.
        paths: (3, 4, 3, 4, S, ...) moments of the translation: direction times (1, origin), twice.
        rows: (6, 6, S, ...) moments of the position of the body, and of the rotation.
        held_turns, held_paths: (3, ...) bool, by columns.
        held_row: (...) bool, whether the position along the axis is held.
        pitch, tilted, tie: (...) bool, whether there is a pitch or a tilt, and whether the tilt costs.
        details: (S, ...) n_s.
        scale: (...) rad, size of the tilt.
        box: (...) m, half the width of the cube of origins.
    """

    turns: Array
    paths: Array
    rows: Array
    held_turns: Array
    held_paths: Array
    held_row: Array
    pitch: Array
    tilted: Array
    tie: Array
    details: Array
    scale: Array
    box: Array


def tilted_axis(tilt: Array) -> tuple[Array, Array]:
    """Axis (3, ...) of exp(t_0, t_1, 0), and its derivatives (2, 3, ...)."""
    squared = total(tilt * tilt, 0) + jnp.finfo(tilt.dtype).tiny
    angle = jnp.sqrt(squared)
    s, c = jnp.sin(angle) / angle, jnp.cos(angle)
    rate, one, two = (c - s) / squared, tilt[0], tilt[1]
    mixed = rate * one * two
    rates = [mixed, -s - rate * one * one, -s * one, s + rate * two * two, -mixed, -s * two]
    return jnp.stack([s * two, -s * one, c]), jnp.stack(rates).reshape(2, 3, *angle.shape)


def _held(form: Array, held: Array, details: Array) -> tuple[Array, Array]:
    """Weights n_s C_s^-1 of held columns (3, 3, S, ...), zero elsewhere, and sum_s n_s log det C_s."""
    both = (held[:, None] & held[None])[:, :, None]
    small = jnp.finfo(form.dtype).tiny ** 0.5
    unit = jnp.eye(3, dtype=form.dtype).reshape(3, 3, *[1] * (form.ndim - 2))
    alone = unit * jnp.where(held, small, 1)[:, None, None]
    inverse, det = inverse_and_determinant(jnp.where(both, form, 0) + alone)
    return jnp.where(both, inverse * details, 0), total(details * jnp.log(det), 0)


def axis_row(at: Unknowns) -> Array:
    """Weights (6, ...) of the position along the axis, less the pitch times the rotation about the axis."""
    axis, _ = tilted_axis(at.tilt)
    return jnp.concatenate([times(at.frame, axis), -at.pitch * at.frame[:, 2]])


def row_size(rows: Array, row: Array) -> tuple[Array, Array]:
    """Moments (6, 6, S, ...) times a row (6, ...), and its variance (S, ...)."""
    moved = total(rows * row[None, :, None], 1)
    moved = once(moved)
    return moved, total(moved * row[:, None], 0)


def path_of(paths: Array, origin: Array) -> tuple[Array, Array]:
    """Moments of unit origins with an origin's path (3, 4, 3, S, ...), and of the path (3, 3, S, ...)."""
    x = origin[:, None]
    half = paths[:, :, :, 0] + total(paths[:, :, :, 1:] * x, 3)
    half = once(half)
    return half, once(half[:, 0] + total(half[:, 1:] * x[:, None], 1))


def _held_size(problem: Problem, size: Array) -> Array:
    return jnp.where(problem.held_row, size + jnp.finfo(size.dtype).tiny ** 0.5, 1)


def _tilt_cost(problem: Problem, tilt: Array) -> tuple[Array, Array]:
    """Cost of the tilt, and its derivative over 2 t: also the bend of its tangent."""
    count, squared = total(problem.details, 0), total(tilt * tilt, 0)
    cost = count * jnp.log1p(squared / problem.scale**2)
    return jnp.where(problem.tie, cost, 0), jnp.where(problem.tie, count / (problem.scale**2 + squared), 0)


def _objective(problem: Problem, at: Unknowns) -> Array:
    _, path = path_of(problem.paths, at.origin)
    _, one = _held(sandwich(at.frame, problem.turns), problem.held_turns, problem.details)
    _, two = _held(sandwich(at.frame, path), problem.held_paths, problem.details)
    _, size = row_size(problem.rows, axis_row(at))
    three = total(problem.details * jnp.log(_held_size(problem, size)), 0)
    return one + two + three + _tilt_cost(problem, at.tilt)[0]


def _expand(problem: Problem, at: Unknowns) -> tuple[Array, Array]:
    """Gradient (9, ...) and the Hessian of the tangent (9, 9, ...), in rotation, origin, tilt and pitch."""
    back = jnp.swapaxes(at.frame, 0, 1)
    half, path = path_of(problem.paths, at.origin)
    weights = [
        once(sandwich(back, _held(once(sandwich(at.frame, form)), held, problem.details)[0]))
        for form, held in ((problem.turns, problem.held_turns), (path, problem.held_paths))
    ]
    # ---- rotations and translations: directions turn, the origin moves
    pulled = jnp.zeros_like(at.frame)
    bent = jnp.zeros((3, 3, 3, 3, *at.frame.shape[2:]), at.frame.dtype)
    for weight, form in zip(weights, (problem.turns, path), strict=True):
        pulled = pulled + total(form[:, :, None] * weight[None], 1, 3)
        bent = bent + total(weight[:, :, None, None] * form[None, None], 4)
    turning = jnp.stack(
        [pulled[2, 1] - pulled[1, 2], pulled[0, 2] - pulled[2, 0], pulled[1, 0] - pulled[0, 1]]
    )
    turns_turns = jnp.tensordot(jnp.asarray(_BEND, bent.dtype), bent.reshape(81, *bent.shape[4:]), 1)
    turns_turns = turns_turns.reshape(3, 3, *bent.shape[4:])
    ahead = once(total(weights[1][:, :, None, None] * half[None, :, 1:], 1, 4))  # (k, a, j)
    moving = ahead[0, :, 0] + ahead[1, :, 1] + ahead[2, :, 2]
    turns_moves = jnp.stack([ahead[i, :, j] - ahead[j, :, i] for i, j in ((1, 2), (2, 0), (0, 1))])
    moves_moves = total(problem.paths[:, 1:, :, 1:] * weights[1][:, None, :, None], 0, 2, 4)
    # ---- the row along the axis
    axis, rates = tilted_axis(at.tilt)
    along, third = times(at.frame, axis), at.frame[:, 2]
    row = jnp.concatenate([along, -at.pitch * third])
    moved, size = row_size(problem.rows, row)
    each = jnp.where(problem.held_row, problem.details / _held_size(problem, size), 0)
    unit = jnp.broadcast_to(jnp.eye(3, dtype=row.dtype).reshape(3, 3, *[1] * at.pitch.ndim), at.frame.shape)
    spun = [cross(unit, jnp.broadcast_to(v[:, None], unit.shape)) for v in (along, -at.pitch * third)]
    tilted = [times(at.frame, rates[0]), times(at.frame, rates[1])]
    zero = jnp.zeros_like(third)
    rates_of = [jnp.concatenate([spun[0][:, m], spun[1][:, m]]) for m in range(3)]
    rates_of += [jnp.concatenate([jnp.where(problem.tilted, v, 0), zero]) for v in tilted]
    rates_of.append(jnp.concatenate([zero, jnp.where(problem.pitch, -third, 0)]))
    slopes = once(jnp.stack(rates_of))  # (6 unknowns, 6, ...)
    row_gradient = total(slopes * total(each * moved, 1)[None], 1)
    form = total(problem.rows * each, 2)
    carried = once(times(slopes, once(form)))
    row_hessian = total(carried[:, None] * slopes[None], 2)
    bend = _tilt_cost(problem, at.tilt)[1]
    gradient = 2 * jnp.concatenate(
        [turning + row_gradient[:3], moving, row_gradient[3:5] + bend * at.tilt, row_gradient[5:]]
    )
    empty = jnp.zeros((3, 3, *bend.shape), bend.dtype)
    bends = jnp.asarray(np.diag([1.0, 1.0, 0.0]), bend.dtype).reshape(3, 3, *[1] * bend.ndim) * bend
    top = [turns_turns + row_hessian[:3, :3], turns_moves, row_hessian[:3, 3:]]
    middle = [jnp.swapaxes(turns_moves, 0, 1), moves_moves, empty]
    bottom = [row_hessian[3:, :3], empty, row_hessian[3:, 3:] + bends]
    hessian = 2 * jnp.concatenate([jnp.concatenate(blocks, axis=1) for blocks in (top, middle, bottom)])
    return gradient, hessian


def _move(at: Unknowns, step: Array, box: Array) -> Unknowns:
    return Unknowns(
        rotate(step[:3], at.frame),
        jnp.clip(at.origin + step[3:6], -box, box),
        at.tilt + step[6:8],
        at.pitch + step[8],
    )


def descend(problem: Problem, start: Unknowns, steps: int) -> tuple[Unknowns, Array]:
    """Unknowns after a number of Levenberg and Marquardt's steps for the tangent, and the objective there."""
    small = jnp.finfo(start.frame.dtype).tiny ** 0.5

    def step(_: int, carry: tuple[Unknowns, Array, Array]) -> tuple[Unknowns, Array, Array]:
        at, value, damping = carry
        gradient, hessian = _expand(problem, at)
        size = jnp.stack([hessian[i, i] for i in range(9)])
        lift = damping * size + 1e-9 * largest(size) + small
        unit = jnp.eye(9, dtype=lift.dtype).reshape(9, 9, *[1] * value.ndim)
        change = -solve_positive(*once((hessian + unit * lift[:, None], gradient)))
        change = change * jnp.minimum(1, _LONGEST / jnp.maximum(largest(jnp.abs(change)), small))
        there = once(_move(at, once(change), problem.box))
        new = _objective(problem, there)
        lower = new < value
        at = jax.tree.map(lambda a, b: jnp.where(lower, a, b), there, at)
        damping = jnp.clip(jnp.where(lower, damping * 0.1, damping * 10), 1e-7, 1e4)
        return at, jnp.where(lower, new, value), damping

    value = _objective(problem, start)
    found, value, _ = jax.lax.fori_loop(0, steps, step, (start, value, jnp.full_like(value, _DAMPING)))
    return found, value

"""Steps of the fit for many problems at once. Arrays have components first and problems last.

The unknowns of a problem are a frame V in its main body (see :class:`.EntryMoments`), an origin x, the tilt t
between the axis in {b} and in {g}, and a pitch h. Three blocks of coordinates can be held: rotations about
columns of V, translations of the origin along columns of V, and the position of the body along the tilted
axis, less h times the rotation about the axis. The objective is sum_s n_s log det of the held covariances;
see :mod:`.fit`.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry.kernel import added_up
from reframe_jax.geometry.small import (
    axial,
    crosses,
    invert_symmetric,
    materialize,
    rotate,
    sandwich,
    times,
    total,
    trace,
    unit_matrix,
)
from reframe_jax.geometry.symmetric import INDEX_PAIRS
from reframe_jax.model.descent import Local, levenberg_marquardt

Array = jax.Array


class Unknowns(NamedTuple):
    """Unknowns of the fit of many problems."""

    frame: Array  # (3, 3, ...)
    origin: Array  # (3, ...) m
    tilt: Array  # (2, ...) rad
    pitch: Array  # (...) m/rad


class Problem(NamedTuple):
    """Data of a fit, in the axes of the main body."""

    turns: Array  # (3, 3, S, ...) moments of the rotation
    paths: Array  # (3, 4, 3, 4, S, ...) moments of the translation: direction times (1, origin), twice
    rows: Array  # (6, 6, S, ...) moments of the position of the body, and of the rotation
    held_turns: Array  # (3, ...) bool, whether each rotation is held
    held_paths: Array  # (3, ...) bool, whether each translation is held
    held_row: Array  # (...) bool, whether the position along the axis is held
    pitch: Array  # (...) bool, whether there is a pitch
    tilted: Array  # (...) bool, whether there is a tilt
    tie: Array  # (...) bool, whether a tilt has a cost
    details: Array  # (S, ...) number n_s of independent details
    scale: Array  # (...) rad, size of the tilt
    box: Array  # (...) m, half the width of the cube of origins


def tilted_axis(tilt: Array) -> Array:
    """Return the third axis (3, ...) of the rotation by the rotation vector (t_0, t_1, 0), rad."""
    angle = jnp.sqrt(total(tilt * tilt, 0) + jnp.finfo(tilt.dtype).tiny)
    sine = jnp.sin(angle) / angle
    return jnp.stack([sine * tilt[1], -sine * tilt[0], jnp.cos(angle)])


def _held(form: Array, held: Array, details: Array) -> tuple[Array, Array]:
    """Compute n_s C_s^-1 of held columns (3, 3, S, B, ...), zero elsewhere, and the sum of n_s log det C_s.

    The covariances C_s of B blocks are (3, 3, S, B, ...), ``held`` is (3, B, ...) bool, and n_s (S, ...).
    """
    both = (held[:, None] & held[None])[:, :, None]
    small = jnp.finfo(form.dtype).tiny ** 0.5
    unit = unit_matrix(form.dtype, form.ndim - 2)
    lifted = jnp.where(both, form, 0) + unit * jnp.where(held, small, 1)[:, None, None]
    inverse, det = invert_symmetric([lifted[i, j] for i, j in INDEX_PAIRS])
    count = details[:, None]
    return materialize(jnp.where(both, inverse * count, 0)), total(count * jnp.log(det), 0, 1)


def axis_row(at: Unknowns) -> Array:
    """Weights (6, ...) of the position along the axis, less pitch times the rotation about the axis."""
    return jnp.concatenate([times(at.frame, tilted_axis(at.tilt)), -at.pitch * at.frame[:, 2]])


def row_size(rows: Array, row: Array) -> tuple[Array, Array]:
    """Return moments (6, 6, S, ...) times a row (6, ...), and the variance (S, ...) of this row."""
    moved = total(rows * row[None, :, None], 1)
    moved = materialize(moved)
    return moved, total(moved * row[:, None], 0)


def path_of(paths: Array, origin: Array) -> tuple[Array, Array]:
    """Moments (3, 4, 3, S, ...) of (1, origin) with the path, and (3, 3, S, ...) of the path."""
    x = origin[:, None]
    half = paths[:, :, :, 0] + total(paths[:, :, :, 1:] * x, 3)
    half = materialize(half)
    return half, materialize(half[:, 0] + total(half[:, 1:] * x[:, None], 1))


def _blocks(problem: Problem, frame: Array, origin: Array) -> Local:
    """The objective of the held blocks, in rotation and origin."""
    half, path = path_of(problem.paths, origin)
    forms = materialize(jnp.stack([problem.turns, path], axis=3))  # (3, 3, S, 2, ...)
    held = jnp.stack([problem.held_turns, problem.held_paths], axis=1)
    lanes = frame[:, :, None]
    inverse, value = _held(materialize(sandwich(lanes, forms)), held, problem.details)
    weight = materialize(sandwich(jnp.swapaxes(lanes, 0, 1), inverse))
    # directions turn, the origin moves
    pulled = materialize(total(times(forms, weight), 2, 3))
    sizes, weights = materialize((trace(forms), trace(weight)))
    bent = materialize(total(forms * weights + weight * sizes, 2, 3))
    unit = unit_matrix(frame.dtype, value.ndim)
    apart = materialize(total(weights * sizes, 0, 1)) - trace(pulled)
    turns = apart * unit + pulled + jnp.swapaxes(pulled, 0, 1) - bent
    on_path = weight[:, :, :, 1]
    ahead = materialize(total(on_path[:, :, None, None] * half[None, :, 1:], 1, 4))  # (k, a, j)
    both = axial(jnp.swapaxes(ahead, 1, 2))
    moves = materialize(total(problem.paths[:, 1:, :, 1:] * on_path[:, None, :, None], 4))
    gradient = jnp.stack([-axial(pulled), ahead[0, :, 0] + ahead[1, :, 1] + ahead[2, :, 2]], axis=1)
    return Local(value, gradient, jnp.stack([turns, total(moves, 0, 2)], axis=2), both[:, :, None])


def _row(problem: Problem, at: Unknowns) -> tuple[Array, Array, Array]:
    """Value, gradient and Hessian (6, ...) of the position along the axis, in rotation, tilt and pitch.

    The tilt is given by tangents (t_0, t_1): the axis lies along (t_0, t_1, 1) in the frame.
    """
    frame, third = at.frame, at.frame[:, 2]
    inverse = 1 / jnp.sqrt(1 + total(at.tilt * at.tilt, 0))
    axis = jnp.concatenate([at.tilt, jnp.ones_like(inverse)[None]]) * inverse
    along = times(frame, axis)
    parts = materialize(jnp.stack([along, -at.pitch * third]))
    row = parts.reshape(6, *inverse.shape)
    moved, size = row_size(problem.rows, row)
    size = jnp.where(problem.held_row, size + jnp.finfo(size.dtype).tiny ** 0.5, 1)
    each = materialize(jnp.where(problem.held_row, problem.details / size, 0))
    spun = jnp.swapaxes(crosses(jnp.swapaxes(parts, 0, 1)), 1, 2).reshape(3, *row.shape)  # e_m x v
    tilted = jnp.swapaxes(frame[:, :2] - along[:, None] * axis[None, :2], 0, 1) * inverse
    tilted = jnp.where(problem.tilted, tilted, 0)
    zero = jnp.zeros_like(third)
    advance = jnp.concatenate([zero, jnp.where(problem.pitch, -third, 0)])[None]
    spun, tilted, advance = materialize((spun, tilted, advance))
    slopes = jnp.concatenate([spun, jnp.concatenate([tilted, jnp.zeros_like(tilted)], axis=1), advance])
    gradient = total(slopes * materialize(total(each * moved, 1))[None], 1)
    carried = materialize(times(slopes, materialize(total(problem.rows * each, 2))))
    hessian = materialize(total(carried[:, None] * slopes[None], 2))
    return total(problem.details * jnp.log(size), 0), gradient, hessian


# the diagonal (3, 3, 3) of the tilt, in the group of tilt and pitch
_TILTS = np.diag([1.0, 1, 0])[:, :, None] * (np.arange(3) == 2)


def _expand(problem: Problem, at: Unknowns) -> Local:
    """The objective about a point, in rotation, origin, and tilt with pitch."""
    held, tilt = _held_parts(problem, at), at.tilt
    count, squared = total(problem.details, 0), total(tilt * tilt, 0)
    cost = jnp.where(problem.tie, count * jnp.log1p(squared / problem.scale**2), 0)
    bend = jnp.where(problem.tie, count / (problem.scale**2 + squared), 0)
    none = jnp.zeros_like(held.gradient[:, 0])
    slope = jnp.concatenate([bend * tilt, none[:1]])
    gradient = held.gradient + jnp.stack([none, none, slope], axis=1)
    bends = jnp.asarray(_TILTS, bend.dtype).reshape(3, 3, 3, *[1] * bend.ndim) * bend
    return Local(held.value + cost, gradient, held.diagonal + bends, held.coupling)


# axes of the scales
_SCALES = Problem(2, 4, 2, -1, -1, -1, -1, -1, -1, 0, -1, -1)  # type: ignore[arg-type]


@partial(added_up, axes=(_SCALES, -1))
def _held_parts(problem: Problem, at: Unknowns) -> Local:
    """The objective without the cost of the tilt."""
    value, first, blocks, both = _blocks(problem, at.frame, at.origin)
    of_row, second, row = materialize(_row(problem, at))
    turns = materialize(blocks[:, :, 0] + row[:3, :3])[:, :, None]
    return Local(
        value + of_row,
        jnp.stack([first[:, 0] + second[:3], first[:, 1], second[3:]], axis=1),
        jnp.concatenate([turns, blocks[:, :, 1:], row[3:, 3:, None]], axis=2),
        jnp.concatenate([both, row[:3, 3:, None]], axis=2),
    )


def descend(problem: Problem, start: Unknowns, steps: int | Array) -> Unknowns:
    """Take Levenberg-Marquardt steps."""

    def move(at: Unknowns, step: Array) -> Unknowns:
        return Unknowns(
            rotate(step[:, 0], at.frame),
            jnp.clip(at.origin + step[:, 1], -problem.box, problem.box),
            at.tilt + step[:2, 2],
            at.pitch + step[2, 2],
        )

    start = start._replace(tilt=_tangents(start.tilt))
    at, _ = levenberg_marquardt(partial(_expand, problem), move, start, start.pitch, 3, steps)
    return at._replace(tilt=_angles(at.tilt))


def _tangents(tilt: Array) -> Array:
    """Tilt (t_0, t_1, 1) of the axis, from the rotation vector of a tilt."""
    axis = tilted_axis(tilt)
    return axis[:2] / axis[2:]


def _angles(tangents: Array) -> Array:
    """The inverse of :func:`_tangents`."""
    length = jnp.sqrt(total(tangents * tangents, 0) + jnp.finfo(tangents.dtype).tiny)
    return jnp.stack([-tangents[1], tangents[0]]) * (jnp.arctan(length) / length)

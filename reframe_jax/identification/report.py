"""Build the identification of a window from the most probable entry of the table of constraints."""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.constraints.types import ORIENTATION_BODIES, POSITION_BODIES, AngularType
from reframe_jax.geometry.rotations import rotation_log
from reframe_jax.geometry.small import diagonalize
from reframe_jax.identification.cautions import Caution, caution_codes
from reframe_jax.identification.classify import Thresholds, degrees_of_freedom, free_rotations
from reframe_jax.identification.frames import AllCandidates, AngularFrame, Candidates, LinearFrame, PoseNoise
from reframe_jax.identification.naming import SAME_IN_ALL_TYPES
from reframe_jax.identification.optima import (
    TURN_KINDS,
    Types,
    rms_velocities,
    smallest_scale,
    types_of_steps,
    types_over_scales,
)
from reframe_jax.identification.preparation import Prepared
from reframe_jax.identification.results import Identification
from reframe_jax.identification.winner import KIND_OF_ENTRY, Winner, winner_by_thresholds, winner_of_window
from reframe_jax.model import features as z
from reframe_jax.model.fit import Data, coordinates_along, ground_axes
from reframe_jax.model.moments import Moments
from reframe_jax.model.solve import Solved
from reframe_jax.model.table import ENTRIES, LINEAR_KINDS, ROWS, TABLE, entries_at
from reframe_jax.motion.checks import Status

Array = jax.Array

_RIVAL = 0.05  # smallest ratio of the probability of a tied type to that of the reported type
_DEVIATIONS = 3.0  # largest difference of tied types with thresholds, in standard deviations
_AT_BOUND = 0.999  # smallest coordinate of an origin on the boundary, as a fraction of the box

_FREE = np.array([entry.dof for entry in ENTRIES], np.int32)
_ANY_ORIGIN = np.array([[c in entry.any_origin for c in range(3)] for entry in ENTRIES])
_NORMAL = np.array([entry.start == "normal" for entry in ENTRIES])
_CROSSED = TABLE.crossed
_IN_GROUND = TABLE.ground[:, 0] & ~_CROSSED & (_FREE[:, 0] % 3 > 0)  # all or no rotations: in either body


class _Rows(NamedTuple):
    """Three rotations, or three translations, along the reported axes."""

    axes: Array  # (3, 3), columns are the axes
    weights: Array  # (3, 27) weights of the features in each coordinate
    square: Array  # (3,) mean square of each coordinate over the recording, m^2 or rad^2
    dof: Array  # (3,) int, 1 for free axes


def _block_rows(axes: Array, weights: Array, together: Array, free: Array, total: Array) -> _Rows:
    """Rotate axes to the principal axes of their block, sort them, and fix their signs.

    Constrained axes come first, then free axes, both in ascending order of amplitude. A block is a set of
    axes that may be rotated into each other without a change of the constraint.
    """
    covariance = jnp.where(together, weights @ total @ weights.T, 0)
    turn = _eigenvectors(covariance, together)
    axes, weights = axes @ turn, turn.T @ weights
    square = jnp.einsum("if,fg,ig->i", weights, total, weights)
    order = jnp.argsort(jax.lax.stop_gradient(square / jnp.max(square)) + 2.0 * free)
    axes, weights, square, free = axes[:, order], weights[order], square[order], free[order]
    sign = [_sign(axes[:, 0]), jnp.ones(()), _sign(axes[:, 2])]
    axes = axes * jnp.stack(sign).astype(axes.dtype)
    return _Rows(
        axes.at[:, 1].set(jnp.cross(axes[:, 2], axes[:, 0])), weights, square, free.astype(jnp.int32)
    )


def _rows_along(axes: Array, rows: Array, dof: Array, total: Array) -> _Rows:
    """Coordinates along given axes; ``rows`` (3, 27) are the weights along the axes of the body."""
    weights = axes.T @ rows
    return _Rows(axes, weights, jnp.einsum("if,fg,ig->i", weights, total, weights), dof)


def _directions_of_types(types: Types, kind: Array, normal: Array) -> Array:
    """Columns (3, 3) of an entry's frame, in the body of the origin, from the best frames of the types.

    The frame needs to be right only in the columns along which every origin of the type ``kind`` is valid.
    The axis is the normal of a surface if ``normal``, otherwise the axis of the largest rotation.
    """
    own = types.linear_axes[kind]
    axis = jnp.where(normal, own[:, 0], types.angular_axes[jnp.asarray(POSITION_BODIES)[kind], :, 2])
    second = own[:, 2] - axis * (axis @ own[:, 2])  # of slots, the free direction
    second = second / (jnp.linalg.norm(second) + jnp.finfo(second.dtype).tiny)
    return jax.lax.stop_gradient(jnp.stack([jnp.cross(second, axis), second, axis], axis=1))


def _eigenvectors(covariance: Array, together: Array) -> Array:
    """Return the eigenvectors of the blocks of a covariance (3, 3), with their first derivative."""
    fixed = jax.lax.stop_gradient(covariance)
    turn = diagonalize(fixed[:, :, None])
    seen = turn.T @ covariance @ turn
    size = jax.lax.stop_gradient(jnp.diagonal(seen))
    gap = size[None, :] - size[:, None]
    apart = together & (jnp.abs(gap) > 1e-9 * jnp.max(size))
    # the change is zero, but its derivative is not
    change = jnp.where(apart, (seen - jax.lax.stop_gradient(seen)) / jnp.where(apart, gap, 1), 0)
    return turn + turn @ change


def _sign(axis: Array) -> Array:
    """Return the sign that makes the largest component of an axis positive."""
    axis = jax.lax.stop_gradient(axis)
    return jnp.where(axis[jnp.argmax(jnp.abs(axis)).astype(jnp.int32)] < 0, -1, 1)


def _rotvec(axes: Array, dof: Array) -> Array:
    """Return the rotation vector of axes; rotations among free or constrained axes have no derivative."""
    fixed = jax.lax.stop_gradient(axes)
    turn = fixed.T @ axes
    at_rest = jax.lax.stop_gradient(turn)
    distinct = (dof[:, None] != dof[None, :]).astype(axes.dtype)
    return rotation_log(fixed @ (at_rest + distinct * (turn - at_rest)))


def report_windows(
    window: Prepared,
    live: Moments,
    scale_weight: Array,
    solved: Solved,
    thresholds: Thresholds | None,
    exponent: float,
    of_steps: tuple[Array, Array] | None,
    assumed: Array,
) -> Identification:
    """Build the identification of N windows.

    Args:
        window: prepared windows; the result is differentiable with respect to their features and moments.
        live: moments of the windows, with 0 details at scales that the search did not use.
        scale_weight: (N, S) weights of the scales in the amplitudes over the recording.
        solved: result of the model, without derivatives.
        thresholds: RMS velocities above which an axis is free; None if probabilities decide.
        exponent: exponent of the power mean over the axes, for the norms.
        of_steps: moments of the velocities of single steps, if RMS velocities are those of single steps.
        assumed: () bool, whether the caller assumes a constraint.
    """
    window = window._replace(steps=jnp.broadcast_to(window.steps, (len(window.poses), window.steps.shape[1])))
    step = jnp.mean(window.steps, axis=1)
    single_steps = of_steps is not None
    if of_steps is not None:
        types = types_of_steps(of_steps, solved, exponent)
    else:
        types = jax.vmap(types_over_scales)(solved, live, step)
    of_window = partial(_report_window, thresholds=thresholds, single_steps=single_steps, assumed=assumed)
    found = jax.vmap(of_window)(window, live, scale_weight, solved, types, step)
    return _with_status(found, window)


def _report_window(
    window: Prepared,
    live: Moments,
    scale_weight: Array,
    solved: Solved,
    types: Types,
    step: Array,
    *,
    thresholds: Thresholds | None,
    single_steps: bool,
    assumed: Array,
) -> tuple[Identification, Array, Array]:
    """Return the identification of one window, whether its origin is on the bounds, and its warning codes."""
    mean = window.features.mean_rotation
    data = Data(live.products, live.details, mean, window.box)
    total = jnp.einsum("s,sfg->fg", scale_weight, live.products)
    fixed = jax.vmap(_fix_signs)(jnp.concatenate([types.angular_axes, types.linear_axes]))
    types = types._replace(angular_axes=fixed[:2], linear_axes=fixed[2:])
    if thresholds is None:
        winner = winner_of_window(solved, data)
    else:
        angular_dof_all = degrees_of_freedom(types.angular_rms, thresholds.angular)
        linear_dof_all = degrees_of_freedom(types.linear_rms, thresholds.linear)
        winner = winner_by_thresholds(types, solved, angular_dof_all, linear_dof_all)
    code, parameters = winner.code, winner.parameters
    known, kind = jnp.maximum(code, 0), winner.kind
    bodies = jnp.stack([ground_axes(parameters, mean), parameters.axes])  # by AngularType
    entry = entries_at(known)
    weights = coordinates_along(bodies[0], parameters._replace(pitch=jnp.zeros_like(parameters.pitch)), entry)
    held = entry.held & ~(entry.pitch & (jnp.arange(6) == 5))
    linear_axes = bodies[jnp.asarray(ORIENTATION_BODIES)[kind]][:, entry.column[3:]]
    of_linear = linear_axes, weights[3:], entry.together[3:, 3:], ~held[3:]
    turned_in = jnp.where(jnp.asarray(_IN_GROUND)[known], int(AngularType.G), int(AngularType.B))
    in_plane = entry.tied & entry.apart & held[5] & _turns_less_in_ground(bodies[0], weights, total)
    turned_in = jnp.where(in_plane, int(AngularType.G), turned_in)
    angular_type = jnp.where(jnp.sum(~held[:3]) == 2, jnp.argmin(types.angular_norm), turned_in)
    angular_type = angular_type.astype(jnp.int32)
    plain = entry.crossed | (jnp.sum(~held[:3]) == 3) | (jnp.sum(~held[:3]) == 0)
    of_types = []
    for body in (AngularType.G, AngularType.B):
        axes = jnp.where(plain, types.angular_axes[body], bodies[body][:, entry.column[:3]])
        rows = axes.T @ jnp.asarray(ROWS[TURN_KINDS[body], :, 0], axes.dtype)
        free = jnp.where(plain, jnp.arange(3) >= 3 - jnp.sum(~held[:3]), ~held[:3])
        together = free[:, None] == free[None, :]
        of_types.append((axes, rows, together, free))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), of_linear, *of_types)
    every: _Rows = jax.vmap(partial(_block_rows, total=total))(*stacked)
    linear, angular_all = _Rows(*(leaf[0] for leaf in every)), _Rows(*(leaf[1:] for leaf in every))
    speeds = partial(rms_velocities, live=live, step=step)
    angular_rms, linear_rms = jax.vmap(speeds)(angular_all.weights), speeds(linear.weights)
    any_origin = jnp.asarray(_ANY_ORIGIN)[known]
    directions = bodies[jnp.asarray(POSITION_BODIES)[kind]]
    if thresholds is not None:
        # without an entry in the table, every origin is valid only if all translations are free
        every_origin = jnp.all(linear_dof_all[kind] == 1)
        any_origin = jnp.where(code >= 0, any_origin, every_origin)
        directions = _directions_of_types(types, kind, jnp.asarray(_NORMAL)[known])
    free_position = (directions * any_origin) @ directions.T
    at_bound = jnp.any(jnp.abs(parameters.origin) > _AT_BOUND * window.box) & ~jnp.all(any_origin)
    position = parameters.origin - free_position @ parameters.origin
    offset = jnp.where(jnp.asarray(POSITION_BODIES)[kind] == int(AngularType.G), window.centre, 0)
    velocities = jnp.sum(window.counted) - 1
    tied = _tied_types(winner, kind, thresholds, types, velocities)
    if thresholds is None:
        linear_dof_all = _last_free(jnp.sum(linear.dof), 4)
    if thresholds is not None or single_steps:
        # as in the paper, the reported frame is the best frame of its type
        if thresholds is None:
            angular_dof_all = _last_free(jnp.sum(angular_all.dof[0]), 2)
        else:
            angular_type = jnp.argmin(types.angular_norm).astype(jnp.int32)
        rows_along = partial(_rows_along, total=total)
        rows = jnp.asarray(ROWS, total.dtype)
        angular_all = jax.vmap(rows_along)(types.angular_axes, rows[TURN_KINDS, :, 0], angular_dof_all)
        point = jnp.concatenate([jnp.ones_like(position[:1]), parameters.origin])
        of_point = jnp.einsum("iaf,a->if", rows[LINEAR_KINDS][kind], point)
        linear = rows_along(types.linear_axes[kind], of_point, linear_dof_all[kind])
        angular_rms, linear_rms = types.angular_rms, types.linear_rms[kind]
    a = angular_type
    shift = jnp.where((jnp.asarray(POSITION_BODIES) == int(AngularType.G))[:, None], window.centre[None], 0)
    positions = (solved.origins + shift).at[kind].set(position + offset)
    linear_axes_all = types.linear_axes.at[kind].set(linear.axes)
    linear_rms_all = types.linear_rms.at[kind].set(linear_rms)
    linear_dof_all = linear_dof_all.at[kind].set(linear.dof)
    every_dof = jnp.concatenate([angular_all.dof, linear_dof_all])
    rotvecs = jax.vmap(_rotvec)(jnp.concatenate([angular_all.axes, linear_axes_all]), every_dof)
    angular_rotvecs, linear_rotvecs = rotvecs[:2], rotvecs[2:]
    crossed = entry.crossed & (thresholds is None)
    found = Identification(
        angular=AngularFrame(
            type_code=a,
            rotvec=angular_rotvecs[a],
            dof=angular_all.dof[a],
            free_probability=_free_probability(winner, 0, angular_all.dof[a]),
            rms=angular_rms[a],
            amplitude=jnp.sqrt(jnp.maximum(angular_all.square[a], 0) + 1e-30),
            norm=types.angular_norm[a],
            norms=types.angular_norm,
            tied=jnp.where(jnp.sum(angular_all.dof[a]) == 2, jnp.arange(2) == a, True),
            free_rotation=free_rotations(angular_all.dof[a]),
        ),
        linear=LinearFrame(
            type_code=kind,
            rotvec=linear_rotvecs[kind],
            position=position + offset,
            dof=linear.dof,
            free_probability=_free_probability(winner, 1, linear.dof),
            rms=linear_rms,
            amplitude=jnp.sqrt(jnp.maximum(linear.square, 0) + 1e-30),
            norm=types.linear_norm[kind],
            norms=types.linear_norm,
            tied=tied,
            free_rotation=free_rotations(linear.dof),
            free_position=free_position,
        ),
        candidates=AllCandidates(
            angular=Candidates(angular_rotvecs, angular_all.dof, angular_rms, types.angular_norm),
            linear=Candidates(linear_rotvecs, linear_dof_all, linear_rms_all, types.linear_norm, positions),
        ),
        entry_code=code,
        entry_probability=winner.probability,
        pitch=jnp.where(entry.pitch & (code >= 0), parameters.pitch, jnp.nan),
        universal_axes=jnp.where(crossed, jnp.stack([bodies[0][:, 2], bodies[1][:, 0]]), jnp.nan),
        noise=PoseNoise(position=window.noise[0], rotation=window.noise[1]),
        scale=jnp.sum(jnp.where(smallest_scale(live), live.width, 0)).astype(jnp.int32),
        counted=window.counted,
        status_code=jnp.zeros((), jnp.int32),
        warning_codes=jnp.zeros((), jnp.int32),
    )
    improbable = winner.name_probability < 0.5
    noisy = jnp.any((live.details > 0) & (scale_weight == 0))
    marks = {Caution.IMPROBABLE: improbable & ~assumed, Caution.IMPROBABLE_ASSUMED: improbable & assumed}
    marks[Caution.NOISY_SCALE] = noisy
    codes = caution_codes(velocities, (angular_rms[a], linear_rms), thresholds, marks)
    return found, at_bound, codes


def _turns_less_in_ground(axes: Array, weights: Array, total: Array) -> Array:
    """Whether the positions determine the axis of a planar motion better than the rotations do, ().

    The uncertainty of an axis is the ratio of a residual to the motion that determines the axis. For
    rotations, this is the constrained rotation over the free rotation. For positions, it is the displacement
    along the axis over the smaller amplitude in the plane.
    """
    square = jnp.einsum("if,fg,ig->i", weights, total, weights)
    held_turns, turn, along = square[0] + square[1], square[2], square[5]
    plane = axes[:, :2].T @ total[z.POSITION, z.POSITION] @ axes[:, :2]
    half = jnp.trace(plane) / 2
    det = plane[0, 0] * plane[1, 1] - plane[0, 1] * plane[1, 0]
    weaker = half - jnp.sqrt(jnp.maximum(half * half - det, 0))
    return along * turn < held_turns * weaker


def _last_free(number: Array, types: int) -> Array:
    """Return degrees of freedom (types, 3) in which the last ``number`` axes of every type are free."""
    return jnp.broadcast_to(jnp.arange(3) >= 3 - number, (types, 3)).astype(jnp.int32)


def _fix_signs(axes: Array) -> Array:
    first, third = axes[:, 0] * _sign(axes[:, 0]), axes[:, 2] * _sign(axes[:, 2])
    return jnp.stack([first, jnp.cross(third, first), third], axis=1)


def _free_probability(winner: Winner, group: int, dof: Array) -> Array:
    """Return the probability that each axis is free, in ascending order, (3,)."""
    count = jnp.asarray(_FREE[:, group])
    above = [jnp.sum(jnp.where(count >= free, winner.probability, 0)) for free in (3, 2, 1)]
    found = jnp.clip(jnp.stack(above), 0, 1)
    return jnp.where(jnp.isnan(winner.probability[0]), dof.astype(found.dtype), found)


def _tied_types(
    winner: Winner, kind: Array, thresholds: Thresholds | None, types: Types, velocities: Array
) -> Array:
    """Return which linear types fit equally well, (4,) bool.

    By default, these are the types whose entries, with the same degrees of freedom, are nearly as probable as
    the reported entry. With thresholds, these are the types whose geometric mean of the RMS velocities along
    the constrained axes is within three standard deviations of that of the reported type. (Velocities of
    consecutive steps are correlated: 1.5 velocities count as one.)
    """
    own = jnp.arange(4) == kind
    if thresholds is not None:
        held = types.linear_rms[kind] <= thresholds.linear
        count = jnp.sum(held)
        logs = jnp.log(types.linear_rms)
        excess = jnp.sum(jnp.where(held, logs - logs[kind], 0), axis=1) / jnp.maximum(count, 1)
        margin = _DEVIATIONS / jnp.sqrt(jnp.maximum(count, 1) * velocities / 1.5)
        return own | (excess < margin) | (count == 0)
    same = jnp.all(jnp.asarray(_FREE) == jnp.asarray(_FREE)[winner.code], axis=1)
    of_types = jax.ops.segment_sum(jnp.where(same, winner.probability, 0), jnp.asarray(KIND_OF_ENTRY), 4)
    return own | (of_types >= _RIVAL * of_types[kind]) | jnp.asarray(SAME_IN_ALL_TYPES)[winner.code]


def _with_status(found: tuple[Identification, Array, Array], window: Prepared) -> Identification:
    """Set the status of the windows, and set the numbers of failed windows to NaN or zero."""
    result, at_bound, codes = found
    still = jnp.sum(result.angular.dof, axis=-1) + jnp.sum(result.linear.dof, axis=-1) == 0
    outcome = jnp.where(at_bound, Status.ON_BOUNDS, Status.OK)
    outcome = jnp.where(still, Status.NOT_EXCITED, outcome)
    outcome = jnp.where(_is_finite(result), outcome, Status.OUT_OF_RANGE).astype(jnp.int32)
    outcome = jnp.where(window.status >= 10, window.status, outcome)
    failed = outcome >= 10

    leaves, tree = jax.tree.flatten(result)
    for dtype in dict.fromkeys(leaf.dtype for leaf in leaves):  # in one order, for the cache of programs
        # one operation for all numbers of a dtype: an operation for every leaf takes long to compile
        mine = [i for i, leaf in enumerate(leaves) if leaf.dtype == dtype]
        flat = [leaves[i].reshape(len(failed), -1) for i in mine]
        empty = jnp.nan if jnp.issubdtype(dtype, jnp.floating) else 0
        whole = jnp.where(failed[:, None], jnp.asarray(empty, dtype), jnp.concatenate(flat, axis=1))
        for i, part in zip(mine, jax.lax.split(whole, [x.shape[1] for x in flat], 1), strict=True):
            leaves[i] = part.reshape(leaves[i].shape)
    result = jax.tree.unflatten(tree, leaves)
    return replace(result, status_code=outcome, warning_codes=jnp.where(failed, 0, codes))


def _is_finite(found: Identification) -> Array:
    """Return whether all numbers of the frames of each window are finite, (N,) bool."""
    numbers = (found.angular, found.linear, found.noise)
    leaves = [x for x in jax.tree.leaves(numbers) if jnp.issubdtype(x.dtype, jnp.floating)]
    flat = jnp.concatenate([x.reshape(len(x), -1) for x in leaves], axis=1)
    return jnp.all(jnp.isfinite(flat), axis=1)

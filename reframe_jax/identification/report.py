"""Build the identification of a window from the most probable entry of the table of constraints."""

from dataclasses import replace
from functools import partial
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.constraints.types import POSITION_BODIES, AngularType
from reframe_jax.identification.axes import (
    Frames,
    Recorded,
    Rows,
    fix_signs,
    frames_of_entry,
    frames_of_types,
    rotation_vector,
)
from reframe_jax.identification.cautions import Caution, caution_codes
from reframe_jax.identification.classify import Thresholds
from reframe_jax.identification.frames import AllCandidates, AngularFrame, Candidates, LinearFrame, PoseNoise
from reframe_jax.identification.naming import SAME_IN_ALL_TYPES
from reframe_jax.identification.optima import Types, smallest_scale, types_of_steps, types_over_scales
from reframe_jax.identification.preparation import Prepared
from reframe_jax.identification.results import Identification
from reframe_jax.identification.winner import KIND_OF_ENTRY, Winner, winner_by_thresholds, winner_of_window
from reframe_jax.model.fit import Data, ground_axes
from reframe_jax.model.moments import Moments, relative_to_mean, relative_to_section
from reframe_jax.model.solve import Compared, ScaleWeights, Searched
from reframe_jax.model.table import ENTRIES
from reframe_jax.motion.checks import Status

Array = jax.Array

_RIVAL = 0.05  # smallest ratio of the probability of a tied type to that of the reported type
_DEVIATIONS = 3.0  # largest difference of tied types with thresholds, in standard deviations
_AT_BOUND = 0.999  # smallest coordinate of an origin on the boundary, as a fraction of the box

_FREE = np.array([entry.dof for entry in ENTRIES], np.int32)  # of rotations and of translations
_FREE[:, 1] += [entry.pitch for entry in ENTRIES]
_ANY_ORIGIN = np.array([[c in entry.any_origin for c in range(3)] for entry in ENTRIES])
_NORMAL = np.array([entry.start == "normal" for entry in ENTRIES])


def report_windows(
    prepared: Prepared,
    weights: ScaleWeights,
    searched: Searched,
    compared: Compared | None,
    thresholds: Thresholds | None,
    exponent: float,
    of_steps: tuple[Array, Array] | None,
    assumed: Array,
) -> Identification:
    """Build the identification of N windows.

    The result is differentiable with respect to the features and moments of the prepared windows. Without a
    comparison of entries, thresholds of RMS velocities decide which axes are free. The norms are power means
    over the axes, with the exponent. ``of_steps`` has moments of the velocities of single steps, if RMS
    velocities are those of single steps; ``assumed`` () bool, whether the caller assumes a constraint.
    """
    used = prepared.moments._replace(details=weights.search)
    single_steps = of_steps is not None
    if of_steps is not None:
        types = types_of_steps(of_steps, searched, exponent)
    else:
        types = jax.vmap(types_over_scales)(searched, used)
    of_window = partial(_report_window, thresholds=thresholds, single_steps=single_steps, assumed=assumed)
    recorded = _recorded(prepared, used, weights.amplitude)
    found = jax.vmap(of_window)(prepared, recorded, weights.amplitude, searched, compared, types)
    return _with_status(found, prepared)


def _recorded(prepared: Prepared, used: Moments, scale_weight: Array) -> Recorded:
    """Return the features of N windows, and their moments, with the weights (N, S) of the used scales."""
    values = prepared.features.values
    own = (jnp.arange(values.shape[2]) < prepared.length[:, None])[:, None].astype(values.dtype)
    # displacements across a gap are not used
    values = relative_to_section(relative_to_mean(values, own)[0], own, prepared.section)
    weights = jnp.stack([scale_weight, prepared.moments.scale_weight], axis=1)[..., None, None]
    sums = jnp.sum(weights * used.products[:, None], axis=2)  # a GPU multiplies many small matrices slowly
    return Recorded(values, jnp.sum(own, axis=(1, 2)), used, sums)


def _report_window(
    window: Prepared,
    recorded: Recorded,
    scale_weight: Array,
    searched: Searched,
    compared: Compared | None,
    types: Types,
    *,
    thresholds: Thresholds | None,
    single_steps: bool,
    assumed: Array,
) -> tuple[Identification, Array, Array]:
    """Return the identification of one window, whether its origin is on the bounds, and its warning codes."""
    mean, used = window.features.mean_rotation, recorded.used
    axes = jax.vmap(fix_signs)(jnp.concatenate([types.angular_axes, types.linear_axes]))
    types = types._replace(angular_axes=axes[:2], linear_axes=axes[2:])
    if thresholds is None:
        data = Data(used.products, used.details, mean, window.box)
        winner = winner_of_window(searched, cast(Compared, compared), data)
    else:
        angular_dof = (types.angular_rms > thresholds.angular).astype(jnp.int32)
        linear_dof = (types.linear_rms > thresholds.linear).astype(jnp.int32)
        winner = winner_by_thresholds(types, searched, angular_dof, linear_dof)
    kind, fitted = winner.kind, winner.parameters
    bodies = jnp.stack([ground_axes(fitted, mean), fitted.axes])  # by AngularType
    any_position = _any_position(winner, bodies, types, None if thresholds is None else linear_dof)
    position = fitted.origin - any_position @ fitted.origin
    winner = winner._replace(parameters=fitted._replace(origin=position))
    frames = frames_of_entry(winner, bodies, types, recorded)
    if thresholds is None:
        angular_dof = _last_free(jnp.sum(frames.angular.dof[0]), 2)
        linear_dof = _last_free(jnp.sum(frames.linear.dof), 4)
    if thresholds is not None or single_steps:
        # as in the paper, the reported frame is the best frame of its type
        best = jnp.argmin(types.angular_norm).astype(jnp.int32)
        a = frames.angular_type if thresholds is None else best
        frames = frames_of_types(a, winner, types, (angular_dof, linear_dof), recorded)
    centre = jnp.where((np.array(POSITION_BODIES) == int(AngularType.G))[:, None], window.centre, 0)
    positions = searched.origins.at[kind].set(position) + centre
    candidates = _candidates(frames, types, kind, linear_dof, positions)
    velocities = window.length - 1
    a, linear, known = frames.angular_type, candidates.linear, winner.entry
    angular_rows = jax.tree.map(lambda leaf: leaf[a], frames.angular)
    turns = jnp.sum(angular_rows.dof)
    crossed = known.crossed & (thresholds is None)
    found = Identification(
        angular=AngularFrame(
            **_of_frame(a, candidates.angular, angular_rows, _free_probability(winner, 0)),
            tied=jnp.where(turns == 2, jnp.arange(2) == a, True),
        ),
        linear=LinearFrame(
            **_of_frame(kind, linear, frames.linear, _free_probability(winner, 1)),
            tied=_tied_types(winner, thresholds, types, velocities),
            position=positions[kind],
            free_position=any_position,
        ),
        candidates=candidates,
        entry_code=winner.code,
        entry_probability=winner.probability,
        pitch=jnp.where(known.pitch & (winner.code >= 0), fitted.pitch, jnp.nan),
        universal_axes=jnp.where(crossed, jnp.stack([bodies[0][:, 2], bodies[1][:, 0]]), jnp.nan),
        noise=PoseNoise(position=window.noise[0], rotation=window.noise[1]),
        scale=jnp.sum(jnp.where(smallest_scale(used), used.width, 0)).astype(jnp.int32),
        counted=window.counted,
        status_code=jnp.zeros((), jnp.int32),
        warning_codes=jnp.zeros((), jnp.int32),
    )
    at_bound = jnp.any(jnp.abs(fitted.origin) > _AT_BOUND * window.box) & (jnp.trace(any_position) < 2.5)
    improbable = winner.name_probability < 0.5
    marks = {Caution.IMPROBABLE: improbable & ~assumed, Caution.IMPROBABLE_ASSUMED: improbable & assumed}
    marks[Caution.NOISY_SCALE] = jnp.any((used.details > 0) & (scale_weight == 0))
    codes = caution_codes(velocities, (found.angular.rms, found.linear.rms), thresholds, marks)
    return found, at_bound, codes


def _of_frame(code: Array, types: Candidates, rows: Rows, free: Array) -> dict[str, Array]:
    """Return the common fields of a frame of type ``code``; ``free`` (3,) are probabilities, or NaN."""
    return {
        "type_code": code,
        "rotvec": types.rotvec[code],
        "dof": rows.dof,
        "free_probability": jnp.where(jnp.isnan(free), rows.dof.astype(free.dtype), free),
        "rms": types.rms[code],
        "amplitude": jnp.sqrt(jnp.maximum(rows.square, 0) + 1e-30),
        "norm": types.norm[code],
        "norms": types.norm,
        "free_rotation": jnp.roll(rows.dof, 1) == jnp.roll(rows.dof, -1),  # of the two other axes
    }


def _candidates(
    frames: Frames, types: Types, kind: Array, linear_dof: Array, positions: Array
) -> AllCandidates:
    """Return the best frame of every type, with the reported frame for the reported types."""
    linear_axes = types.linear_axes.at[kind].set(frames.linear.axes)
    linear_dof = linear_dof.at[kind].set(frames.linear.dof)
    linear_rms = types.linear_rms.at[kind].set(frames.linear.rms)
    rotvecs = jax.vmap(rotation_vector)(
        jnp.concatenate([frames.angular.axes, linear_axes]), jnp.concatenate([frames.angular.dof, linear_dof])
    )
    return AllCandidates(
        Candidates(rotvecs[:2], frames.angular.dof, frames.angular.rms, types.angular_norm),
        Candidates(rotvecs[2:], linear_dof, linear_rms, types.linear_norm, positions),
    )


def _any_position(winner: Winner, bodies: Array, types: Types, linear_dof: Array | None) -> Array:
    """Return the projector (3, 3) onto the directions along which every origin is valid.

    ``linear_dof`` (4, 3) are degrees of freedom by thresholds; None if probabilities decide.
    """
    known, kind = jnp.maximum(winner.code, 0), winner.kind
    columns = jnp.asarray(_ANY_ORIGIN)[known]
    directions = bodies[jnp.asarray(POSITION_BODIES)[kind]]
    if linear_dof is not None:
        # without an entry in the table, every origin is valid only if all translations are free
        columns = jnp.where(winner.code >= 0, columns, jnp.all(linear_dof[kind] == 1))
        directions = _directions_of_types(types, kind, jnp.asarray(_NORMAL)[known])
    return (directions * columns) @ directions.T


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


def _last_free(number: Array, types: int) -> Array:
    """Return degrees of freedom (types, 3) in which the last ``number`` axes of every type are free."""
    return jnp.broadcast_to(jnp.arange(3) >= 3 - number, (types, 3)).astype(jnp.int32)


def _free_probability(winner: Winner, group: int) -> Array:
    """Return the probability that each axis is free, in ascending order, (3,); NaN with thresholds."""
    count = jnp.asarray(_FREE[:, group])
    above = [jnp.sum(jnp.where(count >= free, winner.probability, 0)) for free in (3, 2, 1)]
    return jnp.where(jnp.isnan(winner.probability[0]), jnp.nan, jnp.clip(jnp.stack(above), 0, 1))


def _tied_types(winner: Winner, thresholds: Thresholds | None, types: Types, velocities: Array) -> Array:
    """Return which linear types fit equally well, (4,) bool.

    By default, these are the types whose entries, with the same degrees of freedom, are nearly as probable as
    the reported entry. With thresholds, these are the types whose geometric mean of the RMS velocities along
    the constrained axes is within three standard deviations of that of the reported type. (Velocities of
    consecutive steps are correlated: 1.5 velocities count as one.)
    """
    kind = winner.kind
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


def _with_status(found: tuple[Identification, Array, Array], prepared: Prepared) -> Identification:
    """Set the status of the windows, and set the numbers of failed windows to NaN or zero."""
    result, at_bound, codes = found
    still = jnp.sum(result.angular.dof, axis=-1) + jnp.sum(result.linear.dof, axis=-1) == 0
    outcome = jnp.where(still, Status.NOT_EXCITED, jnp.where(at_bound, Status.ON_BOUNDS, Status.OK))
    outcome = jnp.where(_is_finite(result), outcome, Status.OUT_OF_RANGE).astype(jnp.int32)
    outcome = jnp.where(prepared.status >= 10, prepared.status, outcome)
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
    return jnp.all(jnp.isfinite(jnp.concatenate([x.reshape(len(x), -1) for x in leaves], axis=1)), axis=1)

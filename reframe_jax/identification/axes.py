"""The axes of the reported frames, the coordinates along them, and their RMS velocities.

Either the axes are those of the reported entry of the table, or, as in the paper, those of the best frame of
the reported type.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from reframe_jax.constraints.types import ORIENTATION_BODIES, AngularType
from reframe_jax.geometry.rotations import rotation_log
from reframe_jax.geometry.small import diagonalize, times
from reframe_jax.identification.optima import TURN_KINDS, Types, rms_velocities
from reframe_jax.identification.winner import Winner
from reframe_jax.model.fit import coordinates_along
from reframe_jax.model.moments import Moments
from reframe_jax.model.table import ENTRIES, LINEAR_KINDS, ROWS, TABLE

Array = jax.Array

# all or no rotations are free in either body; the axis of a planar motion is the normal of its plane
_IN_GROUND = TABLE.ground[:, 0] & ~TABLE.crossed & [0 < entry.dof[0] < 3 for entry in ENTRIES]
_IN_GROUND |= TABLE.tied & TABLE.apart & TABLE.held[:, 5] & ~TABLE.pitch


class Rows(NamedTuple):
    """Three rotations, or three translations, along the axes of a frame."""

    axes: Array  # (3, 3), columns are the axes
    rms: Array  # (3,) velocities along the axes, m/s or rad/s
    square: Array  # (3,) mean square of each coordinate over the recording, m^2 or rad^2
    dof: Array  # (3,) int, 1 for free axes


class Recorded(NamedTuple):
    """The features of one window, and their moments."""

    values: Array  # (27, P) relative to their mean, 0 for padding
    number: Array  # () number of poses
    used: Moments  # with the weights of the scales in the search
    scales: Array  # (2, 27, 27) moments, summed over the used scales, and over all scales

    def covariance(self, weights: Array) -> Array:
        """Covariance (..., 3, 3) over the recording of coordinates with the weights (..., 3, 27)."""
        coordinates = jnp.einsum("...if,fp->...ip", weights, self.values, precision="highest")
        return jnp.einsum("...ip,...jp->...ij", coordinates, coordinates, precision="highest") / self.number

    def signal_part(self, weights: Array) -> Array:
        """Part (3,) of the mean squares of coordinates that is at the used scales, and not white noise."""
        signal, every = jnp.einsum("if,kfg,ig->ki", weights, self.scales, weights)
        known = (signal > 0) & (every > 0)  # not lost by rounding
        return jnp.where(known, signal / jnp.where(known, every, 1), 1)


class Frames(NamedTuple):
    """The reported frames of one window."""

    angular_type: Array  # () ``AngularType``
    angular: Rows  # of both types, with an axis (2,) in front
    linear: Rows


def frames_of_entry(winner: Winner, bodies: Array, types: Types, recorded: Recorded) -> Frames:
    """Return the frames of the reported entry of one window, whose axes in both bodies are (2, 3, 3)."""
    entry, parameters = winner.entry, winner.parameters
    parameters = parameters._replace(pitch=jnp.zeros_like(parameters.pitch))
    weights = coordinates_along(bodies[0], parameters, entry)
    free = ~entry.held | (entry.pitch & (jnp.arange(6) == 5))
    axes = bodies[jnp.asarray(ORIENTATION_BODIES)[winner.kind]][:, entry.column[3:]]
    of_linear = axes, weights[3:], entry.together[3:, 3:], free[3:]
    turns = jnp.sum(free[:3])
    plain = entry.crossed | (turns == 3) | (turns == 0)
    turns_free = jnp.where(plain, jnp.arange(3) >= 3 - turns, free[:3])
    of_angular = []
    for body in AngularType:
        axes = jnp.where(plain, types.angular_axes[body], bodies[body][:, entry.column[:3]])
        rows = axes.T @ jnp.asarray(ROWS[TURN_KINDS[body], :, 0], axes.dtype)
        of_angular.append((axes, rows, turns_free[:, None] == turns_free[None, :], turns_free))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), of_linear, *of_angular)
    stacked += (recorded.covariance(stacked[1]),)
    every: Rows = jax.vmap(partial(_principal_rows, recorded))(*stacked)
    linear, angular = Rows(*(leaf[0] for leaf in every)), Rows(*(leaf[1:] for leaf in every))
    # ---- the body in which the rotation is reported
    in_ground = jnp.asarray(_IN_GROUND)[jnp.maximum(winner.code, 0)]
    of_turns = jnp.where(in_ground, int(AngularType.G), int(AngularType.B))
    angular_type = jnp.where(turns == 2, jnp.argmin(types.angular_norm), of_turns).astype(jnp.int32)
    return Frames(angular_type, angular, linear)


def frames_of_types(
    angular_type: Array, winner: Winner, types: Types, dof: tuple[Array, Array], recorded: Recorded
) -> Frames:
    """Return the best frames of the reported types of one window.

    ``dof`` are the degrees of freedom of all angular types (2, 3) and linear types (4, 3); for the other
    arguments, see :func:`frames_of_entry`.
    """
    kind, rows = winner.kind, jnp.asarray(ROWS, recorded.values.dtype)
    along = partial(_rows_along, recorded=recorded)
    angular = jax.vmap(along)(types.angular_axes, rows[TURN_KINDS, :, 0], dof[0], types.angular_rms)
    point = jnp.concatenate([jnp.ones(1, rows.dtype), winner.parameters.origin])
    of_point = jnp.einsum("iaf,a->if", rows[LINEAR_KINDS][kind], point)
    linear = along(types.linear_axes[kind], of_point, dof[1][kind], types.linear_rms[kind])
    return Frames(angular_type, angular, linear)


def _principal_rows(
    recorded: Recorded, axes: Array, weights: Array, together: Array, free: Array, covariance: Array
) -> Rows:
    """Rotate axes to the principal axes of their block, sort them, and fix their signs.

    Constrained axes come first, then free axes, both in ascending order of amplitude. A block is a set of
    axes that may be rotated into each other without a change of the constraint.
    """
    turn = _eigenvectors(jnp.where(together, covariance, 0), together)
    axes, weights = axes @ turn, turn.T @ weights
    square = jnp.einsum("ia,ij,ja->a", turn, covariance, turn) * recorded.signal_part(weights)
    order = jnp.argsort(jax.lax.stop_gradient(square / jnp.max(square)) + 2.0 * free)
    axes, weights, square, free = axes[:, order], weights[order], square[order], free[order]
    return Rows(fix_signs(axes), rms_velocities(weights, recorded.used), square, free.astype(jnp.int32))


def _rows_along(axes: Array, rows: Array, dof: Array, rms: Array, recorded: Recorded) -> Rows:
    """Coordinates along given axes; ``rows`` (3, 27) are the weights along the axes of the body."""
    weights = axes.T @ rows
    return Rows(axes, rms, jnp.diagonal(recorded.covariance(weights)) * recorded.signal_part(weights), dof)


def _eigenvectors(covariance: Array, together: Array) -> Array:
    """Return the eigenvectors of the blocks of a covariance (3, 3), with their first derivative."""
    turn = diagonalize(jax.lax.stop_gradient(covariance)[:, :, None])
    seen = times(times(turn.T, covariance), turn)
    size = jax.lax.stop_gradient(jnp.diagonal(seen))
    gap = size[None, :] - size[:, None]
    apart = together & (jnp.abs(gap) > 1e-9 * jnp.max(size))
    # the change is zero, but its derivative is not
    change = jnp.where(apart, (seen - jax.lax.stop_gradient(seen)) / jnp.where(apart, gap, 1), 0)
    return turn + times(turn, change)


def fix_signs(axes: Array) -> Array:
    """Make the largest components of the first and the third axis positive, and the frame right-handed."""
    ends = jax.lax.stop_gradient(axes[:, ::2])
    largest = jnp.argmax(jnp.abs(ends), axis=0).astype(jnp.int32)
    negative = jnp.take_along_axis(ends, largest[None], 0)[0] < 0
    first, third = (axes[:, ::2] * jnp.where(negative, -1, 1)).T
    return jnp.stack([first, jnp.cross(third, first), third], axis=1)


def rotation_vector(axes: Array, dof: Array) -> Array:
    """Return the rotation vector of axes; rotations among free or constrained axes have no derivative."""
    fixed = jax.lax.stop_gradient(axes)
    turn = times(fixed.T, axes)  # a GPU multiplies many small matrices slowly
    at_rest = jax.lax.stop_gradient(turn)
    distinct = (dof[:, None] != dof[None, :]).astype(axes.dtype)
    return rotation_log(times(fixed, at_rest + distinct * (turn - at_rest)))

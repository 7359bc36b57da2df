"""Errors of an identification relative to the truth, without the redundancies of the paper's section 5.3."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from reframe_jax.constraints.catalogue import Constraint, lookup
from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.types import LinearType, distinct_axis
from reframe_jax.geometry.products import apply, matmul
from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.identification.results import Identification

__all__ = ["GeometryErrors", "dof_correct", "geometry_errors", "types_correct"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class GeometryErrors:
    """Geometric errors; NaN for quantities that the constraint does not determine.

    Attributes:
        angular, linear: (...) rad, angle between the identified and the true determined axis of each frame.
        position: (...) m, distance along the determined components of the position.
    """

    angular: jax.Array
    linear: jax.Array
    position: jax.Array


def _axis_error(rotvec: jax.Array, truth: jax.Array, dof: tuple[int, int, int]) -> jax.Array:
    """Angle between the true distinct axis and the frame's, which is its slowest or fastest axis."""
    if (odd := distinct_axis(dof)) is None:
        return jnp.full(rotvec.shape[:-1], jnp.nan, dtype=rotvec.dtype)
    found = rotation_exp(rotvec)[..., :, 2 if sum(dof) == 1 else 0]
    true = jnp.broadcast_to(truth[..., :, odd].astype(found.dtype), found.shape)
    # atan2 of sine and cosine, because the arc cosine is inaccurate for small angles
    sine = jnp.linalg.norm(jnp.cross(found, true), axis=-1)
    return jnp.arctan2(sine, jnp.abs(jnp.sum(found * true, axis=-1)))


def geometry_errors(
    found: Identification, truth: ConstraintFrame, *, start: jax.Array | None = None
) -> GeometryErrors:
    """Compute the geometric errors of the identified frames with the true types.

    As in the paper's simulations, the types are assumed to be known; see :func:`types_correct` for errors of
    the types. For the twelve constraints of the paper, positions are compared along the determined components
    of the catalogue (Table 2); the angular and linear axes must agree at the start of the motion. For other
    constraints, positions are compared along all components. The geometry of the truth broadcasts against the
    identifications. ``start`` (..., 4, 4), m, is the first true pose of {b} in {g}. It is needed if {b} and
    {g} are not aligned at the start, because the axes and the position of GB and BG are in different bodies.
    """
    angular = found.candidates.angular.rotvec[..., int(truth.angular_type), :]
    linear = found.candidates.linear.rotvec[..., int(truth.linear_type), :]
    assert found.candidates.linear.position is not None
    position = found.candidates.linear.position[..., int(truth.linear_type), :]
    entry = lookup(truth.linear_type, truth.angular_dof, truth.linear_dof)
    kept = [i for i in range(3) if entry is None or entry.position[i]]
    if entry is not None:  # find the true axis with the degrees of freedom of each axis of the catalogue
        listed, true = _sorted_axes(entry), _sorted_axes(truth)
        kept = [true[listed.index(i)] for i in kept]
    miss = position - jnp.broadcast_to(truth.position.astype(position.dtype), position.shape)
    axes = truth.linear_axes.astype(position.dtype)
    if start is not None:
        turn = start[..., :3, :3].astype(position.dtype)
        if truth.linear_type == LinearType.GB:
            axes = matmul(jnp.swapaxes(turn, -1, -2), axes)
        elif truth.linear_type == LinearType.BG:
            axes = matmul(turn, axes)
    offset = apply(jnp.swapaxes(axes, -1, -2), miss)
    return GeometryErrors(
        angular=_axis_error(angular, truth.angular_axes, truth.angular_dof),
        linear=_axis_error(linear, truth.linear_axes, truth.linear_dof),
        position=jnp.linalg.norm(offset[..., kept], axis=-1) if kept else jnp.nan * position[..., 0],
    )


def _sorted_axes(of: Constraint | ConstraintFrame) -> list[int]:
    """Indices of the axes, sorted by their degrees of freedom."""
    return sorted(range(3), key=lambda i: (of.angular_dof[i], of.linear_dof[i]))


def types_correct(found: Identification, truth: ConstraintFrame, *, ties: bool = False) -> jax.Array:
    """Return whether the identified types express the true constraint, (...) bool.

    Both angular types express every constraint, except constraints with two free rotations. All linear types
    express the constraints for which the catalogue names no type. ``ties`` accepts an identified type that
    fits equally well as (is tied with) the true type.
    """
    entry = lookup(truth.linear_type, truth.angular_dof, truth.linear_dof)
    any_angular = sum(truth.angular_dof) != 2
    any_linear = entry is not None and entry.linear_type is None
    angular = found.angular.type_code == int(truth.angular_type)
    linear = found.linear.type_code == int(truth.linear_type)
    if ties:
        angular = angular | found.angular.tied[..., int(truth.angular_type)]
        linear = linear | found.linear.tied[..., int(truth.linear_type)]
    return (angular | any_angular) & (linear | any_linear)


def dof_correct(found: Identification, truth: ConstraintFrame) -> jax.Array:
    """Return whether both frames have the correct number of degrees of freedom, (...) bool."""
    angular = jnp.sum(found.angular.dof, axis=-1) == sum(truth.angular_dof)
    return angular & (jnp.sum(found.linear.dof, axis=-1) == sum(truth.linear_dof))

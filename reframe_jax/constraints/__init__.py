"""Constraints: frame types, the catalogue of named constraints, and constraint frames with a geometry."""

from reframe_jax.constraints.catalogue import (
    CONSTRAINTS,
    OTHER_CONSTRAINTS,
    Constraint,
    constraint,
    describe,
    lookup,
)
from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.types import AngularType, AxisRelation, Dof, LinearType

__all__ = [
    "CONSTRAINTS",
    "OTHER_CONSTRAINTS",
    "AngularType",
    "AxisRelation",
    "Constraint",
    "ConstraintFrame",
    "Dof",
    "LinearType",
    "constraint",
    "describe",
    "lookup",
]

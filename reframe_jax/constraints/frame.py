"""A constraint with its geometry (paper, Table 1)."""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.constraints.catalogue import constraint
from reframe_jax.constraints.types import AngularType, Dof, LinearType
from reframe_jax.geometry import rotations


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ConstraintFrame:
    """The angular and linear frames of a constraint: types, degrees of freedom and geometry (paper, Table 1).

    A JAX pytree: the geometry arrays are its leaves; the types and degrees of freedom are static.

    Attributes:
        angular_type, linear_type: the bodies in which the frames are fixed, B for {b} and G for {g}.
        angular_dof, linear_dof: one integer per axis of the frame; 1 is free, 0 is constrained.
        angular_rotvec: (..., 3) rad, orientation of the angular frame in the body that ``angular_type``
            names.
        linear_rotvec: (..., 3) rad, orientation of the linear frame in the body that the first letter of
            ``linear_type`` names.
        position: (..., 3) m, origin of the linear frame in the body that the second letter names.
    """

    angular_type: AngularType = field(metadata={"static": True})
    angular_dof: Dof = field(metadata={"static": True})
    linear_type: LinearType = field(metadata={"static": True})
    linear_dof: Dof = field(metadata={"static": True})
    angular_rotvec: jax.Array
    linear_rotvec: jax.Array
    position: jax.Array

    @staticmethod
    def named(
        label: str,
        *,
        linear_type: LinearType | None = None,
        rotvec: jax.Array | np.ndarray | tuple[float, ...] = (0.0, 0.0, 0.0),
        position: jax.Array | np.ndarray | tuple[float, ...] = (0.1, 0.3, 0.1),
    ) -> "ConstraintFrame":
        """Make a named constraint, by default with the geometry of the paper's simulations (section 5.3).

        Args:
            label: letter or name in :data:`CONSTRAINTS` or :data:`OTHER_CONSTRAINTS`.
            linear_type: linear frame type, BB by default. Only constraints that all four types express (A to
                D and :data:`OTHER_CONSTRAINTS`) allow a choice.
            rotvec: (..., 3) rad, orientation of both frames.
            position: (..., 3) m.

        Raises:
            KeyError: for an unknown label.
            ValueError: if the linear type cannot express the constraint.
        """
        entry = constraint(label)
        if entry.linear_type is not None and linear_type not in (None, entry.linear_type):
            raise ValueError(f"{entry.name} needs a {entry.linear_type} frame, not {linear_type}.")
        kind = entry.linear_type if linear_type is None else linear_type
        kind = LinearType.BB if kind is None else kind
        return ConstraintFrame(
            angular_type=kind.orientation_body,
            angular_dof=entry.angular_dof,
            linear_type=kind,
            linear_dof=entry.linear_dof,
            angular_rotvec=jnp.asarray(rotvec, dtype=float),
            linear_rotvec=jnp.asarray(rotvec, dtype=float),
            position=jnp.asarray(position, dtype=float),
        )

    @property
    def angular_axes(self) -> jax.Array:
        """(..., 3, 3): columns are the angular frame's axes."""
        return rotations.rotation_exp(self.angular_rotvec)

    @property
    def linear_axes(self) -> jax.Array:
        """(..., 3, 3): columns are the linear frame's axes."""
        return rotations.rotation_exp(self.linear_rotvec)

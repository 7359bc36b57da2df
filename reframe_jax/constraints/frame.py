"""A constraint with its geometry (paper, Table 1)."""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.constraints.catalogue import constraint
from reframe_jax.constraints.types import AngularType, Dof, LinearType
from reframe_jax.geometry import rotations

__all__ = ["ConstraintFrame"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ConstraintFrame:
    """A constraint's frames: types, degrees of freedom and geometry (paper, Table 1).

    A pytree whose leaves are the geometry; types and degrees of freedom are static.

    Attributes:
        angular_type, linear_type: the bodies that the frames are attached to.
        angular_dof, linear_dof: three integers each, along the axes of the frame; 1 is free, 0 constrained.
        angular_rotvec: (..., 3) rad, orientation of the angular frame in the body of its type.
        linear_rotvec: (..., 3) rad, orientation of the linear frame in the body of the first letter.
        position: (..., 3) m, origin of the linear frame in the body of the second letter.
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
        """A constraint with a name, by default with the geometry of the paper's simulations (section 5.3).

        Args:
            label: letter or name; see :data:`CONSTRAINTS`. Also "spherical", "universal", "fixed" or
                "unconstrained".
            linear_type: for the constraints that every type expresses (A-D, and those four), the one to
                use; BB by default.
            rotvec: (..., 3) rad, orientation of both frames.
            position: (..., 3) m.

        Raises:
            KeyError: for an unknown label.
            ValueError: for a linear type that cannot express the constraint.
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

"""A joint between two bodies, as robot descriptions have it."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.joints.chain import JointPart, chain_coordinates, chain_poses

__all__ = ["Joint", "JointType"]

JointType = Literal[
    "revolute",
    "continuous",
    "prismatic",
    "cylindrical",
    "screw",
    "planar",
    "spherical",
    "universal",
    "fixed",
    "floating",
    "general",
]


@dataclass(frozen=True, eq=False)
class Joint:
    """The joint that an identified constraint is: type, place, range, and how well it fits the recording.

    Make it with :meth:`Identification.to_joint`; write it with :func:`to_urdf`, :func:`to_mjcf` or
    :func:`to_sdf`. All vectors are in the parent, in the directions and places they have where all
    coordinates are zero.

    Attributes:
        type: of the joint. "continuous" is a revolute joint that was seen to turn by a full turn or more;
            a "screw" has one part, a hinge with a pitch; "floating" has no constraint; "general" is any other
            class.
        name: of the constraint, as in :attr:`Identification.name`.
        parent, child: names of the two bodies, {g} and {b} of the recording.
        axis: (3,) unit vector: of the rotation, or of the translation if nothing turns; the normal of a
            planar joint, the first axis of a universal joint. None where there is no such axis.
        point: (3,) m, on the axis or the centre of the rotation; the origin of the child where there is none.
        home: (4, 4) pose of the child in the parent where all coordinates are zero.
        parts: hinges, slides and balls from parent to child; their coordinates in this order are those of
            the joint. Empty for fixed and floating joints, and for a constraint that no chain of them makes.
        gauge: sentences that say what the motion leaves open, and what was chosen.
        position_error: m, root mean square distance of the recorded origins of the child from the joint's.
        rotation_error: rad, root mean square angle between the recorded orientations and the joint's.
        length: m that weighed as much as one radian when coordinates were found from poses.
        is_envelope: whether the parts reach the poses of the constraint but hold fewer velocities than it
            does: they keep a wheel that rolls on its plane, but not from moving sideways.
    """

    type: JointType
    name: str
    parent: str
    child: str
    axis: np.ndarray | None
    point: np.ndarray
    home: np.ndarray
    parts: tuple[JointPart, ...]
    gauge: tuple[str, ...]
    position_error: float
    rotation_error: float
    length: float = 0.3
    is_envelope: bool = False

    @property
    def is_chain(self) -> bool:
        """Whether the joint has coordinates that determine the pose: a chain of parts, or fixed."""
        return bool(self.parts) or self.type == "fixed"

    @property
    def range(self) -> tuple[float, float] | None:
        """Lowest and highest recorded coordinate of a joint with a single one, rad or m; else None."""
        if len(self.parts) != 1 or self.parts[0].kind == "ball":
            return None
        return self.parts[0].low, self.parts[0].high

    def poses(self, coordinates: ArrayLike) -> np.ndarray:
        """Poses (..., 4, 4) of the child in the parent, m, for coordinates (..., n).

        Args:
            coordinates: rad for hinges, m for slides, a rotation vector in rad for a ball, in the order of
                ``parts``.

        Raises:
            ValueError: if the joint is not a chain, or for another number of coordinates.
        """
        self._check_chain()
        values = np.asarray(coordinates, dtype=float)
        number = sum(part.width for part in self.parts)
        if values.ndim == 0 or values.shape[-1] != number:
            raise ValueError(f"Expected coordinates of shape (..., {number}), not {values.shape}.")
        return chain_poses(self.parts, self.home, values)

    def coordinates(self, poses: ArrayLike) -> np.ndarray:
        """Coordinates (K, n) at which the joint is nearest to poses; hinges do not jump between them.

        Args:
            poses: (K, 4, 4) of the child in the parent, m.

        Raises:
            ValueError: if the joint is not a chain, or for another shape.
        """
        self._check_chain()
        values = np.asarray(poses, dtype=float)
        if values.ndim != 3 or values.shape[1:] != (4, 4):
            raise ValueError(f"Expected poses of shape (K, 4, 4), not {values.shape}.")
        return chain_coordinates(self.parts, self.home, values, self.length)

    def without_balls(self) -> "Joint":
        """The same joint with three hinges in place of every ball, for formats that have none.

        Raises:
            ValueError: if the recorded rotations come near to where three hinges lock.
        """
        if all(part.kind != "ball" for part in self.parts):
            return self
        if any(part.kind == "ball" and not part.hinges for part in self.parts):
            raise ValueError(
                f"{self.name}: three hinges cannot stand for its ball; on the recorded rotations they lock."
            )
        parts = tuple(hinge for part in self.parts for hinge in (part.hinges or (part,)))
        said = "Three hinges through its centre stand for the ball. They lock farther out than recorded."
        return replace(self, parts=parts, gauge=(*self.gauge, said))

    def _check_chain(self) -> None:
        if not self.is_chain:
            raise ValueError(f"{self.name}: no coordinates determine the pose of a {self.type} joint.")

    def __str__(self) -> str:
        """The joint in a few lines."""
        lines = [f"{self.name}: {self.type} joint from {self.parent} to {self.child}"]
        if self.axis is not None:
            lines.append(f"  axis   {_vector(self.axis, 4)}")
        lines.append(f"  point  {_vector(self.point, 4)} m")
        for part in self.parts:
            what, scale, unit = (
                (part.kind, 1e3, "mm") if part.kind == "slide" else (part.kind, 57.29578, "deg")
            )
            low, high = np.round([scale * part.low, scale * part.high], 1) + 0.0  # no negative zeros
            lines.append(f"  {what:5}  {low:.1f} to {high:.1f} {unit}")
            if part.pitch:
                lines.append(f"  pitch  {2e3 * np.pi * part.pitch:.4g} mm a turn")
        if self.is_chain:
            error = f"{1e3 * self.position_error:.2g} mm, {np.degrees(self.rotation_error):.2g} deg"
            lines.append(f"  error  {error}, rms")
        return "\n".join([*lines, *(f"  {sentence}" for sentence in self.gauge)])


def _vector(vector: np.ndarray, digits: int) -> str:
    return "(" + ", ".join(f"{np.round(x, digits) + 0.0:.{digits}f}" for x in vector) + ")"

"""A joint between two bodies, in the form of a robot description."""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.joints.chain import JointPart, chain_coordinates, chain_poses

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
    """A joint made from an identified constraint: type, place, recorded range and fit error.

    Make a joint with :meth:`Identification.to_joint`; write it with :func:`to_urdf`, :func:`to_mjcf` or
    :func:`to_sdf`. All vectors are in the parent, at zero coordinates.

    Attributes:
        type: type of the joint. "continuous" is a revolute joint whose recording covers a full turn or more;
            a "screw" has one part, a hinge with a pitch; "floating" has no constraint; "general" is any other
            constraint.
        name: name of the constraint, as in :attr:`Identification.name`.
        parent, child: names of the two bodies, {g} and {b} of the recording.
        axis: (3,) unit vector: the rotation axis, or the translation direction of a joint without rotation;
            for a planar joint the normal, for a universal joint its first axis. None for joints without a
            single axis.
        point: (3,) m, a point on the rotation axis, or the centre of rotation; for joints without either, the
            origin of the child.
        home: (4, 4) pose of the child in the parent at zero coordinates.
        parts: hinges, slides and balls from parent to child. The coordinates of the joint are the coordinates
            of its parts, in this order. Empty for fixed and floating joints, and for a constraint that no
            chain reproduces.
        gauge: sentences that name each choice that the motion does not determine, and the value chosen.
        position_error, rotation_error: m and rad, RMS distance and angle between the recorded pose of the
            child and the pose that the joint gives.
        length: m, position error that has the same weight as an orientation error of 1 rad when coordinates
            are computed from poses.
        is_envelope: whether the parts reach the poses of the constraint but constrain fewer velocities. For
            example, the parts keep a rolling wheel on its plane but let it move sideways.
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
        """Whether coordinates determine the pose: true for a chain of parts and for a fixed joint."""
        return bool(self.parts) or self.type == "fixed"

    @property
    def range(self) -> tuple[float, float] | None:
        """Lowest and highest recorded coordinate, rad or m; None for joints with several coordinates."""
        if len(self.parts) != 1 or self.parts[0].kind == "ball":
            return None
        return self.parts[0].low, self.parts[0].high

    def poses(self, coordinates: "ArrayLike") -> np.ndarray:
        """Compute poses (..., 4, 4) of the child in the parent, m, from coordinates (..., n).

        Coordinates are rad for hinges, m for slides, and a rotation vector in rad for a ball, in the order of
        ``parts``. A ValueError is raised for a joint that is not a chain, or another number of coordinates.
        """
        self._check_chain()
        values = np.asarray(coordinates, dtype=float)
        number = sum(part.width for part in self.parts)
        if values.ndim == 0 or values.shape[-1] != number:
            raise ValueError(f"Expected coordinates of shape (..., {number}), not {values.shape}.")
        return chain_poses(self.parts, self.home, values)

    def coordinates(self, poses: "ArrayLike") -> np.ndarray:
        """Compute the coordinates (K, n) at which the joint is nearest to poses (K, 4, 4), m.

        Hinge angles are unwrapped. A ValueError is raised for a joint that is not a chain, or other shapes.
        """
        self._check_chain()
        values = np.asarray(poses, dtype=float)
        if values.ndim != 3 or values.shape[1:] != (4, 4):
            raise ValueError(f"Expected poses of shape (K, 4, 4), not {values.shape}.")
        return chain_coordinates(self.parts, self.home, values, self.length)

    def without_balls(self) -> "Joint":
        """Return the joint with three hinges in place of every ball, for formats without ball joints.

        A ValueError is raised if the recorded rotations come near the gimbal lock of the three hinges.
        """
        if all(part.kind != "ball" for part in self.parts):
            return self
        if any(part.kind == "ball" and not part.hinges for part in self.parts):
            raise ValueError(
                f"{self.name}: three hinges cannot replace the ball; the recorded rotations reach their "
                "gimbal lock."
            )
        parts = tuple(hinge for part in self.parts for hinge in (part.hinges or (part,)))
        why = "Three hinges through the centre replace the ball. The range excludes their gimbal lock."
        return replace(self, parts=parts, gauge=(*self.gauge, why))

    def _check_chain(self) -> None:
        if not self.is_chain:
            raise ValueError(f"{self.name}: no coordinates determine the pose of a {self.type} joint.")

    def __str__(self) -> str:
        """Summary of the joint in a few lines."""
        lines = [f"{self.name}: {self.type} joint from {self.parent} to {self.child}"]
        if self.axis is not None:
            lines.append(f"  axis   {format_vector(self.axis, 4)}")
        lines.append(f"  point  {format_vector(self.point, 4)} m")
        for part in self.parts:
            scale, unit = (1e3, "mm") if part.kind == "slide" else (np.degrees(1.0), "deg")
            low, high = np.round([scale * part.low, scale * part.high], 1) + 0.0  # no negative zeros
            lines.append(f"  {part.kind:5}  {low:.1f} to {high:.1f} {unit}")
            if part.pitch:
                lines.append(f"  pitch  {2e3 * np.pi * part.pitch:.4g} mm per turn")
        if self.is_chain:
            error = f"{1e3 * self.position_error:.2g} mm, {np.degrees(self.rotation_error):.2g} deg"
            lines.append(f"  error  {error}, rms")
        return "\n".join([*lines, *(f"  {sentence}" for sentence in self.gauge)])


def format_vector(vector: Any, digits: int, width: int = 0) -> str:
    """Format a vector with a number of decimals, and a least width of each number."""
    # adding zero after rounding removes the sign of a negative zero
    return "(" + ", ".join(f"{np.round(x, digits) + 0.0:{width}.{digits}f}" for x in vector) + ")"


def two_digits(value: float) -> str:
    """Format a number with two significant digits, without an exponent: 320, not 3.2e+02."""
    return f"{float(f'{value:.2g}'):g}"

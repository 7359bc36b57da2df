"""Frame types: the bodies in which a constraint frame is fixed (paper, section 3)."""

from enum import Enum, IntEnum
from math import cos, radians, sin

import numpy as np

Dof = tuple[int, int, int]
"""Degrees of freedom of three axes: 1 is free, 0 is constrained."""

_ALIGNED = 15.0  # degrees within which two axes count as parallel or perpendicular

PARALLEL_COSINE = cos(radians(_ALIGNED))
"""Two axes count as parallel if the cosine of the angle between them exceeds this value."""

SQUARE_COSINE = sin(radians(_ALIGNED))
"""Two axes count as perpendicular if the cosine of the angle between them is below this value."""


class AngularType(IntEnum):
    """Body in which an angular frame is fixed: G ground, B body. Values index the ``norms`` of a result."""

    G = 0
    B = 1

    def __str__(self) -> str:
        return self.name


BODY_NAMES: dict[IntEnum, str] = {AngularType.G: "ground", AngularType.B: "body"}
"""Names of the two bodies for messages."""


class LinearType(IntEnum):
    """Bodies in which a linear frame's orientation (first letter) and origin (second letter) are fixed.

    G is the ground, B the body. The order is that of the paper's Table 4; values index the ``norms`` of a
    result.
    """

    BB = 0
    GB = 1
    GG = 2
    BG = 3

    def __str__(self) -> str:
        return self.name

    @property
    def orientation_body(self) -> AngularType:
        """Body in which the orientation ``rotvec`` is expressed."""
        return AngularType[self.name[0]]

    @property
    def position_body(self) -> AngularType:
        """Body in which the origin ``position`` is expressed."""
        return AngularType[self.name[1]]


ORIENTATION_BODIES = np.array([kind.orientation_body for kind in LinearType], np.int32)
"""(4,): body in which the axes are fixed, for each linear type."""

POSITION_BODIES = np.array([kind.position_body for kind in LinearType], np.int32)
"""(4,): body in which the origin is fixed, for each linear type."""


class AxisRelation(Enum):
    """Relation of the single free rotation axis to the distinct axis of the linear frame.

    The distinct axis of a frame with one or two free axes is its single free axis or its single constrained
    axis. Axes within 15 degrees of parallel or of perpendicular count as such; other axes are oblique.
    """

    PARALLEL = "parallel"
    PERPENDICULAR = "perpendicular"
    OBLIQUE = "oblique"


def relation_of_cosine(cosine: float) -> AxisRelation:
    """Classify the relation of two axes from the cosine of the angle between them; its sign has no effect."""
    if abs(cosine) > PARALLEL_COSINE:
        return AxisRelation.PARALLEL
    return AxisRelation.PERPENDICULAR if abs(cosine) < SQUARE_COSINE else AxisRelation.OBLIQUE


def distinct_axis(dof: tuple[int, ...]) -> int | None:
    """Return the index of the single free or single constrained axis; None if all three axes are alike."""
    return dof.index(sum(dof) % 2) if sum(dof) in (1, 2) else None

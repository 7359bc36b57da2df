"""Frame types: the bodies that a constraint frame is attached to (paper, section 3)."""

from enum import Enum, IntEnum
from math import cos, radians, sin

import numpy as np

__all__ = [
    "BODY_NAMES",
    "ORIENTATION_BODIES",
    "PARALLEL_COSINE",
    "POSITION_BODIES",
    "SQUARE_COSINE",
    "AngularType",
    "AxisRelation",
    "Dof",
    "LinearType",
    "relation_of_cosine",
]

_ALIGNED = 15.0  # degrees within which two axes count as parallel or perpendicular

PARALLEL_COSINE = cos(radians(_ALIGNED))
"""Cosine of the angle between two axes above which they count as parallel, in names and elsewhere."""

SQUARE_COSINE = sin(radians(_ALIGNED))
"""That below which they count as perpendicular."""


class AngularType(IntEnum):
    """Body in which an angular frame's orientation is fixed. Values index the ``norms`` of a result."""

    G = 0
    B = 1

    def __str__(self) -> str:
        return self.name


BODY_NAMES: dict[IntEnum, str] = {AngularType.G: "ground", AngularType.B: "body"}
"""What the bodies are called in sentences."""


class LinearType(IntEnum):
    """Bodies in which a linear frame's orientation (first letter) and position (second) are fixed.

    The order is that of the paper's Table 4; values index the ``norms`` of a result.
    """

    BB = 0
    GB = 1
    GG = 2
    BG = 3

    def __str__(self) -> str:
        return self.name

    @property
    def orientation_body(self) -> AngularType:
        """Body whose axes ``rotvec`` refers to."""
        return AngularType[self.name[0]]

    @property
    def position_body(self) -> AngularType:
        """Body in whose frame ``position`` is given."""
        return AngularType[self.name[1]]


ORIENTATION_BODIES = np.array([kind.orientation_body for kind in LinearType], np.int32)
"""Bodies of the axes of all linear types, (4,)."""

POSITION_BODIES = np.array([kind.position_body for kind in LinearType], np.int32)
"""Bodies of their origins, (4,)."""


class AxisRelation(Enum):
    """Angle between the single free rotation axis and the odd axis of the linear frame."""

    PARALLEL = "parallel"
    PERPENDICULAR = "perpendicular"
    OBLIQUE = "oblique"


def relation_of_cosine(cosine: float) -> AxisRelation:
    """How two axes lie, from the cosine of the angle between them, of either sign."""
    if abs(cosine) > PARALLEL_COSINE:
        return AxisRelation.PARALLEL
    return AxisRelation.PERPENDICULAR if abs(cosine) < SQUARE_COSINE else AxisRelation.OBLIQUE


Dof = tuple[int, int, int]

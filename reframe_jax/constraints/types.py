"""Frame types: the bodies that a constraint frame is attached to (paper, section 3)."""

from enum import Enum, IntEnum

__all__ = ["BODY_NAMES", "AngularType", "AxisRelation", "Dof", "LinearType"]


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


class AxisRelation(Enum):
    """Angle between the single free rotation axis and the odd axis of the linear frame."""

    PARALLEL = "parallel"
    PERPENDICULAR = "perpendicular"
    OBLIQUE = "oblique"


Dof = tuple[int, int, int]

"""Which chain of hinges, slides and balls a constraint frame is, before it is fitted to poses."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.located import parts_on_body
from reframe_jax.constraints.types import AxisRelation, LinearType, relation_of_cosine
from reframe_jax.joints.chain import PartKind
from reframe_jax.joints.joint import JointType
from reframe_jax.joints.universal import universal_axes

__all__ = ["Geometry", "Plan", "frame_geometry", "joint_plans", "only_velocities", "relate_axes"]


@dataclass(frozen=True)
class Geometry:
    """A constraint frame in NumPy, and poses.

    ``pitch`` is that of a screw in m/rad; ``universal`` are the axes of a universal joint, in {g} and in {b}.

    ``turning`` and ``sliding`` are the free axes, rows in the body of their type; ``odd`` is the axis of the
    linear frame that differs from the other two, or None.
    """

    frame: ConstraintFrame
    poses: np.ndarray
    turning: np.ndarray
    sliding: np.ndarray
    odd: np.ndarray | None
    position: np.ndarray
    angular_on_body: bool
    linear_on_body: bool
    point_on_body: bool
    pitch: float | None = None
    universal: np.ndarray | None = None

    def in_ground(self, direction: np.ndarray, on_body: bool) -> np.ndarray:
        """A direction that is fixed in both bodies, in the ground: the mean over all poses."""
        if not on_body:
            return direction
        mean: np.ndarray = np.mean(self.poses[:, :3, :3] @ direction, axis=0)
        return mean / np.linalg.norm(mean)

    def hinge(self) -> np.ndarray:
        """The only free axis of rotation, which is fixed in both bodies, in the ground."""
        return self.in_ground(self.turning[0], self.angular_on_body)

    def centre(self) -> np.ndarray:
        """The origin of the linear frame in the ground, m: the mean over all poses if it is fixed in {b}."""
        if not self.point_on_body:
            return self.position
        return np.mean(self.poses[:, :3, :3] @ self.position + self.poses[:, :3, 3], axis=0)

    def slides(self, home: np.ndarray) -> np.ndarray:
        """The free axes of translation (n, 3) in the ground, with the child at its home pose."""
        return self.sliding @ home[:3, :3].T if self.linear_on_body else self.sliding


@dataclass(frozen=True)
class Plan:
    """What kind of chain a constraint is.

    ``is_chain`` is False where any pose can be reached, or two hinges do not make the rotations. ``axis`` is
    the direction of a hinge, and ``second`` the second axis of two hinges in the child. ``slides`` are the
    free axes of the frame, the axis of the hinge, the plane across it, or all of space. Where the chain
    reaches what the constraint reaches, but holds fewer velocities, ``is_envelope`` is True.
    """

    type: JointType
    is_chain: bool = True
    turns: PartKind | None = None
    turns_first: bool = False
    axis: np.ndarray | None = None
    second: np.ndarray | None = None
    slides: Literal["free", "along", "plane", "space"] = "free"
    is_envelope: bool = False


def frame_geometry(
    frame: ConstraintFrame, poses: np.ndarray, pitch: float | None = None, universal: np.ndarray | None = None
) -> Geometry:
    """The geometry of a single frame and of poses (K+1, 4, 4); the rest as in :class:`Geometry`."""
    angular, linear = np.asarray(frame.angular_axes, float).T, np.asarray(frame.linear_axes, float).T
    free = np.asarray(frame.linear_dof, bool)
    count = int(free.sum())
    odd = linear[free if count == 1 else ~free][0] if count in (1, 2) else None
    on_body = np.asarray(parts_on_body(frame.angular_type, frame.linear_type))
    turning = angular[np.asarray(frame.angular_dof, bool)]
    position = np.asarray(frame.position, float)
    angular_on_body, linear_on_body, point_on_body = map(bool, on_body)
    moving = turning, linear[free], odd, position
    return Geometry(frame, poses, *moving, angular_on_body, linear_on_body, point_on_body, pitch, universal)


def relate_axes(geometry: Geometry) -> AxisRelation | None:
    """Angle between the odd axes of the two frames; None where a frame has no odd axis."""
    turns = len(geometry.turning)
    if turns not in (1, 2) or geometry.odd is None:
        return None
    angular = geometry.turning[0] if turns == 1 else np.cross(*geometry.turning)
    turned = geometry.in_ground(angular, geometry.angular_on_body)
    return relation_of_cosine(float(turned @ geometry.in_ground(geometry.odd, geometry.linear_on_body)))


def joint_plans(geometry: Geometry) -> list[Plan]:
    """The chains to try; of several, the one that fits best is the joint."""
    turns, slides = len(geometry.turning), len(geometry.sliding)
    if turns == 0:
        kinds: tuple[JointType, ...] = ("fixed", "prismatic", "general", "general")
        return [Plan(kinds[slides])]
    if turns == 1:
        return _hinge_plans(geometry)
    if geometry.universal is not None:
        first, second = geometry.universal
        return [Plan("universal", turns="hinge", axis=first, second=second)]
    kind: JointType = "general"
    if slides == 0:
        kind = "universal" if turns == 2 else "spherical"
    if slides == 3 and turns == 3:
        return [Plan("floating", is_chain=False)]
    if only_velocities(geometry):  # together the free axes reach every pose
        return [Plan("general", is_chain=False)]
    last = _slides_last(geometry)
    if turns == 3:
        return [Plan(kind, turns="ball", turns_first=last)]
    normal = geometry.in_ground(np.cross(*geometry.turning), geometry.angular_on_body)
    first, second = universal_axes(geometry.poses[:, :3, :3], normal)
    return [Plan(kind, turns="hinge", turns_first=last, axis=first, second=second)]


def _hinge_plans(geometry: Geometry) -> list[Plan]:
    """The chains of a constraint with one free rotation."""
    axis, slides = geometry.hinge(), len(geometry.sliding)
    relation = relate_axes(geometry)
    if relation == AxisRelation.PARALLEL and geometry.odd is not None:
        # the axis was found twice, from the rotations and from the translations
        other = geometry.in_ground(geometry.odd, geometry.linear_on_body)
        both = axis, other
        if slides == 1 and geometry.pitch is not None:
            return [Plan("screw", turns="hinge", axis=axis, slides="along")]
        if slides == 1:
            return [Plan("cylindrical", turns="hinge", axis=each, slides="along") for each in both]
        return [Plan("planar", turns="hinge", axis=each, slides="plane") for each in both]
    if only_velocities(geometry):
        # turned with the hinge, one direction across it becomes the plane, and any other all of space
        reached: Literal["plane", "space"] = "space"
        if slides == 1 and relation == AxisRelation.PERPENDICULAR:
            reached = "plane"
        return [Plan("general", turns="hinge", axis=axis, slides=reached, is_envelope=True)]
    kind: JointType = "revolute" if slides == 0 else "general"
    return [Plan(kind, turns="hinge", turns_first=_slides_last(geometry), axis=axis)]


def only_velocities(geometry: Geometry) -> bool:
    """Whether the constraint restricts velocities, as a wheel does, and reaches poses beyond its free axes.

    In BB and GG the origin is fixed in the body of the axes, so the slides turn along. Turning and sliding by
    turns then reaches what neither of them reaches.
    """
    some = len(geometry.sliding) in (1, 2)
    return some and geometry.frame.linear_type in (LinearType.BB, LinearType.GG)


def _slides_last(geometry: Geometry) -> bool:
    """Whether the slides follow the rotations in a chain: they move past a point that is fixed in {g}."""
    return len(geometry.sliding) in (1, 2) and geometry.frame.linear_type == LinearType.BG

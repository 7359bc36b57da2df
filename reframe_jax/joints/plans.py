"""Choose the chains of hinges, slides and balls that may reproduce a constraint, before fitting to poses."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.located import fixed_on_body
from reframe_jax.constraints.types import AxisRelation, LinearType, relation_of_cosine
from reframe_jax.joints.chain import PartKind
from reframe_jax.joints.joint import JointType
from reframe_jax.joints.universal import universal_axes


@dataclass(frozen=True)
class Geometry:
    """A constraint frame as NumPy arrays, with the recorded poses.

    Attributes:
        frame: the constraint frame.
        poses: (K+1, 4, 4) of {b} in {g}, m.
        turning: (n, 3), free rotation axes as rows, in the body that they are fixed in.
        sliding: (n, 3), free translation axes as rows, in the body that they are fixed in.
        distinct: (3,), the single free or single constrained axis of the linear frame; None if all are alike.
        position: (3,) m, origin of the linear frame, in the body that it is fixed in.
        angular_on_body, linear_on_body, point_on_body: whether the angular axes, the linear axes and the
            origin are fixed in {b}; otherwise they are fixed in {g}.
        pitch: m/rad of a screw joint, else None.
        universal: (2, 3), axes of a universal joint, the first in {g} and the second in {b}; else None.
    """

    frame: ConstraintFrame
    poses: np.ndarray
    turning: np.ndarray
    sliding: np.ndarray
    distinct: np.ndarray | None
    position: np.ndarray
    angular_on_body: bool
    linear_on_body: bool
    point_on_body: bool
    pitch: float | None = None
    universal: np.ndarray | None = None

    def in_ground(self, direction: np.ndarray, on_body: bool) -> np.ndarray:
        """Express a direction in the ground, as the mean over all poses if it is fixed in {b}."""
        if not on_body:
            return direction
        mean: np.ndarray = np.mean(self.poses[:, :3, :3] @ direction, axis=0)
        return mean / np.linalg.norm(mean)

    def hinge(self) -> np.ndarray:
        """The single free rotation axis, which is fixed in both bodies, expressed in the ground."""
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
    """A chain that may reproduce a constraint.

    Attributes:
        type: type of the joint.
        is_chain: False if every pose can be reached, or if two hinges do not fit the rotations.
        turns: kind of the rotating part, or None.
        turns_first: whether the rotating parts precede the slides in the chain.
        axis: (3,) in the ground, direction of the hinge, or of the first of two hinges.
        second: (3,) in the child, direction of the second hinge.
        slides: directions of the slides: the free axes of the frame, along the hinge, in the plane normal to
            the hinge, or all of space.
        is_envelope: as in :class:`Joint`.
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
    """Make the :class:`Geometry` of a single frame and poses (K+1, 4, 4)."""
    angular, linear = np.asarray(frame.angular_axes, float).T, np.asarray(frame.linear_axes, float).T
    free = np.asarray(frame.linear_dof, bool)
    count = int(free.sum())
    distinct = linear[free if count == 1 else ~free][0] if count in (1, 2) else None
    turning = angular[np.asarray(frame.angular_dof, bool)]
    position = np.asarray(frame.position, float)
    moving = turning, linear[free], distinct, position
    return Geometry(frame, poses, *moving, *fixed_on_body(frame), pitch, universal)


def relate_axes(geometry: Geometry) -> AxisRelation | None:
    """Relation of the distinct axes of the two frames; None if either frame has no distinct axis."""
    turns = len(geometry.turning)
    if turns not in (1, 2) or geometry.distinct is None:
        return None
    angular = geometry.turning[0] if turns == 1 else np.cross(*geometry.turning)
    turned = geometry.in_ground(angular, geometry.angular_on_body)
    return relation_of_cosine(float(turned @ geometry.in_ground(geometry.distinct, geometry.linear_on_body)))


def joint_plans(geometry: Geometry) -> list[Plan]:
    """Chains to fit to the poses; the chain with the best fit becomes the joint."""
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
    if only_velocities(geometry):  # combinations of the free motions reach every pose
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
    if relation == AxisRelation.PARALLEL and geometry.distinct is not None:
        # the identification has two estimates of the axis: from the rotations and from the translations
        other = geometry.in_ground(geometry.distinct, geometry.linear_on_body)
        both = axis, other
        if slides == 1 and geometry.pitch is not None:
            return [Plan("screw", turns="hinge", axis=axis, slides="along")]
        if slides == 1:
            return [Plan("cylindrical", turns="hinge", axis=each, slides="along") for each in both]
        return [Plan("planar", turns="hinge", axis=each, slides="plane") for each in both]
    if only_velocities(geometry):
        # a free translation that turns with the hinge covers a plane if it is normal to it, else all of space
        reached: Literal["plane", "space"] = "space"
        if slides == 1 and relation == AxisRelation.PERPENDICULAR:
            reached = "plane"
        return [Plan("general", turns="hinge", axis=axis, slides=reached, is_envelope=True)]
    kind: JointType = "revolute" if slides == 0 else "general"
    return [Plan(kind, turns="hinge", turns_first=_slides_last(geometry), axis=axis)]


def only_velocities(geometry: Geometry) -> bool:
    """Whether the constraint restricts velocities, as a wheel does, and reaches poses beyond its free axes.

    In BB and GG, the axes and the origin are fixed in the same body, so the free translations turn with the
    body. Alternating rotations and translations then reach poses that neither reaches by itself.
    """
    some = len(geometry.sliding) in (1, 2)
    return some and geometry.frame.linear_type in (LinearType.BB, LinearType.GG)


def _slides_last(geometry: Geometry) -> bool:
    """Whether the slides come after the rotations in the chain: axes fixed in {b}, origin fixed in {g}."""
    return len(geometry.sliding) in (1, 2) and geometry.frame.linear_type == LinearType.BG

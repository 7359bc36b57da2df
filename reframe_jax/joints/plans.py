"""Choose the chains of hinges, slides and balls that may reproduce a constraint, before fitting to poses."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.located import fixed_on_body
from reframe_jax.constraints.types import AxisRelation, LinearType, distinct_axis, relation_of_cosine
from reframe_jax.joints.joint import JointType

_STARTS, _STEPS = 8, 40  # starts, and steps from each start, of the search for universal axes


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
        """Express a unit vector (3,) in {g}: the mean over all poses if it is fixed in {b} (``on_body``)."""
        if not on_body:
            return direction
        mean: np.ndarray = np.mean(self.poses[:, :3, :3] @ direction, axis=0)
        return mean / np.linalg.norm(mean)

    def centre(self) -> np.ndarray:
        """Return the origin (3,), m, of the linear frame in {g}: the mean over all poses if fixed in {b}."""
        if not self.point_on_body:
            return self.position
        return np.mean(self.poses[:, :3, :3] @ self.position + self.poses[:, :3, 3], axis=0)

    def slides(self, home: np.ndarray) -> np.ndarray:
        """Return the free translation axes (n, 3) in {g} while the pose of {b} in {g} is ``home`` (4, 4)."""
        return self.sliding @ home[:3, :3].T if self.linear_on_body else self.sliding


@dataclass(frozen=True)
class Plan:
    """A chain that may reproduce a constraint.

    Attributes:
        type: type of the joint.
        turns_first: whether the rotating parts precede the slides in the chain.
        axis: (3,) in the ground, positive direction of the hinge, or of the first of two; None for a ball.
        second: (3,) in the child, direction of the second hinge.
        slides: directions of the slides: the free axes of the frame, along the hinge, in the plane normal to
            the hinge, or all of space.
        is_envelope: as in :class:`Joint`.
    """

    type: JointType
    turns_first: bool = False
    axis: np.ndarray | None = None
    second: np.ndarray | None = None
    slides: Literal["free", "along", "plane", "space"] = "free"
    is_envelope: bool = False


def positive(axis: np.ndarray) -> np.ndarray:
    """Return an axis (3,) with the sign that makes its largest component positive."""
    signed: np.ndarray = axis * np.sign(axis[np.argmax(np.abs(axis))])
    return signed


def frame_geometry(
    frame: ConstraintFrame, poses: np.ndarray, pitch: float | None = None, universal: np.ndarray | None = None
) -> Geometry:
    """Make the :class:`Geometry` of a single frame and poses (K+1, 4, 4), m."""
    angular, linear = np.asarray(frame.angular_axes, float).T, np.asarray(frame.linear_axes, float).T
    turning, sliding = angular[np.asarray(frame.angular_dof) == 1], linear[np.asarray(frame.linear_dof) == 1]
    place = distinct_axis(frame.linear_dof)
    distinct, position = None if place is None else linear[place], np.asarray(frame.position, float)
    moving = turning, sliding, distinct, position
    return Geometry(frame, poses, *moving, *fixed_on_body(frame), pitch, universal)


def relate_axes(geometry: Geometry) -> AxisRelation | None:
    """Return the relation of the distinct axes of both frames; None if a frame has no distinct axis."""
    turns = len(geometry.turning)
    if turns not in (1, 2) or geometry.distinct is None:
        return None
    angular = geometry.turning[0] if turns == 1 else np.cross(*geometry.turning)
    turned = geometry.in_ground(angular, geometry.angular_on_body)
    return relation_of_cosine(float(turned @ geometry.in_ground(geometry.distinct, geometry.linear_on_body)))


def joint_plans(geometry: Geometry) -> list[Plan]:
    """Return the chains to fit to the poses; the best fit becomes the joint. Empty if no chain fits."""
    turns, slides = len(geometry.turning), len(geometry.sliding)
    # slides come after the rotations if their axes are fixed in {b} and the origin is fixed in {g}
    last = slides in (1, 2) and geometry.frame.linear_type == LinearType.BG
    if turns == 0:
        kinds: tuple[JointType, ...] = ("fixed", "prismatic", "general", "general")
        return [Plan(kinds[slides])]
    if turns == 1:
        return _hinge_plans(geometry, last)
    if geometry.universal is not None:
        return [Plan("universal", axis=positive(geometry.universal[0]), second=geometry.universal[1])]
    if (slides == 3 and turns == 3) or only_velocities(geometry):
        return []  # combinations of the free motions reach every pose
    if turns == 3:
        return [Plan("general" if slides else "spherical", turns_first=last)]
    normal = geometry.in_ground(np.cross(*geometry.turning), geometry.angular_on_body)
    first, second = universal_axes(geometry.poses[:, :3, :3], normal)
    return [Plan("general" if slides else "universal", turns_first=last, axis=positive(first), second=second)]


def _hinge_plans(geometry: Geometry, last: bool) -> list[Plan]:
    """The chains of a constraint with one free rotation, whose axis is fixed in both bodies."""
    axis = positive(geometry.in_ground(geometry.turning[0], geometry.angular_on_body))
    relation, slides = relate_axes(geometry), len(geometry.sliding)
    if relation == AxisRelation.PARALLEL and geometry.distinct is not None:
        if slides == 1 and geometry.pitch is not None:
            return [Plan("screw", axis=axis, slides="along")]
        # the identification has two estimates of the axis: from the rotations and from the translations
        both = axis, positive(geometry.in_ground(geometry.distinct, geometry.linear_on_body))
        if slides == 1:
            return [Plan("cylindrical", axis=each, slides="along") for each in both]
        return [Plan("planar", axis=each, slides="plane") for each in both]
    if only_velocities(geometry):
        # a free translation that turns with the hinge covers a plane if it is normal to it, else all of space
        plane = slides == 1 and relation == AxisRelation.PERPENDICULAR
        return [Plan("general", axis=axis, slides="plane" if plane else "space", is_envelope=True)]
    return [Plan("general" if slides else "revolute", turns_first=last, axis=axis)]


def only_velocities(geometry: Geometry) -> bool:
    """Return whether the constraint, like a wheel, restricts velocities only.

    In BB and GG, the axes and the origin are fixed in the same body, so the free translations turn with the
    body. Alternating rotations and translations then reach poses that neither reaches by itself.
    """
    some = len(geometry.sliding) in (1, 2)
    return some and geometry.frame.linear_type in (LinearType.BB, LinearType.GG)


def universal_axes(rotations: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pair of axes (3,), one in each body, whose mutual angle varies least over the motion.

    A constraint frame has its constrained rotation axis fixed in one body. In a universal joint, the
    direction of the constrained rotation is perpendicular to both joint axes and fixed in neither body. This
    function therefore estimates the joint axes: for an axis a of the ground and an axis b of the body, a^T
    R(k) b is constant over the rotations (K, 3, 3). ``normal`` (3,) is the direction of the constrained
    rotation in the ground at the mean pose.
    """
    moved = rotations - rotations.mean(axis=0)
    across = np.linalg.svd(normal[None])[2][1:]
    best = np.inf, np.zeros(3), np.zeros(3)
    for angle in np.arange(_STARTS) * np.pi / _STARTS:
        first = np.cos(angle) * across[0] + np.sin(angle) * across[1]
        for _ in range(_STEPS):
            _, second = _least_projection_axis(np.einsum("i,kij->kj", first, moved))
            change, first = _least_projection_axis(moved @ second)
        if change < best[0]:
            best = change, first, second
    return best[1], best[2]


def _least_projection_axis(rows: np.ndarray) -> tuple[float, np.ndarray]:
    """The unit vector (3,) on which rows (K, 3) have the smallest projections, and their sum of squares."""
    values, vectors = np.linalg.eigh(rows.T @ rows)
    return float(values[0]), vectors[:, 0]

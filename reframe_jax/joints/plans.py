"""Choose the chains of hinges, slides and balls that may reproduce a constraint, before fitting to poses."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.located import fixed_on_body
from reframe_jax.constraints.types import AxisRelation, LinearType, distinct_axis, relation_of_cosine
from reframe_jax.joints.joint import JointType

_STARTS, _STEPS = 8, 40  # starts, and steps from each start, of the search for universal axes


@dataclass(frozen=True)
class Geometry:
    """A constraint frame with the recorded poses."""

    frame: ConstraintFrame
    poses: np.ndarray  # (K+1, 4, 4) of {b} in {g}, m
    pitch: float | None  # m/rad of a screw joint
    universal: np.ndarray | None  # (2, 3), axes of a universal joint, the first in {g}, the second in {b}

    @property
    def turns(self) -> int:
        """Number of free rotation axes."""
        return sum(self.frame.angular_dof)

    @property
    def slides(self) -> int:
        """Number of free translation axes."""
        return sum(self.frame.linear_dof)

    @property
    def only_velocities(self) -> bool:
        """Whether the constraint, like a wheel, restricts velocities only.

        In BB and GG, the axes and the origin are fixed in the same body, so the free translations turn with
        the body. Alternating rotations and translations then reach poses that neither reaches by itself.
        """
        return self.slides in (1, 2) and self.frame.linear_type in (LinearType.BB, LinearType.GG)

    @cached_property
    def distinct(self) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Single free or single constrained axis (3,) of the angular and of the linear frame, in {g}.

        An axis that is fixed in {b} is the mean over all poses; None if all axes of a frame are alike.
        """
        frame, found = self.frame, []
        angular_on_body, linear_on_body, _ = fixed_on_body(frame)
        for axes, dof, on_body in (
            (frame.angular_axes, frame.angular_dof, angular_on_body),
            (frame.linear_axes, frame.linear_dof, linear_on_body),
        ):
            place = distinct_axis(dof)
            axis = None if place is None else np.asarray(axes, float)[:, place]
            if axis is not None and on_body:
                axis = np.mean(self.poses[:, :3, :3] @ axis, axis=0)
                axis /= np.linalg.norm(axis)
            found.append(axis)
        return found[0], found[1]

    @property
    def relation(self) -> AxisRelation | None:
        """Relation of the distinct axes of both frames; None if a frame has no distinct axis."""
        angular, linear = self.distinct
        return None if angular is None or linear is None else relation_of_cosine(float(angular @ linear))


@dataclass(frozen=True)
class Plan:
    """A chain that may reproduce a constraint.

    The slides move along the free axes of the frame, along the hinge, in the plane normal to the hinge, or in
    all of space.
    """

    type: JointType
    turns_first: bool = False  # whether the rotating parts precede the slides in the chain
    axis: np.ndarray | None = None  # (3,) in the ground, positive, of the first hinge; None for a ball
    second: np.ndarray | None = None  # (3,) in the child, direction of the second hinge
    slides: Literal["free", "along", "plane", "space"] = "free"
    is_envelope: bool = False  # as in :class:`Joint`


def positive(axis: np.ndarray) -> np.ndarray:
    """Return an axis (3,) with the sign that makes its largest component positive."""
    signed: np.ndarray = axis * np.sign(axis[np.argmax(np.abs(axis))])
    return signed


def joint_plans(geometry: Geometry) -> list[Plan]:
    """Return the chains to fit to the poses; the best fit becomes the joint. Empty if no chain fits."""
    turns, slides = geometry.turns, geometry.slides
    # slides come after the rotations if their axes are fixed in {b} and the origin is fixed in {g}
    last = slides in (1, 2) and geometry.frame.linear_type == LinearType.BG
    if turns == 0:
        kinds: tuple[JointType, ...] = ("fixed", "prismatic", "general", "general")
        return [Plan(kinds[slides])]
    distinct, other = geometry.distinct
    if turns == 1 and distinct is not None:
        return _hinge_plans(geometry, positive(distinct), other, last)
    if geometry.universal is not None:
        return [Plan("universal", axis=positive(geometry.universal[0]), second=geometry.universal[1])]
    if (slides == 3 and turns == 3) or geometry.only_velocities:
        return []  # combinations of the free motions reach every pose
    if distinct is None:
        return [Plan("general" if slides else "spherical", turns_first=last)]
    first, second = universal_axes(geometry.poses[:, :3, :3], distinct)
    return [Plan("general" if slides else "universal", turns_first=last, axis=positive(first), second=second)]


def _hinge_plans(geometry: Geometry, axis: np.ndarray, other: np.ndarray | None, last: bool) -> list[Plan]:
    """The chains of a constraint with one free rotation, whose axis (3,) is fixed in both bodies."""
    relation, slides = geometry.relation, geometry.slides
    if relation == AxisRelation.PARALLEL and other is not None:
        if slides == 1 and geometry.pitch is not None:
            return [Plan("screw", axis=axis, slides="along")]
        # the identification has two estimates of the axis: from the rotations and from the translations
        kind: JointType = "cylindrical" if slides == 1 else "planar"
        where: Literal["along", "plane"] = "along" if slides == 1 else "plane"
        return [Plan(kind, axis=each, slides=where) for each in (axis, positive(other))]
    if geometry.only_velocities:
        # a free translation that turns with the hinge covers a plane if it is normal to it, else all of space
        plane = slides == 1 and relation == AxisRelation.PERPENDICULAR
        return [Plan("general", axis=axis, slides="plane" if plane else "space", is_envelope=True)]
    return [Plan("general" if slides else "revolute", turns_first=last, axis=axis)]


def universal_axes(rotations: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pair of axes (3,), one in each body, whose mutual angle varies least over the motion.

    In a universal joint, the direction of the constrained rotation is perpendicular to both joint axes and
    fixed in neither body. For an axis a of the ground and an axis b of the body, a^T R(k) b is constant over
    the rotations (K, 3, 3). ``normal`` (3,) is the constrained direction in the ground at the mean pose.
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

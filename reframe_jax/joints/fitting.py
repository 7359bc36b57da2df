"""Fit a joint to a constraint frame and the poses from which it was identified.

The frame determines the chains of hinges, slides and balls that may reproduce the constraint, their axes and
their points. The poses determine the home pose (an average over all poses), the range of each coordinate, the
fit error, and the chain with the smallest error.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.constraints.catalogue import describe, lookup
from reframe_jax.constraints.frame import ConstraintFrame, fixed_on_body
from reframe_jax.constraints.types import AxisRelation, LinearType, distinct_axis, relation_of_cosine
from reframe_jax.geometry.numpy_rotations import angles_between, nearest_rotations, positive_axis
from reframe_jax.joints.chain import JointPart, ball_hinges, chain_coordinates, chain_poses, split_coordinates
from reframe_jax.joints.joint import Joint, JointType

_ROUNDS = 3  # rounds of averaging, until the home pose converges
_AVERAGED = 2000  # largest number of poses in the average; longer recordings are subsampled
_UNIVERSAL = np.radians(5.0)  # orientation error above which no universal joint fits


@dataclass(frozen=True)
class _Geometry:
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
class _Plan:
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


def fit_joint(
    frame: ConstraintFrame,
    poses: "ArrayLike",
    *,
    parent: str = "ground",
    child: str = "body",
    length: float = 0.3,
    pitch: float | None = None,
    universal: "ArrayLike | None" = None,
) -> Joint:
    """Fit a joint to poses that obey a constraint.

    Args:
        frame: constraint frame of a single window.
        poses: (K+1, 4, 4) of {b} in {g}, m, without outliers.
        parent: name of {g}.
        child: name of {b}.
        length: m, position error that has the same weight as an orientation error of 1 rad: the ratio of the
            position noise to the orientation noise.
        pitch: m/rad of a screw joint, positive for a right-handed thread; None for other joints.
        universal: (2, 3) axes of two hinges that follow each other, such as a universal joint, the first in
            {g} and the second in {b}; None unless the frame has one constrained rotation.

    Returns:
        The joint. If no chain of hinges, slides and balls reproduces the constraint, the joint has the type
        "general", no parts, and a sentence in ``gauge`` with the reason. If a chain reaches the poses of the
        constraint but constrains fewer velocities, ``is_envelope`` is True, and a sentence in ``gauge`` names
        the velocities that the chain leaves free.

    Raises:
        ValueError: for a batch; poses of another shape or not finite; equal or empty names; a length that is
            not positive; a pitch that is 0 or not finite; a pitch for a constraint other than one rotation
            and the translation along its axis; universal axes that are not unit vectors; universal axes for a
            constraint with less than two free rotations.
    """
    values = np.asarray(poses, dtype=float)
    if values.ndim != 3 or values.shape[1:] != (4, 4) or len(values) == 0:
        raise ValueError(f"Expected poses of shape (K+1, 4, 4), not {values.shape}.")
    if not np.isfinite(values).all():
        raise ValueError("Expected finite poses; leave out the poses with NaN or infinite values.")
    if np.shape(frame.position) != (3,):
        raise ValueError(f"Expected a single frame, not a batch of shape {np.shape(frame.position)[:-1]}.")
    if not parent or not child or parent == child:
        raise ValueError(f"Expected two different names, not {parent!r} and {child!r}.")
    if not 0 < length < np.inf:
        raise ValueError(f"Expected a positive length in m, not {length}.")
    axes = None if universal is None else np.asarray(universal, float)
    geometry = _Geometry(frame, values, pitch, axes)
    key = frame.linear_type, frame.angular_dof, frame.linear_dof
    entry = lookup(*key, geometry.relation, pitch is not None, universal is not None)
    name = describe(*key, geometry.relation) if entry is None else entry.name
    if axes is not None:
        if axes.shape != (2, 3) or not np.allclose(np.linalg.norm(axes, axis=1), 1, atol=1e-3):
            raise ValueError("Expected two unit vectors as the axes of a universal joint.")
        if geometry.turns < 2:
            raise ValueError("Universal axes need a constraint with at least two free rotations.")
    if pitch is not None:
        if not (np.isfinite(pitch) and pitch != 0):
            raise ValueError(f"Expected a pitch in m/rad other than 0, not {pitch}.")
        if name != "Screw joint":
            raise ValueError("Only a single rotation with a translation along its axis has a pitch.")
    names = {"name": name, "parent": parent, "child": child, "length": length}
    joints = [_fit(geometry, plan, names) for plan in _joint_plans(geometry)]
    return min(joints, key=lambda joint: joint.position_error, default=_without_chain(geometry, names))


def _fit(geometry: _Geometry, plan: _Plan, names: dict[str, Any]) -> Joint:
    """Fit the chain of a plan; ``names`` are the fields of the joint that the fit does not change."""
    poses, home, length = geometry.poses, geometry.poses[0], names["length"]
    step = 1 if plan.type == "screw" else max(1, len(poses) // _AVERAGED)  # full turns are counted
    some = poses[::step]
    for _ in range(_ROUNDS):
        parts = _parts(geometry, plan, home)
        coordinates = chain_coordinates(parts, home, some, length)
        home = np.mean(np.linalg.inv(chain_poses(parts, np.eye(4), coordinates)) @ some, axis=0)
        home[:3, :3] = nearest_rotations(home[:3, :3])
    parts = _parts(geometry, plan, home)
    coordinates = chain_coordinates(parts, home, poses, length)
    model = chain_poses(parts, home, coordinates)
    rotation_error = _rms(angles_between(poses[:, :3, :3], model[:, :3, :3]))
    if plan.second is not None and rotation_error > _UNIVERSAL:
        return _without_chain(geometry, names)
    ranged = []
    for part, values in zip(parts, split_coordinates(parts, coordinates), strict=True):
        if part.kind == "ball":
            high = float(np.linalg.norm(values, axis=-1).max())
            ranged.append(replace(part, high=high, hinges=ball_hinges(part.point, values)))
        else:
            ranged.append(replace(part, low=float(values.min()), high=float(values.max())))
    parts = tuple(ranged)
    turning = [part for part in parts if part.kind != "slide"]
    full_turn = plan.type == "revolute" and parts[0].high - parts[0].low >= 2 * np.pi
    axis = next((part.axis for part in (*turning, *parts) if part.kind != "ball"), None)
    return Joint(
        type="continuous" if full_turn else plan.type,
        axis=None if plan.type == "general" else axis,
        point=turning[0].point if turning else home[:3, 3],
        home=home,
        parts=parts,
        gauge=_gauge(geometry, plan, parts, names["child"]),
        is_envelope=plan.is_envelope,
        position_error=_rms(np.linalg.norm(model[:, :3, 3] - poses[:, :3, 3], axis=-1)),
        rotation_error=rotation_error,
        **names,
    )


def _without_chain(geometry: _Geometry, names: dict[str, Any]) -> Joint:
    """A joint without coordinates: the child is free, or no chain reproduces the constraint."""
    why = (
        "No chain of hinges, slides and balls makes this constraint: like a wheel, it restricts velocities "
        "only, and every pose can be reached. Simulate the contact."
    )
    kind: JointType = "general"
    if geometry.turns == geometry.slides == 3:
        kind = "floating"
        why = "There is no constraint: the pose is free."
    elif geometry.turns == 2 and not geometry.only_velocities:
        why = (
            "No chain of hinges, slides and balls makes this constraint: two hinges do not fit its "
            "rotations, or their axes are not known."
        )
    names = {**names, "position_error": np.nan, "rotation_error": np.nan}
    home = geometry.poses[0]
    return Joint(kind, axis=None, point=home[:3, 3], home=home, parts=(), gauge=(why,), **names)


def _parts(geometry: _Geometry, plan: _Plan, home: np.ndarray) -> tuple[JointPart, ...]:
    """Parts of the chain at zero coordinates, with the child at its home pose."""
    rotation, origin, axis, frame = home[:3, :3], home[:3, 3], plan.axis, geometry.frame
    _, linear_on_body, point_on_body = fixed_on_body(frame)
    free = np.asarray(frame.linear_axes, float).T[np.asarray(frame.linear_dof) == 1]
    free, point = free @ rotation.T if linear_on_body else free, np.asarray(frame.position, float)
    if plan.type == "screw":  # a hinge with a pitch
        directions = []
    elif plan.slides == "along" and axis is not None:
        directions = [axis]
    elif plan.slides == "plane" and axis is not None:
        along = free[-1] - axis * (free[-1] @ axis)
        along = positive_axis(along / np.linalg.norm(along))
        directions = [along, np.cross(axis, along)]
    elif plan.slides == "space":
        directions = list(np.eye(3))
    else:
        directions = [positive_axis(each) for each in free]
    if plan.slides in ("plane", "space") or geometry.slides == 3:
        point = origin
    elif geometry.slides and plan.slides == "free" and not plan.turns_first:
        point = rotation @ point + origin  # fixed in the child, and the slides move it
    elif point_on_body:
        point = np.mean(geometry.poses[:, :3, :3] @ point + geometry.poses[:, :3, 3], axis=0)
    slides = [JointPart("slide", direction, origin) for direction in directions]
    turns = []
    if axis is not None and plan.second is not None:
        turns = [JointPart("hinge", each, point) for each in (axis, positive_axis(rotation @ plan.second))]
    elif axis is not None:  # at the point on the axis nearest to the origin of the child
        pitch = geometry.pitch if plan.type == "screw" else None
        turns = [JointPart("hinge", axis, point + axis * (axis @ (origin - point)), pitch=pitch or 0.0)]
    elif geometry.turns:
        turns = [JointPart("ball", np.zeros(3), point)]
    return (*turns, *slides) if plan.turns_first else (*slides, *turns)


def _gauge(geometry: _Geometry, plan: _Plan, parts: Sequence[JointPart], child: str) -> tuple[str, ...]:
    """Sentences on free choices, the values chosen, and velocities that the chain does not constrain."""
    kinds = [part.kind for part in parts]
    sentences = []
    if plan.is_envelope:
        held = "the plane of the motion" if plan.slides == "plane" else "the axis of rotation"
        lost = "one more velocity" if len(parts) - geometry.slides == 2 else "two more velocities"
        sentences.append(
            f"The chain constrains {held} only. Like a wheel, the constraint also blocks {lost} of the "
            f"{child} at zero, which no chain of joints expresses."
        )
    if kinds:
        sentences.append(
            "The zero of the coordinates is arbitrary; it is the start of the recording, averaged over "
            "the poses."
        )
    if "hinge" in kinds or "slide" in kinds:
        sentences.append("The sign of an axis is arbitrary; its largest component is positive.")
    if plan.slides == "plane":
        sentences.append(
            "The directions of the slides within the plane and the place of the hinge are arbitrary: the "
            f"first slide is the fastest identified axis, and the hinge is at the origin of the {child}."
        )
    elif kinds.count("slide") == 3 and kinds.count("hinge"):
        sentences.append(f"The place of the hinge is arbitrary; it is at the origin of the {child} at zero.")
    elif kinds.count("hinge") == 1:
        sentences.append(
            "Any point on this axis is equally valid; the given point is nearest to the origin of the "
            f"{child} at zero."
        )
    if plan.type == "screw" and geometry.pitch is not None:
        hand = "right" if geometry.pitch > 0 else "left"
        lead = 2e3 * np.pi * abs(geometry.pitch)
        turn = f"{lead:.4g} mm along the axis per turn"
        sentences.append(f"The {child} slides {turn}; the thread is {hand}-handed.")
    if kinds and set(kinds) == {"slide"}:
        sentences.append(f"Any point is equally valid; the origin of the {child} at zero is given.")
    if not kinds:
        sentences.append("The joint is fixed; its home pose is the mean of the recorded poses.")
    return tuple(sentences)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _joint_plans(geometry: _Geometry) -> list[_Plan]:
    """Return the chains to fit to the poses; the best fit becomes the joint. Empty if no chain fits."""
    turns, slides = geometry.turns, geometry.slides
    # slides come after the rotations if their axes are fixed in {b} and the origin is fixed in {g}
    last = slides in (1, 2) and geometry.frame.linear_type == LinearType.BG
    if turns == 0:
        kinds: tuple[JointType, ...] = ("fixed", "prismatic", "general", "general")
        return [_Plan(kinds[slides])]
    distinct, other = geometry.distinct
    if turns == 1 and distinct is not None:
        return _hinge_plans(geometry, positive_axis(distinct), other, last)
    if (slides == 3 and turns == 3) or geometry.only_velocities:
        return []  # combinations of the free motions reach every pose
    if geometry.universal is not None:
        first, second = geometry.universal
        kind: JointType = "general" if slides else "universal"
        return [_Plan(kind, turns_first=last, axis=positive_axis(first), second=second)]
    return [_Plan("general" if slides else "spherical", turns_first=last)] if turns == 3 else []


def _hinge_plans(geometry: _Geometry, axis: np.ndarray, other: np.ndarray | None, last: bool) -> list[_Plan]:
    """The chains of a constraint with one free rotation, whose axis (3,) is fixed in both bodies."""
    relation, slides = geometry.relation, geometry.slides
    if relation == AxisRelation.PARALLEL and other is not None:
        if slides == 1 and geometry.pitch is not None:
            return [_Plan("screw", axis=axis, slides="along")]
        # the identification has two estimates of the axis: from the rotations and from the translations
        kind: JointType = "cylindrical" if slides == 1 else "planar"
        where: Literal["along", "plane"] = "along" if slides == 1 else "plane"
        return [_Plan(kind, axis=each, slides=where) for each in (axis, positive_axis(other))]
    if geometry.only_velocities:
        # a free translation that turns with the hinge covers a plane if it is normal to it, else all of space
        plane = slides == 1 and relation == AxisRelation.PERPENDICULAR
        return [_Plan("general", axis=axis, slides="plane" if plane else "space", is_envelope=True)]
    return [_Plan("general" if slides else "revolute", turns_first=last, axis=axis)]

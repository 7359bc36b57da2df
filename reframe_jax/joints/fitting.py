"""From a constraint frame and the poses it was identified from to a joint.

The frame fixes the axes and the point; the poses fix what a frame does not say: the home pose, by averaging
over them, the range of the coordinates, and how well the joint fits.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.constraints.catalogue import describe, lookup
from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.located import parts_on_body
from reframe_jax.constraints.types import AxisRelation, LinearType
from reframe_jax.joints.chain import JointPart, PartKind, chain_coordinates, chain_poses
from reframe_jax.joints.joint import Joint, JointType
from reframe_jax.joints.universal import universal_axes

__all__ = ["fit_joint"]

_ALIGNED = np.cos(np.radians(15.0))  # of the angle within which two axes count as parallel
_SQUARE = np.sin(np.radians(15.0))  # of the angle within which they count as perpendicular
_ROUNDS = 3  # in which the home pose settles
_AVERAGED = 2000  # poses over which it is averaged: of many every few
_UNIVERSAL = np.radians(5.0)  # error above which two axes do not explain the rotations


@dataclass(frozen=True)
class _Geometry:
    """A constraint frame in NumPy, and poses.

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

    def in_ground(self, direction: np.ndarray, on_body: bool) -> np.ndarray:
        """A direction that is fixed in both bodies, in the ground: the mean over all poses."""
        return _unit(np.mean(self.poses[:, :3, :3] @ direction, axis=0)) if on_body else direction

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
class _Plan:
    """What kind of chain a constraint is.

    ``is_chain`` is False where nothing but velocities is restricted, or nothing at all. ``axis`` is the
    direction of a hinge, and of the slide of a cylindrical joint or the normal of a planar one; ``second``
    is the second axis of a universal joint in the child.
    """

    type: JointType
    is_chain: bool = True
    turns: PartKind | None = None
    turns_first: bool = False
    axis: np.ndarray | None = None
    second: np.ndarray | None = None


def fit_joint(
    frame: ConstraintFrame,
    poses: ArrayLike,
    *,
    parent: str = "ground",
    child: str = "body",
    length: float = 0.3,
) -> Joint:
    """Return the joint that a constraint is, given poses that obey it.

    Args:
        frame: of a single window.
        poses: (K+1, 4, 4) of {b} in {g}, m, without outliers.
        parent: name of {g}.
        child: name of {b}.
        length: m that weigh as much as one radian: the noise of positions over that of orientations.

    Returns:
        The joint. A class that no chain of hinges, slides and balls makes has the type "general", no
        parts, and a sentence in ``gauge`` that says so.

    Raises:
        ValueError: for a batch, poses of another shape or that are not finite, equal or empty names, or a
            length that is not positive.
    """
    values = np.asarray(poses, dtype=float)
    if values.ndim != 3 or values.shape[1:] != (4, 4) or len(values) == 0:
        raise ValueError(f"Expected poses of shape (K+1, 4, 4), not {values.shape}.")
    if not np.isfinite(values).all():
        raise ValueError("Expected finite poses; leave out those that are not.")
    if np.shape(frame.position) != (3,):
        raise ValueError(f"Expected a single frame, not a batch of shape {np.shape(frame.position)[:-1]}.")
    if not parent or not child or parent == child:
        raise ValueError(f"Expected two different names, not {parent!r} and {child!r}.")
    if not 0 < length < np.inf:
        raise ValueError(f"Expected a positive length in m, not {length}.")
    geometry = _geometry(frame, values)
    joints = [_fit(geometry, plan, parent, child, length) for plan in _plans(geometry)]
    return min(joints, key=lambda joint: joint.position_error)


def _geometry(frame: ConstraintFrame, poses: np.ndarray) -> _Geometry:
    angular, linear = np.asarray(frame.angular_axes, float).T, np.asarray(frame.linear_axes, float).T
    free = np.asarray(frame.linear_dof, bool)
    count = int(free.sum())
    odd = linear[free if count == 1 else ~free][0] if count in (1, 2) else None
    on_body = np.asarray(parts_on_body(frame.angular_type, frame.linear_type))
    turning = angular[np.asarray(frame.angular_dof, bool)]
    position = np.asarray(frame.position, float)
    return _Geometry(frame, poses, turning, linear[free], odd, position, *map(bool, on_body))


def _relation(geometry: _Geometry) -> AxisRelation | None:
    """Angle between the odd axes of the two frames; None where a frame has no odd axis."""
    turns = len(geometry.turning)
    if turns not in (1, 2) or geometry.odd is None:
        return None
    angular = geometry.turning[0] if turns == 1 else np.cross(*geometry.turning)
    turned = geometry.in_ground(angular, geometry.angular_on_body)
    cosine = abs(float(turned @ geometry.in_ground(geometry.odd, geometry.linear_on_body)))
    if cosine > _ALIGNED:
        return AxisRelation.PARALLEL
    return AxisRelation.PERPENDICULAR if cosine < _SQUARE else AxisRelation.OBLIQUE


def _plans(geometry: _Geometry) -> list[_Plan]:
    """The chains to try; of several, the one that fits best is the joint."""
    turns, slides = len(geometry.turning), len(geometry.sliding)
    if turns == 0:
        kinds: tuple[JointType, ...] = ("fixed", "prismatic", "general", "general")
        return [_Plan(kinds[slides])]
    if turns == 2:
        return [_universal_plan(geometry) if slides == 0 else _Plan("general", is_chain=False)]
    if turns == 3:
        kinds = ("spherical", "general", "general", "floating")
        return [_general_plan(geometry, kinds[slides], "ball", None)]
    axis = geometry.hinge()
    if _relation(geometry) == AxisRelation.PARALLEL and geometry.odd is not None:
        # the axis was found twice, from the rotations and from the translations
        other = geometry.in_ground(geometry.odd, geometry.linear_on_body)
        kind: JointType = "cylindrical" if slides == 1 else "planar"
        return [_Plan(kind, turns="hinge", axis=each) for each in (axis, other)]
    return [_general_plan(geometry, "revolute" if slides == 0 else "general", "hinge", axis)]


def _general_plan(geometry: _Geometry, kind: JointType, turns: PartKind, axis: np.ndarray | None) -> _Plan:
    """A rotation, with slides before it if they are fixed in the ground and move a point of the child."""
    linear = geometry.frame.linear_type
    if len(geometry.sliding) in (0, 3):
        return _Plan(kind, is_chain=kind != "floating", turns=turns, axis=axis)
    is_chain = linear in (LinearType.GB, LinearType.BG)
    return _Plan(kind, is_chain=is_chain, turns=turns, turns_first=linear == LinearType.BG, axis=axis)


def _universal_plan(geometry: _Geometry) -> _Plan:
    normal = geometry.in_ground(np.cross(*geometry.turning), geometry.angular_on_body)
    first, second = universal_axes(geometry.poses[:, :3, :3], normal)
    return _Plan("universal", turns="hinge", axis=first, second=second)


def _fit(geometry: _Geometry, plan: _Plan, parent: str, child: str, length: float) -> Joint:
    poses, home = geometry.poses, geometry.poses[0]
    name = _name(geometry)
    if not plan.is_chain:
        return _without_chain(geometry, plan.type, name, parent, child, length)
    some = poses[:: max(1, len(poses) // _AVERAGED)]
    for _ in range(_ROUNDS):
        parts = _parts(geometry, plan, home)
        coordinates = chain_coordinates(parts, home, some, length)
        home = _mean_pose(np.linalg.inv(chain_poses(parts, np.eye(4), coordinates)) @ some)
    parts = _parts(geometry, plan, home)
    coordinates = chain_coordinates(parts, home, poses, length)
    model = chain_poses(parts, home, coordinates)
    position_error = _rms(np.linalg.norm(model[:, :3, 3] - poses[:, :3, 3], axis=-1))
    rotation_error = _rms(_angles(model[:, :3, :3], poses[:, :3, :3]))
    if plan.type == "universal" and rotation_error > _UNIVERSAL:
        return _without_chain(geometry, "general", name, parent, child, length)
    parts = _with_ranges(parts, coordinates)
    turning = [part for part in parts if part.kind != "slide"]
    full_turn = plan.type == "revolute" and parts[0].high - parts[0].low >= 2 * np.pi
    first = next((part for part in (*turning, *parts) if part.kind != "ball"), None)
    return Joint(
        type="continuous" if full_turn else plan.type,
        name=name,
        parent=parent,
        child=child,
        axis=None if first is None or plan.type == "general" else first.axis,
        point=turning[0].point if turning else home[:3, 3],
        home=home,
        parts=parts,
        gauge=_gauge(plan, parts, child),
        position_error=position_error,
        rotation_error=rotation_error,
        length=length,
    )


def _without_chain(
    geometry: _Geometry, kind: JointType, name: str, parent: str, child: str, length: float
) -> Joint:
    """A joint without coordinates: the child is free, or only its velocities are restricted."""
    why = (
        "There is no constraint: the pose is free."
        if kind == "floating"
        else "No chain of hinges, slides and balls makes this constraint: it restricts velocities, as a "
        "contact does, and leaves the poses free."
    )
    home, nothing = geometry.poses[0], float("nan")
    return Joint(kind, name, parent, child, None, home[:3, 3], home, (), (why,), nothing, nothing, length)


def _parts(geometry: _Geometry, plan: _Plan, home: np.ndarray) -> tuple[JointPart, ...]:
    """The chain, with the child at a home pose."""
    origin = home[:3, 3]
    if plan.type == "cylindrical" and plan.axis is not None:
        directions = [_positive(plan.axis)]
    elif plan.type == "planar" and plan.axis is not None:
        normal = _positive(plan.axis)
        along = geometry.slides(home)[1]
        along = _positive(_unit(along - normal * (along @ normal)))
        directions = [along, np.cross(normal, along)]
    elif len(geometry.turning):
        directions = [_positive(direction) for direction in geometry.slides(home)]
    else:
        directions = [
            _positive(geometry.in_ground(direction, geometry.linear_on_body))
            for direction in geometry.sliding
        ]
    slides = [JointPart("slide", direction, origin) for direction in directions]
    turns = _turns(geometry, plan, home)
    return (*turns, *slides) if plan.turns_first else (*slides, *turns)


def _turns(geometry: _Geometry, plan: _Plan, home: np.ndarray) -> list[JointPart]:
    """The rotation of a chain: nothing, a hinge, two, or a ball."""
    if plan.turns is None:
        return []
    point, origin = _anchor(geometry, plan, home), home[:3, 3]
    if plan.axis is None:
        return [JointPart("ball", np.zeros(3), point)]
    axes = [plan.axis] if plan.second is None else [plan.axis, home[:3, :3] @ plan.second]
    axes = [_positive(axis) for axis in axes]
    if plan.second is None:  # the point of the axis nearest to the origin of the child
        point = point + axes[0] * (axes[0] @ (origin - point))
    return [JointPart("hinge", axis, point) for axis in axes]


def _anchor(geometry: _Geometry, plan: _Plan, home: np.ndarray) -> np.ndarray:
    """A point of the axis, or the centre, in the ground with the child at its home pose."""
    if plan.type == "planar" or len(geometry.sliding) == 3:
        return home[:3, 3]
    moved = len(geometry.sliding) and plan.type != "cylindrical" and not plan.turns_first
    if moved:  # a point of the child that slides take along
        return home[:3, :3] @ geometry.position + home[:3, 3]
    return geometry.centre()


def _gauge(plan: _Plan, parts: Sequence[JointPart], child: str) -> tuple[str, ...]:
    """What the motion leaves open, and what was chosen."""
    kinds = [part.kind for part in parts]
    said = []
    if kinds:
        said.append("Any pose may be zero; it is where the recording starts, averaged over the poses.")
    if "hinge" in kinds or "slide" in kinds:
        said.append("An axis and its negative are the same; the largest component is positive.")
    if plan.type == "planar":
        said.append(
            "The two slides may be turned within the plane, and the hinge may be anywhere: the first slide "
            f"is the fastest identified axis, and the hinge is at the origin of the {child}."
        )
    elif kinds.count("hinge") == 1:
        said.append(
            f"The point may slide along the axis; it is the one nearest to the origin of the {child} at zero."
        )
    if kinds and set(kinds) == {"slide"}:
        said.append(f"The point may be anywhere; it is the origin of the {child} at zero.")
    if not kinds:
        said.append("Nothing moves; the home pose is the mean of the recorded poses.")
    return tuple(said)


def _with_ranges(parts: Sequence[JointPart], coordinates: np.ndarray) -> tuple[JointPart, ...]:
    first, ranged = 0, []
    for part in parts:
        values = coordinates[:, first : first + part.width]
        first += part.width
        low, high = (
            (0.0, np.linalg.norm(values, axis=-1).max())
            if part.kind == "ball"
            else (values.min(), values.max())
        )
        ranged.append(replace(part, low=float(low), high=float(high)))
    return tuple(ranged)


def _name(geometry: _Geometry) -> str:
    frame, relation = geometry.frame, _relation(geometry)
    key = frame.linear_type, frame.angular_dof, frame.linear_dof
    entry = lookup(*key, relation)
    return describe(*key, relation) if entry is None else entry.name


def _mean_pose(poses: np.ndarray) -> np.ndarray:
    """The pose nearest to all: the mean position, and the rotation nearest to the mean matrix."""
    mean = poses.mean(axis=0)
    left, _, right = np.linalg.svd(mean[:3, :3])
    left[:, 2] *= np.linalg.det(left @ right)
    mean[:3, :3] = left @ right
    return mean


def _angles(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angles (K,) between rotations (K, 3, 3), rad; precise where they are small."""
    chord = np.linalg.norm(first - second, axis=(-2, -1)) / np.sqrt(8)
    return 2 * np.arcsin(np.minimum(chord, 1))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _unit(vector: np.ndarray) -> np.ndarray:
    unit: np.ndarray = vector / np.linalg.norm(vector)
    return unit


def _positive(axis: np.ndarray) -> np.ndarray:
    """The axis or its negative: the one whose largest component is positive."""
    signed: np.ndarray = axis * np.sign(axis[np.argmax(np.abs(axis))])
    return signed

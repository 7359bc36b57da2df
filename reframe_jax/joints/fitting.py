"""From a constraint frame and the poses it was identified from to a joint.

The frame fixes the axes and the point; the poses fix what a frame does not say: the home pose, by averaging
over them, the range of the coordinates, and how well the joint fits.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.constraints.catalogue import describe, lookup
from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.joints.cardan import ball_hinges
from reframe_jax.joints.chain import JointPart, chain_coordinates, chain_poses
from reframe_jax.joints.joint import Joint, JointType
from reframe_jax.joints.plans import Geometry, Plan, frame_geometry, joint_plans, only_velocities, relate_axes

__all__ = ["fit_joint"]

_ROUNDS = 3  # in which the home pose settles
_AVERAGED = 2000  # poses over which it is averaged: of many every few
_UNIVERSAL = np.radians(5.0)  # error above which two axes do not explain the rotations


def fit_joint(
    frame: ConstraintFrame,
    poses: ArrayLike,
    *,
    parent: str = "ground",
    child: str = "body",
    length: float = 0.3,
    pitch: float | None = None,
    universal: ArrayLike | None = None,
) -> Joint:
    """Return the joint that a constraint is, given poses that obey it.

    Args:
        frame: of a single window.
        poses: (K+1, 4, 4) of {b} in {g}, m, without outliers.
        parent: name of {g}.
        child: name of {b}.
        length: m that weigh as much as one radian: the noise of positions over that of orientations.
        pitch: m/rad of a screw joint, positive for a right-handed thread; None for all others.
        universal: (2, 3) axes of a universal joint, the first in {g} and the second in {b}; None for all
            others, and for a frame about one axis of which the body does not turn, where they are found.

    Returns:
        The joint. A class that no chain of hinges, slides and balls makes has the type "general", no
        parts, and a sentence in ``gauge`` that says so. Where a chain reaches the poses of the constraint but
        holds fewer of its velocities, ``is_envelope`` is True, and a sentence says what is not held.

    Raises:
        ValueError: for a batch, poses of another shape or that are not finite, equal or empty names, a length
            that is not positive, a pitch that is 0 or not finite, or of a constraint other than one free
            rotation and one free translation along its axis, or two axes that are no unit vectors, or of a
            constraint with a free translation.
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
    axes = None if universal is None else np.asarray(universal, float)
    geometry = frame_geometry(frame, values, pitch, axes)
    if axes is not None:
        if axes.shape != (2, 3) or not np.allclose(np.linalg.norm(axes, axis=1), 1, atol=1e-3):
            raise ValueError("Expected two unit vectors as the axes of a universal joint.")
        if len(geometry.turning) < 2 or len(geometry.sliding):
            raise ValueError("Only a body that turns about a point is on a universal joint.")
    if pitch is not None:
        if not (np.isfinite(pitch) and pitch != 0):
            raise ValueError(f"Expected a pitch in m/rad other than 0, not {pitch}.")
        if (len(geometry.turning), len(geometry.sliding)) != (1, 1) or _name(geometry) != "Screw joint":
            raise ValueError(
                "Only a body with one free rotation and a translation along its axis has a pitch."
            )
    joints = [_fit(geometry, plan, parent, child, length) for plan in joint_plans(geometry)]
    return min(joints, key=lambda joint: joint.position_error)


def _fit(geometry: Geometry, plan: Plan, parent: str, child: str, length: float) -> Joint:
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
    if plan.second is not None and rotation_error > _UNIVERSAL:
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
        gauge=_gauge(geometry, plan, parts, child),
        is_envelope=plan.is_envelope,
        position_error=position_error,
        rotation_error=rotation_error,
        length=length,
    )


def _without_chain(
    geometry: Geometry, kind: JointType, name: str, parent: str, child: str, length: float
) -> Joint:
    """A joint without coordinates: the child is free, or no chain makes its motion."""
    why = (
        "No chain of hinges, slides and balls makes this constraint: it restricts velocities only, as a "
        "wheel does, and leaves every pose within reach. Simulate the contact."
    )
    if kind == "floating":
        why = "There is no constraint: the pose is free."
    elif len(geometry.turning) == 2 and not only_velocities(geometry):
        why = "No chain of hinges, slides and balls makes this constraint: two hinges do not turn as it does."
    home, nothing = geometry.poses[0], float("nan")
    return Joint(kind, name, parent, child, None, home[:3, 3], home, (), (why,), nothing, nothing, length)


def _parts(geometry: Geometry, plan: Plan, home: np.ndarray) -> tuple[JointPart, ...]:
    """The chain, with the child at a home pose."""
    origin = home[:3, 3]
    directions = _slide_directions(geometry, plan, home)
    slides = [JointPart("slide", direction, origin) for direction in directions]
    if plan.type == "screw":
        slides = []  # that of the hinge
    turns = _turns(geometry, plan, home)
    return (*turns, *slides) if plan.turns_first else (*slides, *turns)


def _slide_directions(geometry: Geometry, plan: Plan, home: np.ndarray) -> list[np.ndarray]:
    """Unit vectors (3,) of the slides in the ground, with the child at its home pose."""
    if plan.slides == "along" and plan.axis is not None:
        return [_positive(plan.axis)]
    if plan.slides == "plane" and plan.axis is not None:
        normal = _positive(plan.axis)
        along = geometry.slides(home)[-1]
        along = _positive(_unit(along - normal * (along @ normal)))
        return [along, np.cross(normal, along)]
    if plan.slides == "space":
        return list(np.eye(3))
    if len(geometry.turning):
        return [_positive(direction) for direction in geometry.slides(home)]
    return [
        _positive(geometry.in_ground(direction, geometry.linear_on_body)) for direction in geometry.sliding
    ]


def _turns(geometry: Geometry, plan: Plan, home: np.ndarray) -> list[JointPart]:
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
    pitch = geometry.pitch if plan.type == "screw" else None
    return [JointPart("hinge", axis, point, pitch=pitch or 0.0) for axis in axes]


def _anchor(geometry: Geometry, plan: Plan, home: np.ndarray) -> np.ndarray:
    """A point of the axis, or the centre, in the ground with the child at its home pose."""
    if plan.slides in ("plane", "space") or len(geometry.sliding) == 3:
        return home[:3, 3]
    moved = len(geometry.sliding) and plan.slides == "free" and not plan.turns_first
    if moved:  # a point of the child that slides take along
        return home[:3, :3] @ geometry.position + home[:3, 3]
    return geometry.centre()


def _gauge(geometry: Geometry, plan: Plan, parts: Sequence[JointPart], child: str) -> tuple[str, ...]:
    """What the motion leaves open, what was chosen, and what the chain does not hold."""
    kinds = [part.kind for part in parts]
    said = []
    if plan.is_envelope:
        held = "the plane of the motion" if plan.slides == "plane" else "the axis of rotation"
        lost = "one more velocity" if len(parts) - len(geometry.sliding) == 2 else "two more velocities"
        said.append(
            f"The chain holds {held}. The constraint also holds {lost} of the {child} at zero, as a wheel "
            "does, and no chain of joints says that."
        )
    if kinds:
        said.append("Any pose may be zero; it is where the recording starts, averaged over the poses.")
    if "hinge" in kinds or "slide" in kinds:
        said.append("An axis and its negative are the same; the largest component is positive.")
    if plan.slides == "plane":
        said.append(
            "The two slides may be turned within the plane, and the hinge may be anywhere: the first slide "
            f"is the fastest identified axis, and the hinge is at the origin of the {child}."
        )
    elif kinds.count("slide") == 3 and kinds.count("hinge"):
        said.append(f"A hinge may be anywhere; it is at the origin of the {child} at zero.")
    elif kinds.count("hinge") == 1:
        said.append(
            f"The point may slide along the axis; it is the one nearest to the origin of the {child} at zero."
        )
    if plan.type == "screw" and geometry.pitch is not None:
        hand = "right" if geometry.pitch > 0 else "left"
        lead = 2e3 * np.pi * abs(geometry.pitch)
        said.append(f"The {child} slides {lead:.4g} mm along the axis a turn; the thread is {hand}-handed.")
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
        if part.kind == "ball":
            high = float(np.linalg.norm(values, axis=-1).max())
            ranged.append(replace(part, high=high, hinges=ball_hinges(part.point, values)))
        else:
            ranged.append(replace(part, low=float(values.min()), high=float(values.max())))
    return tuple(ranged)


def _name(geometry: Geometry) -> str:
    frame, relation = geometry.frame, relate_axes(geometry)
    key = frame.linear_type, frame.angular_dof, frame.linear_dof
    entry = lookup(*key, relation, geometry.pitch is not None, geometry.universal is not None)
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

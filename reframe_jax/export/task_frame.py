"""The task frame for a controller: its pose, and which axes are motion- or force-controlled."""

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.constraints.catalogue import describe, lookup
from reframe_jax.constraints.frame import ConstraintFrame, fixed_on_body, locate_on_host
from reframe_jax.constraints.types import AxisRelation, distinct_axis, relation_of_cosine
from reframe_jax.geometry.numpy_rotations import matrices_to_quaternions
from reframe_jax.identification.results import Identification
from reframe_jax.motion.checks import is_rigid


@dataclass(frozen=True, eq=False)
class TaskFrame:
    """One frame whose axes serve both the angular and the linear constraint.

    Arrays of six values refer to translations along x, y, z of this frame, then rotations about x, y, z.

    Attributes:
        constraint: name of the constraint.
        frame_id: name of the body in which ``transform`` is expressed: the body in which the frame is fixed,
            or the ground if axes and origin are fixed in different bodies.
        task: name of this frame.
        transform: (4, 4) pose of this frame in ``frame_id``, m.
        validity: a sentence that names the poses at which the frame is valid.
        free: (6,) bool, whether motion along or about an axis is free.
        stiffness: (6,) N/m along, then N m/rad about the axes of this frame.
        turned: degrees by which the identified angular axes were turned to align with the linear axes.
    """

    constraint: str
    frame_id: str
    task: str
    transform: np.ndarray
    validity: str
    free: np.ndarray
    stiffness: np.ndarray
    turned: float

    @property
    def motion_selection(self) -> np.ndarray:
        """(6, 6) diagonal, in the axes of this frame: 1 for motion-controlled axes, which are free."""
        return np.diag(self.free.astype(float))

    @property
    def force_selection(self) -> np.ndarray:
        """(6, 6) diagonal, in the axes of this frame: 1 for force-controlled axes, which are constrained."""
        return np.diag((~self.free).astype(float))

    def in_frame_id(self, matrix: "ArrayLike") -> np.ndarray:
        """Rotate a (6, 6) matrix, such as a selection or ``np.diag(stiffness)``, to the axes of ``frame_id``.

        The reference point remains the origin of this frame.
        """
        turn = np.kron(np.eye(2), self.transform[:3, :3])
        return turn @ np.asarray(matrix, float) @ turn.T

    def to_yaml(self) -> str:
        """Write YAML with the fields of a ``geometry_msgs/TransformStamped``, and the stiffness."""
        return "\n".join(_yaml_lines(self._document())) + "\n"

    def to_json(self) -> str:
        """Write the document of :meth:`to_yaml` as JSON."""
        return json.dumps(self._document(), indent=2)

    def _document(self) -> dict[str, Any]:
        x, y, z = _plain(self.transform[:3, 3])
        turn = dict(zip("xyzw", _plain(matrices_to_quaternions(self.transform[:3, :3])), strict=True))
        return {
            "header": {"frame_id": self.frame_id},
            "child_frame_id": self.task,
            "transform": {"translation": {"x": x, "y": y, "z": z}, "rotation": turn},
            "constraint": self.constraint,
            "valid": self.validity,
            "control": {
                "frame": self.task,
                "order": ["x", "y", "z", "rx", "ry", "rz"],
                "motion_selection": [int(free) for free in self.free],
                "force_selection": [int(not free) for free in self.free],
                "stiffness": _plain(self.stiffness),
                "stiffness_units": ["N/m"] * 3 + ["N m/rad"] * 3,
            },
        }


def to_task_frame(
    found: Identification | ConstraintFrame,
    pose: "ArrayLike",
    *,
    ground: str = "ground",
    body: str = "body",
    task: str = "task",
    stiff: tuple[float, float] = (1000.0, 50.0),
    soft: tuple[float, float] = (100.0, 5.0),
) -> TaskFrame:
    """Return the task frame of a constraint while the body is at a pose.

    One frame serves both constraints if their distinct axes are parallel or perpendicular. The distinct axis
    of a frame is its single free or single constrained axis. Deviations up to 15 degrees count as estimation
    errors; the task frame then keeps the linear axes.

    The pose (4, 4) of {b} in {g} is in m. If the whole frame is fixed in one body, every pose gives the same
    task frame. The stiffnesses, N/m and N m/rad, are ``stiff`` along and about free axes, which the
    controller moves, and ``soft`` along and about constrained axes, which the contact holds. ``ground``,
    ``body`` and ``task`` are the names of {g}, {b} and the frame.

    Raises:
        ValueError: for a batch; a window without a result; a screw or universal joint; a matrix that is no
            pose; a stiffness that is negative or not finite; axes neither parallel nor perpendicular.
    """
    if isinstance(found, Identification):
        if np.shape(found.status_code) == () and found.status.failed:
            raise ValueError(f"There is no task frame: {found.status.message}")
        if np.isfinite(found.pitch).any() or np.isfinite(found.universal_axes).any():
            raise ValueError(f"{found.name} couples its axes; no selection of axes expresses it.")
        name, frame = found.name, found.constraint_frame
    else:
        key = found.linear_type, found.angular_dof, found.linear_dof
        entry = lookup(*key)
        name, frame = describe(*key) if entry is None else entry.name, found
    if np.shape(frame.position) != (3,):
        raise ValueError(f"Expected a single frame, not a batch of shape {np.shape(frame.position)[:-1]}.")
    there = np.asarray(pose, float)
    if there.shape != (4, 4):
        raise ValueError(f"Expected a finite pose of shape (4, 4), not one of shape {there.shape}.")
    if not is_rigid(there):
        raise ValueError(f"Expected a finite pose that is a rigid transform, not {there.tolist()}.")
    both = np.array([stiff, soft], float)
    if both.shape != (2, 2) or not ((both >= 0) & np.isfinite(both)).all():
        raise ValueError(f"Expected two stiffnesses that are 0 or more, not {stiff} and {soft}.")
    located: Any = locate_on_host(frame, there[None])
    axes, turns, turned = _common_axes(frame, located.angular_axes[0], located.linear_axes[0])
    placed = np.eye(4)
    placed[:3, :3], placed[:3, 3] = axes, there[:3, 3] + located.lever[0]
    angular_on_body, linear_on_body, point_on_body = fixed_on_body(frame)
    # without a distinct axis, the orientation is arbitrary and fixed in no body
    fixed = {"origin": point_on_body}
    fixed |= {"linear axes": linear_on_body} if distinct_axis(frame.linear_dof) is not None else {}
    fixed |= {"angular axes": angular_on_body} if distinct_axis(frame.angular_dof) is not None else {}
    names = {True: body, False: ground}
    if len(set(fixed.values())) == 1:
        frame_id = names[point_on_body]
        placed = np.linalg.inv(there) @ placed if point_on_body else placed
        validity = f"Valid at every pose: the frame is fixed in {frame_id}."
    else:
        frame_id = ground
        parts = ", ".join(f"{part} in {names[on_body]}" for part, on_body in fixed.items())
        validity = f"Valid at one pose of {body} only. Fixed are: {parts}."
    free = np.array([*frame.linear_dof, *turns], bool)
    stiffness = np.where(free, np.repeat(both[0], 3), np.repeat(both[1], 3))
    return TaskFrame(name, frame_id, task, placed, validity, free, stiffness, turned)


def _common_axes(
    frame: ConstraintFrame, angular: np.ndarray, linear: np.ndarray
) -> tuple[np.ndarray, tuple[int, ...], float]:
    """Common axes of both constraints, the free rotations about them, and the correction in degrees."""
    place, turning = distinct_axis(frame.linear_dof), distinct_axis(frame.angular_dof)
    if place is None or turning is None:
        return angular if place is None else linear, frame.angular_dof, 0.0
    own, other = linear[:, place], angular[:, turning]
    cosine = float(own @ other)
    angle = float(np.degrees(np.arccos(min(1.0, abs(cosine)))))
    relation = relation_of_cosine(cosine)
    if relation == AxisRelation.OBLIQUE:
        raise ValueError(
            f"No task frame serves both constraints: the angle between the angular and the linear axes is "
            f"{angle:.0f} degrees, neither parallel nor perpendicular."
        )
    if relation == AxisRelation.PERPENDICULAR:
        # the linear frame may be turned about its distinct axis without any change of the constraint
        across = other - own * cosine
        across /= np.linalg.norm(across)
        linear = np.roll(np.stack([own, across, np.cross(own, across)], axis=1), place, axis=1)
        place = (place + 1) % 3
    kind = frame.angular_dof[turning]
    turns = tuple(kind if index == place else 1 - kind for index in range(3))
    return linear, turns, min(angle, 90 - angle)


def _plain(values: np.ndarray) -> list[float]:
    """Round numbers to 9 decimals, without negative zeros."""
    return [float(value) + 0.0 for value in np.round(values, 9)]


def _yaml_lines(value: dict[str, Any], indent: str = "") -> list[str]:
    lines = []
    for name, item in value.items():
        if isinstance(item, dict):
            lines += [f"{indent}{name}:", *_yaml_lines(item, indent + "  ")]
        else:
            lines.append(f"{indent}{name}: {_yaml(item)}")
    return lines


def _yaml(item: Any) -> str:
    """Format a list, number or text in one line; no exponents, because YAML 1.1 reads them as text."""
    if isinstance(item, list):
        return f"[{', '.join(map(_yaml, item))}]"
    return f"{item:.9f}" if isinstance(item, float) else json.dumps(item)

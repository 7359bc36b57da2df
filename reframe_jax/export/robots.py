"""Helpers of the robot description writers: names, numbers, placeholder masses, and checks."""

from xml.etree import ElementTree

import numpy as np

from reframe_jax.geometry.numpy_rotations import matrices_to_quaternions
from reframe_jax.joints.chain import JointPart
from reframe_jax.joints.joint import Joint

LINK_MASS_FRACTION = 1e-3  # fraction of the mass, for each link between two parts of a chain
RADIUS = 0.1  # m, radius of the sphere that gives the placeholder inertia


def check_writable(joint: Joint, language: str, mass: float = 1.0) -> None:
    """Raise a ValueError for a joint that ``language`` cannot express, or a mass, kg, that is not > 0."""
    if not 0 < mass < np.inf:
        raise ValueError(f"Expected a positive mass in kg, not {mass}.")
    if joint.type == "floating":
        raise ValueError(f"There is no joint to write as {language}: {joint.child} moves freely.")
    if not joint.is_chain:
        raise ValueError(f"{language} cannot express {joint.name!r}. {' '.join(joint.gauge)}")


def is_endless(part: JointPart) -> bool:
    """Return whether a hinge has no limits, because it made a full turn; a screw always has limits."""
    return part.kind == "hinge" and not part.pitch and part.high - part.low >= 2 * np.pi


def part_names(joint: Joint) -> list[str]:
    """Name each part after the child and its kind, with a number if several parts have the same kind."""
    kinds = [part.kind for part in joint.parts]
    numbers = [
        f"_{kinds[: i + 1].count(kind)}" if kinds.count(kind) > 1 else "" for i, kind in enumerate(kinds)
    ]
    return [f"{joint.child}_{kind}{number}" for kind, number in zip(kinds, numbers, strict=True)]


def sphere_inertia(mass: float) -> dict[str, float]:
    """Moments and products of inertia in kg m^2 of a solid sphere of 0.1 m radius, by name."""
    moment = 0.4 * mass * RADIUS**2
    return {"ixx": moment, "iyy": moment, "izz": moment, "ixy": 0.0, "ixz": 0.0, "iyz": 0.0}


def remarks(joint: Joint) -> str:
    """Return lines for the comment at the head: the constraint, the fit error, and the arbitrary choices."""
    bodies = f"{joint.child} in {joint.parent}"
    lines = [f"{joint.name}, identified by reframe_jax from recorded poses of {bodies}."]
    position, rotation = 1e3 * joint.position_error, np.degrees(joint.rotation_error)
    lines.append(f"RMS distance from the recording: {position:.2g} mm, {rotation:.2g} deg.")
    if joint.parts:
        lines.append("The limits are the recorded range.")
    placeholder = "Poses do not determine the mass and the inertia: a solid sphere serves as a placeholder."
    return "\n".join(f"  {line}" for line in (*lines, *joint.gauge, placeholder)).replace("--", "- -")


def _format(value: str | float | np.ndarray) -> str:
    """Format numbers with ten digits, separated by spaces, without negative zeros."""
    if isinstance(value, str):
        return value
    return " ".join(f"{number + 0.0:.10g}" for number in np.atleast_1d(np.round(value, 12)))


def quaternion_wxyz(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion (4,) of a rotation matrix (3, 3), in the order w, x, y, z."""
    return np.roll(matrices_to_quaternions(rotation), 1)


def roll_pitch_yaw(rotation: np.ndarray) -> np.ndarray:
    """Return angles (3,), rad, about the fixed axes x, y, z in this order; yaw is 0 at a pitch of 90 deg."""
    cosine = np.hypot(rotation[0, 0], rotation[1, 0])
    pitch = np.arctan2(-rotation[2, 0], cosine)
    if cosine < 1e-9:
        return np.array([np.arctan2(-rotation[1, 2], rotation[1, 1]), pitch, 0.0])
    roll = np.arctan2(rotation[2, 1], rotation[2, 2])
    return np.array([roll, pitch, np.arctan2(rotation[1, 0], rotation[0, 0])])


def element(
    parent: ElementTree.Element,
    tag: str,
    text: str | float | np.ndarray = "",
    **attributes: str | float | np.ndarray,
) -> ElementTree.Element:
    """Append an XML element with a text or numbers, and attributes, to its parent; return the element."""
    made = ElementTree.SubElement(parent, tag, {name: _format(value) for name, value in attributes.items()})
    made.text = _format(text)
    return made


def to_text(root: ElementTree.Element, joint: Joint) -> str:
    """Return an indented XML document with the remarks as a comment at its head."""
    root.insert(0, ElementTree.Comment(f"\n{remarks(joint)}\n  "))
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"

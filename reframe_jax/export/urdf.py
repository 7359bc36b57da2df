"""Write a joint as URDF."""

from xml.etree import ElementTree

import numpy as np

from reframe_jax.export import robots
from reframe_jax.export.robots import element
from reframe_jax.joints.chain import JointPart
from reframe_jax.joints.joint import Joint

_EFFORT, _VELOCITY = "1000", "10"  # N or N m, m/s or rad/s: the format requires numbers
_NO_LENGTH = 1e-9  # m or rad, smaller offsets are omitted


def to_urdf(joint: Joint, *, mass: float = 1.0) -> str:
    """Return a joint as a URDF document.

    The links are the parent, the child, and one link for every part of the joint between them, with the axes
    of the parent. A cylindrical joint is a slide and a hinge. A planar joint is two slides and a hinge,
    because the URDF type ``planar`` does not specify whether the child may turn. A screw joint is a hinge and
    a slide that mimics the hinge. Three hinges replace a ball; ``joint.without_balls()`` has the same
    coordinates as the file. Every moving link has an ``inertial`` element, which MuJoCo requires; a
    compiler flag keeps fixed links in MuJoCo. A hinge that made a full turn in the recording is
    ``continuous``. Arguments and errors as in :func:`to_mjspec`; a ValueError is also raised for a ball whose
    rotations come near the gimbal lock of three hinges.
    """
    robots.check_writable(joint, "URDF", mass)
    try:
        joint = joint.without_balls()
    except ValueError as error:
        raise ValueError(f"URDF has no ball joint. {error} Write MJCF or SDF.") from None
    robot = ElementTree.Element("robot", name=f"{joint.parent}_{joint.child}")
    element(element(robot, "mujoco"), "compiler", fusestatic="false", discardvisual="false")
    element(robot, "link", name=joint.parent)
    last, place = joint.parent, np.zeros(3)
    for name, part in zip(robots.part_names(joint), joint.parts, strict=True):
        _add_part(robot, name, part, last, place, mass)
        last, place = f"{name}_link", part.point
        if part.pitch:
            low, high = sorted((part.pitch * part.low, part.pitch * part.high))
            slide = JointPart("slide", part.axis, part.point, low, high)
            thread = f"{joint.child}_slide"
            made = _add_part(robot, thread, slide, last, place, mass)
            element(made, "mimic", joint=name, multiplier=part.pitch, offset="0")
            last = f"{thread}_link"
    mount = element(robot, "joint", name=f"{joint.child}_fixed", type="fixed")
    _add_origin(mount, joint.home[:3, 3] - place, robots.roll_pitch_yaw(joint.home[:3, :3]))
    element(mount, "parent", link=last)
    element(mount, "child", link=joint.child)
    _add_link(robot, joint.child, mass)
    return robots.to_text(robot, joint)


def _add_part(
    robot: ElementTree.Element, name: str, part: JointPart, last: str, place: np.ndarray, mass: float
) -> ElementTree.Element:
    """Add a hinge or slide, and its link, to a link whose origin has a given position in the parent."""
    kind = "prismatic" if part.kind == "slide" else "continuous" if robots.is_endless(part) else "revolute"
    made = element(robot, "joint", name=name, type=kind)
    _add_origin(made, part.point - place, np.zeros(3))
    element(made, "parent", link=last)
    element(made, "child", link=f"{name}_link")
    element(made, "axis", xyz=part.axis)
    limits = {} if robots.is_endless(part) else {"lower": part.low, "upper": part.high}
    element(made, "limit", effort=_EFFORT, velocity=_VELOCITY, **limits)
    _add_link(robot, f"{name}_link", robots.LINK_MASS_FRACTION * mass)
    return made


def _add_link(robot: ElementTree.Element, name: str, mass: float) -> None:
    """Add a link with the inertia of a sphere at its origin."""
    inertial = element(element(robot, "link", name=name), "inertial")
    element(inertial, "mass", value=mass)
    element(inertial, "inertia", **robots.sphere_inertia(mass))


def _add_origin(joint: ElementTree.Element, place: np.ndarray, angles: np.ndarray) -> None:
    if np.abs([*place, *angles]).max() > _NO_LENGTH:
        element(joint, "origin", xyz=place, rpy=angles)

"""Write a joint as SDF (SDFormat)."""

from xml.etree import ElementTree

import numpy as np

from reframe_jax.export import robots
from reframe_jax.export.robots import element
from reframe_jax.joints.joint import Joint

_KINDS = {"hinge": "revolute", "slide": "prismatic", "ball": "ball"}
_MODEL = "__model__"  # the frame of the model, which coincides with the parent


def to_sdf(joint: Joint, *, mass: float = 1.0) -> str:
    """Return a joint as an SDF 1.9 document with one model; a screw joint needs SDF 1.10.

    The links are the parent (fixed to the world), the child, and one link between any two parts of the joint.
    A cylindrical joint is a chain of a slide and a hinge; a planar joint is a chain of two slides and a
    hinge. SDF has no limits for balls. Arguments and errors as in :func:`to_mjspec`.
    """
    robots.check_writable(joint, "SDF", mass)
    root = ElementTree.Element("sdf", version="1.10" if joint.type == "screw" else "1.9")
    model = element(root, "model", name=f"{joint.parent}_{joint.child}")
    _add_link(model, joint.parent, np.zeros(6), mass)
    _add_joint(model, f"{joint.parent}_fixed", "fixed", "world", joint.parent)
    place = np.concatenate([joint.home[:3, 3], robots.roll_pitch_yaw(joint.home[:3, :3])])
    names = robots.part_names(joint)
    links = [*(f"{name}_link" for name in names[:-1]), joint.child]
    last = joint.parent
    for name, part, link in zip(names, joint.parts, links, strict=bool(names)):
        at_point = np.concatenate([part.point, np.zeros(3)])
        if link == joint.child:
            _add_link(model, link, place, mass)
        else:
            _add_link(model, link, at_point, robots.LINK_MASS_FRACTION * mass)
        kind = "continuous" if robots.is_endless(part) else "screw" if part.pitch else _KINDS[part.kind]
        made = _add_joint(model, name, kind, last, link)
        element(made, "pose", at_point, relative_to=_MODEL)
        if part.kind != "ball":
            axis = element(made, "axis")
            element(axis, "xyz", part.axis, expressed_in=_MODEL)
            if not robots.is_endless(part):
                limit = element(axis, "limit")
                element(limit, "lower", part.low)
                element(limit, "upper", part.high)
        if part.pitch:  # m per revolution, positive if right-handed
            element(made, "screw_thread_pitch", 2 * np.pi * part.pitch)
        last = link
    if not names:
        _add_link(model, joint.child, place, mass)
        _add_joint(model, f"{joint.child}_fixed", "fixed", joint.parent, joint.child)
    return robots.to_text(root, joint)


def _add_joint(
    model: ElementTree.Element, name: str, kind: str, parent: str, child: str
) -> ElementTree.Element:
    made = element(model, "joint", name=name, type=kind)
    element(made, "parent", parent)
    element(made, "child", child)
    return made


def _add_link(model: ElementTree.Element, name: str, place: np.ndarray, mass: float) -> None:
    """Add a link at a pose (x, y, z, roll, pitch, yaw) in the model, with the inertia of a sphere."""
    link = element(model, "link", name=name)
    element(link, "pose", place)
    inertial = element(link, "inertial")
    element(inertial, "mass", mass)
    inertia = element(inertial, "inertia")
    for entry, value in robots.sphere_inertia(mass).items():
        element(inertia, entry, value)

"""A joint as MJCF, through MuJoCo's own model editor."""

from typing import TYPE_CHECKING

import numpy as np

from reframe_jax.export.robots import (
    RADIUS,
    check_mass,
    check_writable,
    is_endless,
    part_names,
    quaternion_wxyz,
    remarks,
)
from reframe_jax.joints.joint import Joint

if TYPE_CHECKING:
    import mujoco

__all__ = ["to_mjcf", "to_mjspec"]

_PALE = (0.5, 0.5, 0.5, 0.3)


def to_mjcf(joint: Joint, *, mass: float = 1.0) -> str:
    """Return a joint as an MJCF document; arguments and errors as in :func:`to_mjspec`."""
    spec = to_mjspec(joint, mass=mass)
    spec.compile()
    text: str = spec.to_xml()
    head = "\n".join(f"  {line}" for line in remarks(joint)).replace("--", "- -")
    return f"<!--\n{head}\n-->\n{text}"


def to_mjspec(joint: Joint, *, mass: float = 1.0) -> "mujoco.MjSpec":
    """Return a joint as a MuJoCo model to edit: attach it to a scene, or compile it.

    The parent is a body at the origin of the world, the child a body in it with all parts of the joint, and
    a sphere of 0.1 m radius that touches nothing;
    ``qpos`` are the joint's coordinates, but for a ball a quaternion in the axes of the child: that of the
    rotation vector ``joint.home[:3, :3].T @ coordinates``. Angles are radians. A screw joint is a hinge and a
    slide that an equality constraint couples to it; ``qpos`` has both.

    Args:
        joint: from :meth:`Identification.to_joint`. The limits are its recorded range; a hinge seen to make
            a full turn has none.
        mass: kg, of the child's sphere; poses do not tell masses.

    Raises:
        ValueError: for a contact that leaves every pose within reach, or a free body; or a mass that is not
            positive.
    """
    import mujoco  # takes a third of a second

    check_mass(mass)
    check_writable(joint, "MJCF")
    kinds = {
        "hinge": mujoco.mjtJoint.mjJNT_HINGE,
        "slide": mujoco.mjtJoint.mjJNT_SLIDE,
        "ball": mujoco.mjtJoint.mjJNT_BALL,
    }
    spec = mujoco.MjSpec()
    spec.modelname = f"{joint.parent}_{joint.child}"
    spec.compiler.degree = False
    spec.compiler.autolimits = False
    parent = spec.worldbody.add_body(name=joint.parent)
    rotation, origin = joint.home[:3, :3], joint.home[:3, 3]
    child = parent.add_body(name=joint.child, pos=origin, quat=quaternion_wxyz(rotation))
    sphere = mujoco.mjtGeom.mjGEOM_SPHERE
    child.add_geom(type=sphere, size=(RADIUS, 0, 0), mass=mass, contype=0, conaffinity=0, rgba=_PALE)
    for name, part in zip(part_names(joint), joint.parts, strict=True):
        axis = (0.0, 0.0, 1.0) if part.kind == "ball" else rotation.T @ part.axis
        child.add_joint(
            name=name,
            type=kinds[part.kind],
            axis=axis,
            pos=rotation.T @ (part.point - origin),
            limited=not is_endless(part),
            range=(part.low, part.high),
        )
        if part.pitch:
            slide = f"{joint.child}_slide"
            child.add_joint(name=slide, type=kinds["slide"], axis=axis)
            thread = np.zeros(mujoco.mjNEQDATA)
            thread[1] = part.pitch  # the slide is this polynomial of the turn
            joints = mujoco.mjtObj.mjOBJ_JOINT
            spec.add_equality(
                name=f"{joint.child}_thread",
                type=mujoco.mjtEq.mjEQ_JOINT,
                objtype=joints,
                name1=slide,
                name2=name,
                data=thread,
            )
    return spec

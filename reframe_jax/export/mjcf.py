"""Write a joint as MJCF with MuJoCo's model editor."""

from typing import TYPE_CHECKING, get_args

import numpy as np

from reframe_jax.export import robots
from reframe_jax.joints.chain import PartKind
from reframe_jax.joints.joint import Joint

if TYPE_CHECKING:
    import mujoco

_PALE = (0.5, 0.5, 0.5, 0.3)


def to_mjcf(joint: Joint, *, mass: float = 1.0) -> str:
    """Return a joint as an MJCF document; arguments and errors as in :func:`to_mjspec`."""
    spec = to_mjspec(joint, mass=mass)
    spec.compile()
    return f"<!--\n{robots.remarks(joint)}\n-->\n{spec.to_xml()}"


def to_mjspec(joint: Joint, *, mass: float = 1.0) -> "mujoco.MjSpec":
    """Return a joint as an editable MuJoCo model, to attach to a scene or to compile.

    The parent is a body at the origin of the world. The child is a body inside the parent, with all parts of
    the joint and a sphere of 0.1 m radius without collisions. ``qpos`` holds the coordinates of the joint, in
    radians and metres. For a ball, ``qpos`` holds a quaternion in the axes of the child; its rotation vector
    is ``joint.home[:3, :3].T @ coordinates``. A screw joint becomes a hinge and a slide, which an equality
    constraint couples; ``qpos`` has both.

    Args:
        joint: from :meth:`Identification.to_joint`. The limits are the recorded range; a hinge that made a
            full turn in the recording has no limits.
        mass: kg, mass of the child's sphere; poses do not determine masses.

    Raises:
        ValueError: for a contact that allows every pose, for a free body, or for a mass that is not positive.
    """
    import mujoco  # the import takes a third of a second

    robots.check_writable(joint, "MJCF", mass)
    kinds = {kind: getattr(mujoco.mjtJoint, f"mjJNT_{kind.upper()}") for kind in get_args(PartKind)}
    spec = mujoco.MjSpec()
    spec.modelname = f"{joint.parent}_{joint.child}"
    spec.compiler.degree = False
    spec.compiler.autolimits = False
    parent = spec.worldbody.add_body(name=joint.parent)
    rotation, origin = joint.home[:3, :3], joint.home[:3, 3]
    child = parent.add_body(name=joint.child, pos=origin, quat=robots.quaternion_wxyz(rotation))
    sphere = mujoco.mjtGeom.mjGEOM_SPHERE
    child.add_geom(type=sphere, size=(robots.RADIUS, 0, 0), mass=mass, contype=0, conaffinity=0, rgba=_PALE)
    for name, part in zip(robots.part_names(joint), joint.parts, strict=True):
        axis = (0.0, 0.0, 1.0) if part.kind == "ball" else rotation.T @ part.axis
        child.add_joint(
            name=name,
            type=kinds[part.kind],
            axis=axis,
            pos=rotation.T @ (part.point - origin),
            limited=not robots.is_endless(part),
            range=(part.low, part.high),
        )
        if part.pitch:
            slide = f"{joint.child}_slide"
            child.add_joint(name=slide, type=kinds["slide"], axis=axis)
            thread = np.zeros(mujoco.mjNEQDATA)
            thread[1] = part.pitch  # coefficient of the polynomial that gives the slide from the hinge angle
            coupled = spec.add_equality(name=f"{joint.child}_thread", name1=slide, name2=name, data=thread)
            coupled.type, coupled.objtype = mujoco.mjtEq.mjEQ_JOINT, mujoco.mjtObj.mjOBJ_JOINT
    return spec

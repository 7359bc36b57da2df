"""Appearance of the arm in a film: primitive shapes, or meshes of the user.

The library contains no meshes. A skin is a MuJoCo model of the user, such as MuJoCo Menagerie's ``panda.xml``
or ``fr3.xml``, or a folder of meshes with names such as ``link0.stl`` and ``hand_1.obj``. A skin changes the
film only, not the simulation.
"""

from pathlib import Path

import mujoco
import numpy as np

from reframe_jax.simulation.arm.model import Arm, arm_xml

__all__ = ["apply_skin"]

_MESHES = (".stl", ".obj", ".msh")
_PARTS = (*(f"link{number}" for number in range(8)), "hand")
_TOLERANCE = 1e-3  # m, largest distance between the joints of a skin and of the arm


def apply_skin(arm: Arm, skin: str | Path | None = None) -> mujoco.MjSpec:
    """Build the model to render; its first seven joints are the joints of the arm.

    Args:
        arm: the robot.
        skin: an MJCF file of the same robot, or a folder of meshes in metres, each in the frame of its
            link: ``link0`` to ``link7`` and ``hand``, or several meshes per link (``link0_1``), as .stl, .obj
                or .msh. Links without a mesh keep their primitive shapes.

    Raises:
        ValueError: if the file does not exist or is not a model, if a mesh is missing, or for another robot.
    """
    if skin is None:
        return mujoco.MjSpec.from_string(arm_xml(arm))
    skin = Path(skin)
    if skin.is_dir():
        return _with_meshes(arm, skin)
    if not skin.is_file():
        raise ValueError(f"No skin at {skin}: expected an MJCF file, or a folder of meshes.")
    try:
        spec = mujoco.MjSpec.from_file(str(skin))
        model = spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise ValueError(f"The skin {skin} cannot be loaded: {error}") from error
    _check(arm, model, skin)
    return spec


def _with_meshes(arm: Arm, folder: Path) -> mujoco.MjSpec:
    """Replace the primitive shapes of the arm by meshes."""
    spec = mujoco.MjSpec.from_string(arm_xml(arm))
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in _MESHES)
    used = 0
    for part in _PARTS:
        mine = [file for file in files if file.stem == part or file.stem.startswith(f"{part}_")]
        body = spec.body(part) if part != "link0" else spec.worldbody
        if mine:
            for shape in body.geoms:
                spec.delete(shape)
        for file in mine:
            spec.add_mesh(name=file.stem, file=str(file.resolve()))
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=file.stem,
                contype=0,
                conaffinity=0,
                mass=0,
                rgba=[0.9, 0.9, 0.9, 1],
            )
        used += len(mine)
    if not used:
        raise ValueError(
            f"No meshes in {folder}: expected {_PARTS[0]} to {_PARTS[7]} or {_PARTS[8]}, "
            f"as {', '.join(_MESHES)}."
        )
    try:
        spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise ValueError(f"The meshes of {folder} cannot be loaded: {error}") from error
    return spec


def _check(arm: Arm, model: mujoco.MjModel, skin: Path) -> None:
    """Check that the first seven joints of the skin coincide with the joints of the arm."""
    hinge = int(mujoco.mjtJoint.mjJNT_HINGE)
    if model.njnt < 7 or np.any(model.jnt_type[:7] != hinge):
        raise ValueError(f"The first seven joints of the skin {skin} must be hinges, as in the {arm.name}.")
    own = mujoco.MjModel.from_xml_string(arm_xml(arm))
    for joints in (np.zeros(7), np.asarray(arm.home)):
        anchors = []
        for robot in (model, own):
            data = mujoco.MjData(robot)
            data.qpos[:7] = joints
            mujoco.mj_kinematics(robot, data)
            anchors.append(data.xanchor[:7].copy())
        away = np.linalg.norm(anchors[0] - anchors[1], axis=-1)
        if away.max() > _TOLERANCE:
            raise ValueError(
                f"The skin {skin} is another robot, or has another pose: its joint {away.argmax() + 1} is "
                f"{1e3 * away.max():.0f} mm from the joint of the {arm.name}."
            )

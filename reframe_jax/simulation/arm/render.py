"""Render films of the arm offscreen with MuJoCo; needs the extra ``render`` and OpenGL (EGL or OSMesa)."""

import importlib
import os
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from reframe_jax.constraints.frame import ConstraintFrame, locate_on_host
from reframe_jax.geometry.transforms import make_pose
from reframe_jax.simulation.arm.model import PANDA, Arm, find_arm, forward_kinematics

_FREE = (0.0, 0.45, 0.70, 1.0)
_CONSTRAINED = (0.84, 0.37, 0.0, 1.0)
_TOOL = (0.35, 0.35, 0.35, 1.0)
_PATH = (0.0, 0.62, 0.45, 0.8)
_LENGTH = 0.14  # m, length of the drawn axes
_SCENE = """<asset>
<texture type="skybox" builtin="gradient" rgb1="1 1 1" rgb2=".8 .86 .92" width="32" height="192"/>
<texture name="floor" type="2d" builtin="checker" rgb1=".92 .92 .92" rgb2=".86 .86 .86"
  width="256" height="256"/>
<material name="floor" texture="floor" texrepeat="8 8"/>
</asset><visual>
<headlight ambient=".35 .35 .35" diffuse=".25 .25 .25" specular="0 0 0"/>
<global offwidth="1920" offheight="1080"/>
</visual><worldbody>
<geom type="plane" size="2 2 .1" material="floor" contype="0" conaffinity="0"/>"""


class RenderError(RuntimeError):
    """Rendering is impossible on this machine; the message names the missing software."""


def film_frames(
    joints: Any,
    truth: ConstraintFrame | None = None,
    *,
    arm: str | Arm = PANDA,
    size: tuple[int, int] = (480, 368),
) -> np.ndarray:
    """Render pictures of the arm at joint positions, with the constraint frame and the path of the TCP.

    Free axes of the frame are blue, constrained axes orange: short bars for the linear frame, a disc for
    a free rotation. A grey rod leads from the hand to the origin of the frame.

    The joint positions (K, 7), rad, are those of one demonstration. The constraint has a geometry (3,); None
    draws only the arm. The size is width and height in pixels, up to 1920 x 1080; multiples of 16 for MP4.
    The result is (K, height, width, 3) uint8. A RenderError is raised if OpenGL is not available.
    """
    arm = find_arm(arm)
    joints = np.asarray(joints, dtype=float)
    model = mujoco.MjModel.from_xml_string(arm.xml.replace("<worldbody>", _SCENE))
    data = mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = (0.25, 0, 0.36), 1.35, 135, -18
    rotations, positions = forward_kinematics(jnp.asarray(joints), arm)
    path = np.asarray(positions)
    located = None if truth is None else locate_on_host(truth, np.asarray(make_pose(rotations, positions)))
    pictures = []
    with _renderer(model, size) as renderer:
        for number, row in enumerate(joints):
            data.qpos[:7] = row
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            for before, after in pairwise(path[: number + 1]):
                _bar(renderer.scene, before, after, 0.003, _PATH)
            if truth is not None:
                there = jax.tree.map(lambda leaf, i=number: leaf[i], located)
                _draw_frame(renderer.scene, truth, there, path[number])
            pictures.append(renderer.render())
    return np.stack(pictures)


def save_film(path: str | Path, pictures: np.ndarray, *, rate: float = 20.0) -> None:
    """Write pictures (K, height, width, 3), uint8, as an animated GIF or as MP4, with a rate per second.

    A ValueError is raised for another suffix, a RenderError if the extra ``render`` is not installed.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".gif", ".mp4"):
        raise ValueError(f"A film must end in .gif or .mp4, not {path.name!r}.")
    try:
        if suffix == ".gif":
            from PIL import Image

            # one palette for all pictures and no dithering, so that static parts do not flicker
            some = np.concatenate(pictures[:: max(1, len(pictures) // 4)])
            palette = Image.fromarray(some).quantize(256, Image.Quantize.MAXCOVERAGE)
            no_dither = Image.Dither.NONE
            frames = [Image.fromarray(each).quantize(palette=palette, dither=no_dither) for each in pictures]
            options: dict[str, Any] = {"append_images": frames[1:], "duration": round(1000 / rate), "loop": 0}
            frames[0].save(path, save_all=True, **options)
        else:
            import imageio

            imageio.mimwrite(path, list(pictures), fps=rate)
    except ImportError as error:
        raise RenderError(f"{suffix} films need: pip install 'reframe-jax[render]' ({error}).") from error


def _renderer(model: mujoco.MjModel, size: tuple[int, int]) -> Any:
    """Create an offscreen renderer, with EGL if there is no display and no other backend is set."""
    from mujoco.rendering.classic import gl_context

    try:
        if sys.platform == "linux" and not {"MUJOCO_GL", "DISPLAY"} & os.environ.keys():
            os.environ["MUJOCO_GL"] = "egl"
            try:
                importlib.reload(gl_context)  # the module chooses its backend at the first import
            finally:
                del os.environ["MUJOCO_GL"]
        return mujoco.Renderer(model, size[1], size[0])
    except (mujoco.FatalError, ImportError, AttributeError, RuntimeError, OSError) as error:
        raise RenderError(
            f"OpenGL cannot render without a screen ({error}): install EGL or OSMesa, and set MUJOCO_GL to "
            "egl or osmesa."
        ) from error


def _draw_frame(scene: Any, truth: ConstraintFrame, located: Any, place: np.ndarray) -> None:
    """Draw a frame, located while the TCP is at a place (3,), and a rod from the TCP to its origin."""
    origin = place + located.lever
    _bar(scene, place, origin, 0.006, _TOOL)
    for axis, free in zip(_LENGTH * located.linear_axes.T, truth.linear_dof, strict=True):
        _bar(scene, origin - axis, origin + axis, 0.004, _FREE if free else _CONSTRAINED)
    for axis, free in zip(0.002 * located.angular_axes.T, truth.angular_dof, strict=True):
        if free:
            disc = mujoco.mjtGeom.mjGEOM_CYLINDER
            _bar(scene, origin - axis, origin + axis, 0.045, (*_FREE[:3], 0.35), disc)


def _bar(
    scene: Any, start: Any, end: Any, radius: float, colour: Any, kind: Any = mujoco.mjtGeom.mjGEOM_CAPSULE
) -> None:
    if scene.ngeom >= scene.maxgeom:
        return
    geom = scene.geoms[scene.ngeom]
    rgba = np.asarray(colour, dtype=np.float32)
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), rgba)
    mujoco.mjv_connector(geom, kind, radius, np.asarray(start, float), np.asarray(end, float))
    scene.ngeom += 1

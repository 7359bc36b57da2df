"""Draw the pictures of the documentation and the README: ``python docs/pictures.py``."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

import reframe_jax as rf
from reframe_jax import plotting
from reframe_jax.constraints.catalogue import OTHER_CONSTRAINTS
from reframe_jax.constraints.frame import locate_on_host
from reframe_jax.geometry import rotations
from reframe_jax.joints.chain import JointPart, chain_poses
from reframe_jax.plotting.style import BODY, FREE, TURNING, axis_colours, new_figure
from reframe_jax.simulation import synthetic

ROOT = Path(__file__).parent.parent
IMAGES = ROOT / "docs" / "images"
COLOURS = {"GG": "#E69F00", "GB": "#009E73", "BG": "#D55E00", "BB": "#0072B2"}


def pin_on_plane() -> None:
    """Draw the recording of the README."""
    recording = rf.load_recording(ROOT / "examples" / "pin_on_plane.csv")
    found = rf.identify(recording.poses, times=recording.times)
    title = f"{recording.path.name}: {found.name}"  # title of the command line
    figure = plotting.plot_identification(recording.poses, found, times=recording.times, title=title)
    figure.savefig(IMAGES / "pin_on_plane.png", metadata={"Software": None})


def conventions() -> None:
    """Draw the four linear frame types of one motion, at two instants."""
    figure = new_figure(8, 5.6)
    poses = np.tile(np.eye(4), (2, 1, 1))
    turns = jax.jit(rotations.rotation_exp)(jnp.asarray([[0.0, 0.0, 0.2], [0.0, 0.0, 1.1]]))
    poses[:, :3, :3] = np.asarray(turns)
    poses[:, :2, 3] = [[0.15, 0.25], [0.6, 0.45]]
    axes_at, place_in_body, place_in_ground = np.eye(3), np.array([0.1, -0.2, 0]), np.array([0.33, 0.05, 0])
    for number, kind in enumerate(rf.LinearType):
        axes: Any = figure.add_subplot(2, 2, number + 1)
        _arrows(axes, np.zeros(2), np.eye(2), 0.13, "black", "{g}", 1.0)
        for pose, strength in zip(poses, (0.5, 1.0), strict=True):
            turn, shift = pose[:3, :3], pose[:3, 3]
            corners = np.array([[-0.09, -0.06], [0.15, -0.06], [0.15, 0.06], [-0.09, 0.06], [-0.09, -0.06]])
            outline = corners @ turn[:2, :2].T + shift[:2]
            axes.fill(*outline.T, color=BODY, alpha=0.3 * strength)
            _arrows(axes, shift[:2], turn[:2, :2], 0.1, BODY, "{b}", strength)
            on_body = kind.name[1] == "B"
            origin = turn @ place_in_body + shift if on_body else place_in_ground
            frame = turn @ axes_at if kind.name[0] == "B" else axes_at
            foot = shift if on_body else np.zeros(3)
            axes.plot(*np.stack([foot, origin])[:, :2].T, ":", color="black", linewidth=1.6, alpha=strength)
            _arrows(axes, origin[:2], frame[:2, :2], 0.14, COLOURS[kind.name], "", strength, 3.0)
        names = {"G": "ground", "B": "body"}
        axes.set_title(
            f"{kind}: axes fixed in the {names[kind.name[0]]},\norigin fixed in the {names[kind.name[1]]}",
            fontsize=15,
        )
        axes.set_aspect("equal")
        axes.set_xlim(-0.1, 1.08)
        axes.set_ylim(-0.08, 0.72)
        axes.axis("off")
    figure.savefig(IMAGES / "conventions.png", metadata={"Software": None})


def _arrows(
    axes: Any,
    origin: np.ndarray,
    directions: np.ndarray,
    length: float,
    colour: str,
    name: str,
    strength: float,
    width: float = 1.8,
) -> None:
    """Draw two axes of a frame in the plane; the columns are their directions."""
    for direction in directions.T:
        axes.annotate(
            "",
            origin + length * direction,
            origin,
            arrowprops={"arrowstyle": "->", "color": colour, "lw": width, "alpha": strength},
        )
    axes.plot(*origin, "o", color=colour, markersize=3, alpha=strength)
    if name:
        axes.text(*(origin - 0.055), name, fontsize=14, alpha=strength, ha="center")


EXCITED = 0.8  # s, duration of the motion in a picture of the gallery
MOTIONS = {"G": 0.5, "H": 0.5}  # s, shorter for constraints with large rotations


def gallery() -> None:
    """Draw every named constraint: the body at three instants of a simulated motion, and its frame."""
    for label in (*rf.CONSTRAINTS, *OTHER_CONSTRAINTS):
        figure = new_figure(4.2, 3.9)
        figure.set_layout_engine("none")
        _draw_constraint(figure.add_axes((0.0, 0.06, 0.9, 0.94), projection="3d"), label)
        figure.savefig(IMAGES / f"gallery_{label}.png", dpi=110, metadata={"Software": None})


def _draw_constraint(axes: Any, label: str) -> None:
    made = synthetic.simulate(label, jax.random.key(0), duration=MOTIONS.get(label, EXCITED), dt=0.02)
    poses, truth = np.asarray(made.exact_poses, float), made.truth
    if label == "universal":
        poses = _universal_poses(np.asarray(made.times))
    there = locate_on_host(truth, poses)
    origins = poses[:, :3, 3] + there.lever
    points = np.concatenate([poses[:, :3, 3], origins])
    low, high = points.min(axis=0), points.max(axis=0)
    size = max(float((high - low).max()), 0.3)
    axes.plot(*poses[:, :3, 3].T, color=BODY, linewidth=1.5)
    axes.plot(*origins.T, ":", color="black", linewidth=2.5)
    for sample, strength in ((0, 0.3), (len(poses) // 2, 0.55), (-1, 1.0)):
        _draw_box(axes, poses[sample], strength)
        ends = np.stack([poses[sample, :3, 3], origins[sample]])
        axes.plot(*ends.T, color=BODY, linewidth=3, alpha=strength)
        axes.plot(*origins[sample][:, None], "o", color="black", markersize=5, alpha=strength)
    turning = there.angular_axes[-1].copy()
    if label == "universal":
        turning[:, 0] = (1, 0, 0)  # fixed in the ground; the other axis is fixed in the body
    _draw_axes(axes, origins[-1], 0.4 * size, there.linear_axes[-1], truth.linear_dof)
    for free, axis in zip(np.asarray(truth.angular_dof), turning.T, strict=True):
        if free:
            ends = origins[-1] + np.array([[-0.45], [0.45]]) * size * axis
            axes.plot(*ends.T, "-.", color=TURNING, linewidth=2.4)
    for i, name in enumerate("xyz"):
        getattr(axes, f"set_{name}lim")(*((low + high)[i] / 2 + 0.58 * size * np.array([-1, 1])))
        getattr(axes, f"set_{name}label")(f"{name} [m]", fontsize=15, labelpad=4)
        axes.locator_params(axis=name, nbins=3, prune="lower" if name == "y" else None)
        axes.tick_params(axis=name, labelsize=13, pad=5 if name == "z" else 0)
    axes.zaxis.labelpad = 9
    axes.set_box_aspect((1, 1, 1), zoom=0.82)


def _draw_axes(axes: Any, origin: np.ndarray, length: float, triad: np.ndarray, dof: Any) -> None:
    """Draw the linear frame, and a square in the plane of two free translations."""
    free = np.asarray(dof, bool)
    if free.sum() == 2:
        first, second = 0.9 * length * triad.T[free]
        corners = [origin + a * first + b * second for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        axes.add_collection3d(Poly3DCollection([corners], color=FREE[1], alpha=0.2, linewidth=0))
    for each, axis, colour in zip(free, triad.T, axis_colours(free), strict=True):
        if each:
            axes.quiver(*origin, *(length * axis), color=colour, linewidth=3.5, arrow_length_ratio=0.25)
        else:
            ends = np.stack([origin, origin + length * axis])
            axes.plot(*ends.T, "--", color=colour, linewidth=3.5)


def _universal_poses(times: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) of a body on two hinges: about x of the ground, then about y of the body."""
    hinges = [JointPart("hinge", np.eye(3)[axis], np.array([0.1, 0.3, 0.1])) for axis in (0, 1)]
    return chain_poses(hinges, np.eye(4), np.stack([0.7 * times, 0.8 * times], axis=1))


def _draw_box(axes: Any, pose: np.ndarray, strength: float) -> None:
    """Draw the body, a box of 12 by 8 by 4 cm about the origin of {b}."""
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * (0.06, 0.04, 0.02)
    placed = corners @ pose[:3, :3].T + pose[:3, 3]
    faces = [
        placed[list(face)]
        for face in ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))
    ]
    axes.add_collection3d(
        Poly3DCollection(faces, facecolor=BODY, edgecolor="black", linewidth=0.6, alpha=0.5 * strength)
    )


if __name__ == "__main__":
    IMAGES.mkdir(exist_ok=True)
    pin_on_plane()
    conventions()
    gallery()

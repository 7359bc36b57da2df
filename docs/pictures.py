"""Draws the pictures of the documentation and the README: ``python docs/pictures.py``."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import reframe_jax as rf
from reframe_jax import plotting
from reframe_jax.geometry import rotations
from reframe_jax.plotting.style import BODY, new_figure

ROOT = Path(__file__).parent.parent
IMAGES = ROOT / "docs" / "images"
COLOURS = {"GG": "#E69F00", "GB": "#009E73", "BG": "#D55E00", "BB": "#0072B2"}


def pin_on_plane() -> None:
    """The recording of the README."""
    recording = rf.load_recording(ROOT / "examples" / "pin_on_plane.csv")
    found = rf.identify(recording.poses, times=recording.times)
    title = f"{recording.path.name}: {found.name}"  # as the command line draws it
    figure = plotting.plot_identification(recording.poses, found, times=recording.times, title=title)
    figure.savefig(IMAGES / "pin_on_plane.png", metadata={"Software": None})


def conventions() -> None:
    """The four linear frame types of one motion, at two instants."""
    figure = new_figure(9.6, 2.5)
    poses = np.tile(np.eye(4), (2, 1, 1))
    turns = jax.jit(rotations.rotation_exp)(jnp.asarray([[0.0, 0.0, 0.2], [0.0, 0.0, 1.1]]))
    poses[:, :3, :3] = np.asarray(turns)
    poses[:, :2, 3] = [[0.15, 0.25], [0.6, 0.45]]
    axes_at, place_in_body, place_in_ground = np.eye(3), np.array([0.1, -0.2, 0]), np.array([0.33, 0.05, 0])
    for number, kind in enumerate(rf.LinearType):
        axes: Any = figure.add_subplot(1, 4, number + 1)
        _arrows(axes, np.zeros(2), np.eye(2), 0.13, "black", "{g}", 1.0)
        for pose, strength in zip(poses, (0.45, 1.0), strict=True):
            turn, shift = pose[:3, :3], pose[:3, 3]
            corners = np.array([[-0.09, -0.06], [0.15, -0.06], [0.15, 0.06], [-0.09, 0.06], [-0.09, -0.06]])
            outline = corners @ turn[:2, :2].T + shift[:2]
            axes.fill(*outline.T, color=BODY, alpha=0.3 * strength)
            _arrows(axes, shift[:2], turn[:2, :2], 0.1, BODY, "{b}", strength)
            on_body = kind.name[1] == "B"
            origin = turn @ place_in_body + shift if on_body else place_in_ground
            frame = turn @ axes_at if kind.name[0] == "B" else axes_at
            foot = shift if on_body else np.zeros(3)
            axes.plot(*np.stack([foot, origin])[:, :2].T, ":", color="black", linewidth=0.8, alpha=strength)
            _arrows(axes, origin[:2], frame[:2, :2], 0.14, COLOURS[kind.name], "", strength, 2.0)
        names = {"G": "ground", "B": "body"}
        axes.set_title(
            f"{kind}: axes fixed in the {names[kind.name[0]]},\norigin in the {names[kind.name[1]]}",
            fontsize=8,
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
    width: float = 1.2,
) -> None:
    """Two axes of a frame in the plane; the columns are their directions."""
    for direction in directions.T:
        axes.annotate(
            "",
            origin + length * direction,
            origin,
            arrowprops={"arrowstyle": "->", "color": colour, "lw": width, "alpha": strength},
        )
    axes.plot(*origin, "o", color=colour, markersize=3, alpha=strength)
    if name:
        axes.text(*(origin - 0.055), name, fontsize=7, alpha=strength, ha="center")


if __name__ == "__main__":
    IMAGES.mkdir(exist_ok=True)
    pin_on_plane()
    conventions()

"""Animate a recording: the body moves along its path, with its constraint frame."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.constraints.types import AngularType
from reframe_jax.identification.results import Identification
from reframe_jax.plotting.scene import (
    check_window,
    draw_arm,
    draw_frame,
    frame_length,
    frames_in_ground,
    segment,
    set_limits,
    track,
)
from reframe_jax.plotting.style import BODY, new_figure

if TYPE_CHECKING:
    from matplotlib.animation import FuncAnimation

__all__ = ["animate_scene", "gif"]


def animate_scene(
    poses: ArrayLike, found: Identification, *, times: ArrayLike, frames: int = 40, title: str | None = None
) -> "FuncAnimation":
    """Animate one window.

    Save the animation with ``.save("out.gif", writer="pillow")``, or use :func:`gif` in a notebook. The
    animation leaves out poses that the identification left out as outliers.

    Args:
        poses: (K+1, 4, 4), m.
        found: identification of these poses.
        times: (K+1,) s; the animation runs in real time.
        frames: number of pictures.
        title: title of the figure, by default the name of the constraint.

    Raises:
        ValueError: for a batch, or a window without a result.
    """
    figure = new_figure(4.4, 4.4)
    host = check_window(found)
    kept = np.flatnonzero(host.counted)
    poses, times = np.asarray(poses), np.asarray(times)
    poses, times = poses.take(kept, axis=0), times.take(kept)
    from matplotlib.animation import FuncAnimation
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    shown = np.linspace(0, len(poses) - 1, frames).round().astype(int)
    every = frames_in_ground(poses, host, shown)
    axes: Any = figure.add_subplot(projection="3d")
    path = poses[:, :3, 3]
    origins = track(poses, host)
    points = np.concatenate([path, origins])
    on_body = host.linear.frame_type.position_body == AngularType.B
    length = frame_length(points)

    def draw_sample(number: int) -> list[Any]:
        axes.clear()
        here = shown[number]
        axes.plot(*path.T, color=BODY, linewidth=0.8, alpha=0.5)
        axes.plot(*path[: here + 1].T, color=BODY, linewidth=1.6)
        for axis in poses[here, :3, :3].T:
            segment(axes, path[here], path[here] + 0.6 * length * axis, color=BODY, linewidth=1.4)
        if on_body:
            draw_arm(axes, path, origins, np.array([here]))
        origin, triad, turning = (part[number] for part in every)
        draw_frame(axes, origin, length * triad, length * turning, host.linear.dof, 1.0)
        set_limits(axes, points)
        axes.set_box_aspect((1, 1, 1), zoom=0.9)  # a larger zoom cuts off the label of z
        axes.set_title(f"{host.name if title is None else title}, t = {times[here]:.2f} s", fontsize=9)
        return []

    pace = 1e3 * (times[-1] - times[0]) / max(frames - 1, 1)
    return FuncAnimation(figure, draw_sample, frames=frames, interval=pace, blit=False)


def gif(animation: "FuncAnimation") -> bytes:
    """Encode an animation as a GIF, for ``IPython.display.Image`` or a file; viewing it needs no network."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "animation.gif"
        animation.save(path, writer="pillow", dpi=100)
        return path.read_bytes()

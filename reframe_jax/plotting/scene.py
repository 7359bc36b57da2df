"""The body, its path and the constraint frame in space."""

from typing import TYPE_CHECKING, Any

import numpy as np

from reframe_jax.constraints.frame import locate_on_host
from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.identification.results import Identification
from reframe_jax.plotting.style import (
    BODY,
    CONSTRAINED,
    FONT,
    FREE,
    LEGEND_ABOVE,
    OUTLIERS,
    TURNING,
    axis_colours,
)

if TYPE_CHECKING:
    from mpl_toolkits.mplot3d.axes3d import Axes3D


def draw_space(axes: "Axes3D", poses: np.ndarray, found: Identification) -> None:
    """Draw path and axes of the body, the frame, a legend, and the outliers inside the picture.

    A frame that is fixed in the ground is drawn once, others at the first, middle and last pose. An origin
    that is fixed in the body has a dotted path, and a line from the body.
    """
    counted = np.asarray(found.counted)
    out, poses = poses[~counted, :3, 3], poses[counted]
    path, last = poses[:, :3, 3], len(poses) - 1
    located: Any = locate_on_host(found.constraint_frame, poses)
    origins = path + located.lever
    kind, points = found.linear.frame_type, np.concatenate([path, origins])
    length = 0.22 * _size(points)
    axes.plot(*path.T, color=BODY, linewidth=1.2, label="path and axes of the body")
    shown = [(len(poses) // 2, 1.0)]
    if kind != LinearType.GG:
        shown = [(0, 0.35), (len(poses) // 2, 0.6), (last, 1.0)]  # palest first
    if kind.position_body == AngularType.B:
        axes.plot(*origins.T, ":", color="black", linewidth=1.0, label="path of the frame's origin")
        for sample, _ in shown:
            segment(axes, path[sample], origins[sample], color=BODY, linewidth=2.2, alpha=0.45)
    for pose in poses[np.linspace(0, last, 5).astype(int)]:
        for axis in pose[:3, :3].T:
            segment(axes, pose[:3, 3], pose[:3, 3] + 0.4 * length * axis, color=BODY, linewidth=0.8)
    turns = turning_axes(found.angular.dof)
    for sample, alpha in shown:
        triad, turning = located.linear_axes[sample], located.angular_axes[sample].T[turns]
        draw_frame(axes, origins[sample], length * triad, length * turning, found.linear.dof, alpha)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    near = out[(np.abs(out - centre) < _size(points) / 2).all(axis=1)]
    if len(out):
        axes.plot(*near.T, linestyle="none", **OUTLIERS)
    draw_legend(axes, kind, found.linear.dof, bool(turns.any()))
    set_limits(axes, points)


def turning_axes(dof: Any) -> np.ndarray:
    """Return which angular axes to draw, (3,) bool: the free axes, unless all three are free."""
    return np.asarray(dof, dtype=bool) & (np.sum(dof) < 3)


def _size(points: np.ndarray) -> float:
    return 1.1 * max(float(np.max(np.ptp(points, axis=0))), 0.05)


def set_limits(axes: "Axes3D", points: np.ndarray) -> None:
    """Set equal scales along all axes, with limits that contain the points (N, 3)."""
    centre, size = (points.min(axis=0) + points.max(axis=0)) / 2, _size(points)
    for i, name in enumerate("xyz"):
        getattr(axes, f"set_{name}lim")(centre[i] - size / 2, centre[i] + size / 2)
        getattr(axes, f"set_{name}label")(f"{name} [m]", fontsize=FONT)
        axes.locator_params(axis=name, nbins=4)
    axes.set_box_aspect((1, 1, 1), zoom=1.02)
    axes.tick_params(labelsize=FONT)


def draw_frame(
    axes: "Axes3D", origin: np.ndarray, triad: np.ndarray, turning: np.ndarray, dof: Any, alpha: float
) -> None:
    """Draw the linear frame at one pose, and the free axes of rotation through its origin (3,), m.

    The linear axes are the columns of ``triad`` (3, 3), the free axes of rotation the rows of ``turning``
    (n, 3), with the lengths at which they are drawn, m. The axes are numbered if the opacity ``alpha`` is 1.
    """
    from matplotlib.patheffects import withStroke

    axes.plot(*origin[:, None], "o", color="black", markersize=3, alpha=alpha)
    for axis in turning:
        segment(axes, origin - 1.5 * axis, origin + 1.5 * axis, color=TURNING, linestyle="-.", alpha=alpha)
    for i, (axis, colour) in enumerate(zip(triad.T, axis_colours(dof), strict=True)):
        if dof[i]:
            axes.quiver(*origin, *axis, arrow_length_ratio=0.25, color=colour, linewidth=2.4, alpha=alpha)
        else:
            segment(axes, origin, origin + axis, linestyle="--", color=colour, linewidth=2.4, alpha=alpha)
        if alpha == 1:
            number = axes.text(*(origin + 1.2 * axis), str(i + 1), ha="center", va="center", fontsize=13)
            number.set_path_effects([withStroke(linewidth=3, foreground="white")])


def draw_legend(axes: "Axes3D", kind: LinearType, dof: Any, turns: bool) -> None:
    """Add a legend with the kinds of axes that a linear frame has; ``turns`` adds the axis of rotation."""
    dof = np.asarray(dof)
    for shown, colour, style, label in (
        (turns, TURNING, "-.", "free axis of rotation"),
        ((dof == 1).any(), FREE[0], "-", f"free axis of linear frame {kind}"),
        ((dof == 0).any(), CONSTRAINED[0], "--", f"constrained axis of {kind}"),
    ):
        if shown:
            axes.plot([], [], color=colour, linestyle=style, label=label)
    axes.legend(**LEGEND_ABOVE | {"bbox_to_anchor": (0.52, 1)})


def segment(axes: "Axes3D", start: np.ndarray, end: np.ndarray, **style: Any) -> None:
    """Draw a straight line between two points (3,)."""
    axes.plot(*np.stack([start, end], axis=1), **style)

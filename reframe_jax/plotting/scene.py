"""Constraint frames in space."""

from typing import TYPE_CHECKING, Any

import numpy as np

from reframe_jax.constraints.types import LinearType
from reframe_jax.plotting.style import CONSTRAINED, FONT, FREE, LEGEND_ABOVE, TURNING, axis_colours

if TYPE_CHECKING:
    from mpl_toolkits.mplot3d.axes3d import Axes3D


def turning_axes(dof: Any) -> np.ndarray:
    """Return which angular axes to draw, (3,) bool: the free axes, unless all three are free."""
    return np.asarray(dof, dtype=bool) & (np.sum(dof) < 3)


def scene_size(points: np.ndarray) -> float:
    """Return the length of the edges of a cube around points (N, 3), m."""
    return 1.1 * max(float(np.max(np.ptp(points, axis=0))), 0.05)


def set_limits(axes: "Axes3D", points: np.ndarray) -> None:
    """Set equal scales along all axes, with limits that contain the points (N, 3)."""
    centre, size = (points.min(axis=0) + points.max(axis=0)) / 2, scene_size(points)
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

"""Error bars of a constraint frame: an ellipsoid at its origin, cones on its axes."""

from typing import TYPE_CHECKING

import jax
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.constraints.types import BODY_NAMES
from reframe_jax.export.common import axes_of
from reframe_jax.identification.results import Identification
from reframe_jax.plotting.scene import check_window, draw_space
from reframe_jax.plotting.style import FONT, LEGEND_ABOVE, TURNING, axis_colours, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d.axes3d import Axes3D

    from reframe_jax.uncertainty.covariance import Covariance

__all__ = ["plot_uncertainty"]

_INTERVAL = 1.96  # standard deviations of a 95 % interval
_ELLIPSOID = 2.795  # standard deviations of a 95 % ellipsoid in three dimensions
_LINES = 25  # points of a circle


def plot_uncertainty(
    poses: ArrayLike, found: Identification, covariance: "Covariance", *, title: str | None = None
) -> "Figure":
    """Draw the uncertainty of a frame: the scene, the origin enlarged, and the tilts of the axes.

    The first panel is the scene of :func:`plot_identification`. The second panel shows the 95 % ellipsoid of
    the origin, which is flat along directions in which the origin is arbitrary. The panel below shows 95 %
    cones of the distinct axes in cross section. The distinct axis of a frame is its single free or single
    constrained axis.

    Args:
        poses: (K+1, 4, 4), m.
        found: identification of these poses.
        covariance: the covariance of ``found``.
        title: title of the figure, by default the name of the constraint.

    Raises:
        ValueError: for a batch, or a window without a result.
    """
    host = check_window(found)
    covariance = jax.device_get(covariance)
    figure = new_figure(10, 9.2)
    figure.suptitle(host.name if title is None else title, fontsize=14)
    grid = figure.add_gridspec(2, 2, height_ratios=(1.25, 1))
    draw_space(figure.add_subplot(grid[0, 0], projection="3d"), np.asarray(poses), host)
    _draw_origin(figure.add_subplot(grid[0, 1], projection="3d"), host, covariance)
    _draw_tilts(figure.add_subplot(grid[1, :]), host, covariance)
    return figure


def _draw_origin(axes: "Axes3D", found: Identification, covariance: "Covariance") -> None:
    """Draw the ellipsoid of the origin and the directions of the linear axes, in mm."""
    body = BODY_NAMES[found.linear.frame_type.position_body]
    variances, directions = np.linalg.eigh(1e6 * np.asarray(covariance.position))
    deviations = np.sqrt(np.maximum(variances, 0))
    intervals = ", ".join(f"{_INTERVAL * each:.2g}" for each in deviations[::-1])
    axes.set_title(f"origin in the {body}: ± {intervals} mm (95 %)", fontsize=FONT, pad=46)
    radii = _ELLIPSOID * deviations
    size = 1.15 * float(radii[-1])
    if not 0 < size < np.inf:
        axes.text2D(0.5, 0.5, "any origin is equally valid", transform=axes.transAxes, ha="center")
        axes.set_axis_off()
        return
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, _LINES), np.linspace(0, np.pi, _LINES), indexing="ij")
    ball = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)])
    surface = np.einsum("ij,jkl->ikl", directions * radii, ball)
    axes.plot_surface(*surface, color=TURNING, alpha=0.25, linewidth=0)
    axes.plot_wireframe(*surface, color=TURNING, linewidth=0.4, rstride=4, cstride=4, label="95 % ellipsoid")
    for direction, radius in zip(directions.T, radii, strict=True):
        if radius > 0.01 * size:
            ends = np.outer([-1, 1], radius * direction)
            axes.plot(*ends.T, color="black", linewidth=0.9)
    axes.plot([0], [0], [0], "o", color="black", markersize=3)
    for name in "xyz":
        getattr(axes, f"set_{name}lim")(-size, size)
        getattr(axes, f"set_{name}label")(f"{name} [mm]", fontsize=FONT)
        axes.locator_params(axis=name, nbins=5)
    axes.plot([], [], color="black", linewidth=0.9, label="its principal axes")
    axes.set_box_aspect((1, 1, 1))
    axes.tick_params(labelsize=FONT)
    axes.legend(**LEGEND_ABOVE | {"ncols": 1})


def _draw_tilts(axes: "Axes", found: Identification, covariance: "Covariance") -> None:
    """Draw the 95 % cones of the distinct axes in cross section: the tilts of each axis in degrees."""
    angle = np.linspace(0, 2 * np.pi, 4 * _LINES)
    circle = np.sqrt(5.991) * np.stack([np.cos(angle), np.sin(angle)])  # 95 % in two dimensions
    largest = 0.0
    for name, frame, matrix, colour in (
        ("angular", found.angular, covariance.angular_axes, TURNING),
        ("linear", found.linear, covariance.linear_axes, axis_colours(found.linear.dof)[0]),
    ):
        number = int(np.sum(frame.dof))
        if number not in (1, 2):
            continue
        distinct = 2 if number == 1 else 0
        triad = np.asarray(axes_of(frame.rotvec))
        across = np.delete(triad, distinct, axis=1)
        turns = across.T @ np.asarray(matrix) @ across
        quarter_turn = np.array(
            [[0.0, 1.0], [-1.0, 0.0]]
        )  # a rotation about one normal moves the tip along the other normal
        variances, directions = np.linalg.eigh(quarter_turn @ turns @ quarter_turn.T)
        tip = np.degrees((directions * np.sqrt(np.maximum(variances, 0))) @ circle)
        freedom = "free" if number == 1 else "constrained"
        axes.plot(*tip, color=colour, label=f"axis {distinct + 1} of the {name} frame, {freedom}")
        axes.fill(*tip, color=colour, alpha=0.15)
        largest = max(largest, float(np.max(np.abs(tip))))
    axes.axhline(0, color="black", linewidth=0.5)
    axes.axvline(0, color="black", linewidth=0.5)
    axes.set_title("error of the direction of the single free or constrained axis", fontsize=FONT, pad=28)
    axes.set_xlabel("tilt [degrees], 95 %", fontsize=FONT)
    axes.set_ylabel("tilt [degrees], 95 %", fontsize=FONT)
    if largest > 0:
        axes.set_xlim(-1.2 * largest, 1.2 * largest)
        axes.set_ylim(-1.2 * largest, 1.2 * largest)
        axes.legend(**LEGEND_ABOVE)
    else:
        axes.text(
            0.5,
            0.6,
            "no axis is distinct: all are free or all are constrained",
            transform=axes.transAxes,
            ha="center",
        )
    axes.set_aspect("equal")
    axes.tick_params(labelsize=FONT)

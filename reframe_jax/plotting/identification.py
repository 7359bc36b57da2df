"""Picture of one window: its frame in space, and the velocities along the axes."""

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.identification.classify import Thresholds
from reframe_jax.identification.results import Identification
from reframe_jax.identification.velocities import frame_velocities
from reframe_jax.motion.kinematics import Discretization
from reframe_jax.plotting.scene import check_window, draw_space
from reframe_jax.plotting.style import LEGEND_ABOVE, NOT_READ, OUTLIERS, axis_colours, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["plot_identification"]


def plot_identification(
    poses: ArrayLike,
    found: Identification,
    *,
    times: ArrayLike,
    thresholds: Thresholds | None = None,
    discretization: Discretization = "chord",
    title: str | None = None,
    left_out: ArrayLike = (),
) -> "Figure":
    """Draw one window: its linear frame in space, and the velocities along the axes.

    On the left the path of the body in the ground, with the linear frame and the free axes of rotation
    through its origin. What is fixed in the body is drawn at the first, the middle and the last pose, the
    first one palest; an origin that is fixed there is joined to the body, and its path is dotted. Free axes
    are arrows, constrained axes dashed lines without a head. On the right the velocities of single steps
    along the axes of both frames over time. Outliers, which took no part, are crosses in space and along the
    time axis; the path leaves them out. Rows that were left out when the file was read are bars along the
    time axis.

    Args:
        poses: (K+1, 4, 4), m.
        found: identification of these poses.
        times: (K+1,) s.
        thresholds: those it was made with, drawn as lines; none by default.
        discretization: the one it was made with.
        title: of the figure, by default the name of the constraint.
        left_out: (M,) s, when rows were that were not read: ``left_out_times`` of a recording.

    Returns:
        A new figure that ``pyplot`` does not know: display it in a notebook, or call ``figure.savefig(...)``.

    Raises:
        ImportError: if Matplotlib is not installed.
        ValueError: for a batch, or a window without a result.
    """
    figure = new_figure(9, 5.6)
    host = check_window(found)
    poses, times = np.asarray(poses), np.asarray(times)
    steps = jnp.asarray(np.diff(times))
    velocities = frame_velocities(jnp.asarray(poses), steps, found, discretization)
    angular, linear = jax.device_get(velocities)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.15, 1), wspace=0.08)
    figure.suptitle(host.name if title is None else title, fontsize=12)
    draw_space(figure.add_subplot(grid[:, 0], projection="3d"), poses, host)
    middle = (times[1:] + times[:-1]) / 2
    top, bottom = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1])
    limits = (None, None) if thresholds is None else (float(thresholds.linear), float(thresholds.angular))
    _draw_velocities(top, middle, linear, host.linear.dof, limits[0], "m/s")
    _draw_velocities(bottom, middle, angular, host.angular.dof, limits[1], "rad/s")
    for when, style in ((times[~np.asarray(host.counted)], OUTLIERS), (np.asarray(left_out), NOT_READ)):
        for graph in (top, bottom) if len(when) else ():
            along = graph.get_xaxis_transform()
            graph.plot(when, np.full(len(when), 0.03), transform=along, **style)
    if np.size(left_out):
        named = [line for line in top.lines if not str(line.get_label()).startswith("_")]
        top.legend(handles=named, **LEGEND_ABOVE)
    top.set_ylabel(f"velocity of the origin, {host.linear.frame_type} [m/s]", fontsize=8)
    bottom.set_ylabel(f"angular velocity, {host.angular.frame_type} [rad/s]", fontsize=8)
    bottom.set_xlabel("time [s]", fontsize=8)
    return figure


def _draw_velocities(
    axes: "Axes", times: np.ndarray, velocities: np.ndarray, dof: Any, threshold: float | None, unit: str
) -> None:
    rms = np.sqrt(np.nanmean(velocities**2, axis=0))
    lines = []
    for i, colour in enumerate(axis_colours(dof)):
        label = f"axis {i + 1}, {'free' if dof[i] else 'constrained'}: rms {rms[i]:.3g} {unit}"
        # slower axes on top
        lines += axes.plot(
            times, velocities[:, i], color=colour, linewidth=1.1, label=label, zorder=2 - rms[i]
        )
    if threshold is not None:
        for level in (-threshold, threshold):
            limit = axes.axhline(level, color="black", linestyle="--", linewidth=0.8)
        limit.set_label(f"threshold {threshold:g} {unit}")
        lines.append(limit)
    axes.margins(x=0)
    axes.tick_params(labelsize=8)
    axes.legend(handles=lines, **LEGEND_ABOVE)

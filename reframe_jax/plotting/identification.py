"""Picture of one window: its frame in space, and the amplitudes and velocities along its axes."""

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.constraints.frame import locate_on_host
from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.export.common import format_probability
from reframe_jax.identification.classify import Thresholds
from reframe_jax.identification.frames import AngularFrame, LinearFrame
from reframe_jax.identification.results import Identification, check_single
from reframe_jax.identification.velocities import frame_velocities
from reframe_jax.joints.joint import two_digits
from reframe_jax.motion.kinematics import Discretization
from reframe_jax.plotting.scene import draw_frame, draw_legend, scene_size, segment, set_limits, turning_axes
from reframe_jax.plotting.style import BODY, FONT, LEGEND_ABOVE, NOT_READ, OUTLIERS, axis_colours, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d.axes3d import Axes3D


def plot_identification(
    poses: "ArrayLike",
    found: Identification,
    *,
    times: "ArrayLike",
    thresholds: Thresholds | None = None,
    discretization: Discretization = "chord",
    title: str | None = None,
    left_out: "ArrayLike" = (),
) -> "Figure":
    """Draw one window: its linear frame in space, and the amplitudes and velocities along the axes.

    The left panel shows the path of the body in the ground, with the linear frame and the free axes of
    rotation through its origin. Axes and origins that are fixed in the body are drawn at the first, middle
    and last pose, palest at the first. A line connects the body with an origin that is fixed in the body; the
    path of this origin is dotted. Free axes are arrows, constrained axes are dashed lines without a head.

    The right panels show the amplitude of every axis (RMS displacement, logarithmic) with the probability
    that the axis is free. Below are the velocities along the axes over time, from pairs of consecutive poses,
    in the colours of the bars. Outliers are crosses in space and along the time axis, and not part of the
    path. Rows that were left out when the file was read are short lines along the time axis, at the times
    ``left_out`` (M,), s: ``left_out_times`` of a recording.

    The poses (K+1, 4, 4), m, at the times (K+1,), s, are those that were identified, with the same
    discretization and thresholds, which are drawn as lines. By default, the title is the name of the
    constraint. A ValueError is raised for a batch, or a window without a result.
    """
    figure = new_figure(10, 7.2)
    figure.set_layout_engine("none")
    check_single(found)
    if found.status.failed:
        raise ValueError(f"There is nothing to draw: {found.status.message}")
    host = jax.device_get(found)
    poses, times = np.asarray(poses), np.asarray(times)
    velocities = frame_velocities(jnp.asarray(poses), jnp.asarray(np.diff(times)), found, discretization)
    angular, linear = jax.device_get(velocities)
    figure.suptitle(host.name if title is None else title, fontsize=15)
    _draw_space(figure.add_axes((-0.02, 0.06, 0.5, 0.74), projection="3d"), poses, host)
    middle = (times[1:] + times[:-1]) / 2
    limits = (None, None) if thresholds is None else (float(thresholds.linear), float(thresholds.angular))
    left, width = 0.62, 0.36
    top, bottom = figure.add_axes((left, 0.325, width, 0.2)), figure.add_axes((left, 0.08, width, 0.2))
    _draw_velocities(top, middle, linear, host.linear.dof, limits[0], "m/s")
    _draw_velocities(bottom, middle, angular, host.angular.dof, limits[1], "rad/s")
    top.tick_params(labelbottom=False)
    _draw_amplitudes(figure.add_axes((left, 0.81, width, 0.11)), host.linear, "translation along", "mm")
    _draw_amplitudes(figure.add_axes((left, 0.615, width, 0.11)), host.angular, "rotation about", "mrad")
    for when, style in ((times[~np.asarray(host.counted)], OUTLIERS), (np.asarray(left_out), NOT_READ)):
        for graph in (top, bottom) if len(when) else ():
            along = graph.get_xaxis_transform()
            graph.plot(when, np.full(len(when), 0.03), transform=along, linestyle="none", **style)
    if np.size(left_out):
        named = [line for line in top.lines if not str(line.get_label()).startswith("_")]
        top.legend(handles=named, **LEGEND_ABOVE)
    top.set_ylabel(f"velocity of the\norigin, {host.linear.frame_type} [m/s]", fontsize=FONT)
    bottom.set_ylabel(f"angular velocity,\n{host.angular.frame_type} [rad/s]", fontsize=FONT)
    bottom.set_xlabel("time [s]", fontsize=FONT)
    return figure


def _draw_space(axes: "Axes3D", poses: np.ndarray, found: Identification) -> None:
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
    length = 0.22 * scene_size(points)
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
    near = out[(np.abs(out - centre) < scene_size(points) / 2).all(axis=1)]
    if len(out):
        axes.plot(*near.T, linestyle="none", **OUTLIERS)
    draw_legend(axes, kind, found.linear.dof, bool(turns.any()))
    set_limits(axes, points)


def _draw_amplitudes(axes: "Axes", frame: AngularFrame | LinearFrame, motion: str, unit: str) -> None:
    """Draw a bar for every axis, with the probability that the axis is free."""
    amplitude = np.maximum(1e3 * np.asarray(frame.amplitude, dtype=float), 1e-6)
    start = 10 ** np.floor(np.log10(amplitude.min()) - 1)
    places = np.arange(1, 4)
    axes.barh(places, amplitude - start, left=start, height=0.7, color=axis_colours(frame.dof))
    axes.set_xscale("log")
    axes.set_xlim(start, start * (amplitude.max() / start) ** 2.3)  # space for the text beside the bars
    decades = 10.0 ** np.arange(np.log10(start), np.log10(amplitude.max()) + 0.01)
    axes.set_xticks(decades, [f"{decade:g}" for decade in decades], minor=False)
    axes.minorticks_off()
    for place, size, probability in zip(places, amplitude, np.asarray(frame.free_probability), strict=True):
        chance = "" if np.isnan(probability) else f", P(free) {format_probability(probability)}"
        text = f" {two_digits(size)} {unit}{chance}"
        axes.text(float(size), float(place), text, va="center", fontsize=FONT)
    names = [f"axis {i}, {'free' if free else 'constrained'}" for i, free in enumerate(frame.dof, 1)]
    axes.set_yticks(places, names)
    axes.invert_yaxis()
    axes.set_xlabel(f"{motion} the axis, RMS [{unit}]", fontsize=FONT)
    axes.tick_params(labelsize=FONT)
    axes.spines[["top", "right"]].set_visible(False)


def _draw_velocities(
    axes: "Axes", times: np.ndarray, velocities: np.ndarray, dof: Any, threshold: float | None, unit: str
) -> None:
    rms = np.sqrt(np.nanmean(velocities**2, axis=0))
    for i, colour in enumerate(axis_colours(dof)):
        label = f"axis {i + 1}, {'free' if dof[i] else 'constrained'}"
        # slower axes on top
        axes.plot(times, velocities[:, i], color=colour, linewidth=1.6, label=label, zorder=2 - rms[i])
    if threshold is not None:
        for level in (-threshold, threshold):
            limit = axes.axhline(level, color="black", linestyle="--", linewidth=0.8)
        limit.set_label(f"threshold {threshold:g} {unit}")
        axes.legend(handles=[limit], loc="upper right", fontsize=FONT, frameon=False)
    axes.margins(x=0)
    axes.tick_params(labelsize=FONT)

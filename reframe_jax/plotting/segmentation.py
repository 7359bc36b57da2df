"""Picture of a sequence of constraints: a time line, and the velocities in the frame of each segment."""

from typing import TYPE_CHECKING

import jax
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.constraints.types import POSITION_BODIES, AngularType
from reframe_jax.plotting.style import CONSTRAINED, FONT, FREE, LEGEND_ABOVE, LINES, new_figure
from reframe_jax.segmentation.cells import path_features
from reframe_jax.segmentation.results import Segmentation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_AT_REST = "#DDDDDD"
_STEPS = 8  # velocities are differences over the motion time divided by this number


def plot_segmentation(poses: "ArrayLike", found: Segmentation, *, title: str | None = None) -> "Figure":
    """Draw a time line of constraints, and the velocities along the axes of the frame of each segment.

    Segments with the same constraint have the same colour; a body at rest is grey. A dark band around each
    boundary is its 95 % interval. Velocities along free axes are blue, along constrained axes orange. The
    poses (N, 4, 4), m, are those that were segmented.
    """
    figure = new_figure(10, 6)
    line, top, bottom = figure.subplots(3, 1, sharex=True, height_ratios=(0.7, 1, 1))
    if title is not None:
        figure.suptitle(title, fontsize=14)
    _draw_line(line, found)
    angular, linear = segment_velocities(np.asarray(poses), found)
    for axes, velocities, group, label in (
        (top, linear, "linear", "velocity of the\norigin [m/s]"),
        (bottom, angular, "angular", "angular velocity\n[rad/s]"),
    ):
        _draw_velocities(axes, found, velocities, group)
        axes.set_ylabel(label, fontsize=FONT)
        axes.tick_params(labelsize=FONT)
        for boundary in found.boundaries:
            axes.axvline(boundary.time, color="black", linewidth=0.6)
    for name, colour in (("free axis", FREE[0]), ("constrained axis", CONSTRAINED[0])):
        top.plot([], [], color=colour, label=name)
    top.legend(**LEGEND_ABOVE)
    bottom.set_xlabel("time [s]", fontsize=FONT)
    bottom.set_xlim(found.times[0], found.times[-1])
    return figure


def _draw_line(axes: "Axes", found: Segmentation) -> None:
    times = found.times
    for number, segment in enumerate(found.segments):
        start, stop = times[segment.start], times[min(segment.stop, len(times) - 1)]
        colour = _AT_REST if segment.resting else LINES[segment.label % len(LINES)]
        axes.barh(0, stop - start, left=start, color=colour, alpha=0.6, height=0.8)
        # names of adjacent segments are at different heights, so that they do not overlap
        axes.text((start + stop) / 2, 0.55 + 0.35 * (number % 2), segment.name, ha="center", fontsize=FONT)
    for boundary in found.boundaries:
        axes.axvspan(times[boundary.earliest], times[boundary.latest], color="black", alpha=0.25, linewidth=0)
    axes.set_ylim(-0.5, 1.3)
    axes.set_yticks([])
    axes.tick_params(labelsize=FONT)


def _draw_velocities(axes: "Axes", found: Segmentation, velocities: np.ndarray, group: str) -> None:
    for segment in found.segments:
        if segment.identification is None:
            continue
        own = slice(segment.start, segment.stop)
        dof = np.asarray(getattr(segment.identification, group).dof)
        # constrained axes on top
        for axis in np.argsort(-dof, kind="stable"):
            colour = FREE[axis] if dof[axis] else CONSTRAINED[axis]
            axes.plot(found.times[own], velocities[own, axis], color=colour, linewidth=1)


def segment_velocities(poses: np.ndarray, found: Segmentation) -> tuple[np.ndarray, np.ndarray]:
    """Compute velocities along the axes of the frame that is valid at each time, from segmented poses.

    These are angular velocities, (N, 3) rad/s, and velocities of the frame's origin, (N, 3) m/s, over an
    eighth of the motion time about each pose. NaN near boundaries and in segments without identification.
    """
    poses = np.asarray(poses, float)
    centre = poses[:, :3, 3].mean(axis=0)
    half = max(1, round(found.motion_time / _STEPS / 2 / float(np.median(np.diff(found.times)))))
    angular, linear = (np.full((len(poses), 3), np.nan) for _ in range(2))
    for segment in found.segments:
        start, stop = segment.start + half, segment.stop - half
        if segment.identification is None or stop <= start:
            continue
        own, times = poses[segment.start : segment.stop], found.times[segment.start : segment.stop]
        shifts, turns = path_features(own[:, :3, :3], own[:, :3, 3] - centre)
        frames = jax.device_get((segment.identification.linear, segment.identification.angular))
        kind = int(frames[0].type_code)
        origin = np.append(1.0, frames[0].position - centre * (POSITION_BODIES[kind] == AngularType.G))
        paths = shifts[kind].reshape(-1, 3, 4) @ origin, turns[int(frames[1].type_code)]
        duration = (times[2 * half :] - times[: -2 * half])[:, None]
        for velocities, path, frame in zip((linear, angular), paths, frames, strict=True):
            along = path @ np.asarray(frame.axes)
            velocities[start:stop] = (along[2 * half :] - along[: -2 * half]) / duration
    return angular, linear

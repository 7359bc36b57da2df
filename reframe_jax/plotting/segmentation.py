"""Picture of a sequence of constraints: which holds when, and the velocities in its frame."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.motion import kinematics
from reframe_jax.plotting.style import CONSTRAINED, FREE, LINES, new_figure
from reframe_jax.segmentation.results import Segmentation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["plot_segmentation"]

_RESTING = "#DDDDDD"


def plot_segmentation(poses: ArrayLike, found: Segmentation, *, title: str | None = None) -> "Figure":
    """Draw a time line of constraints, and below it the velocities along the axes of each one's frames.

    A constraint that comes back has the same colour; rest is grey. A band about each boundary shows where it
    could also be. Velocities along free axes are blue, along constrained axes orange.

    Args:
        poses: (N, 4, 4), those that were segmented; m.
        found: their segmentation.
        title: of the figure; none by default.

    Returns:
        A new figure that ``pyplot`` does not know: display it in a notebook, or call ``figure.savefig(...)``.

    Raises:
        ImportError: if Matplotlib is not installed.
    """
    figure = new_figure(10, 5)
    line, top, bottom = figure.subplots(3, 1, sharex=True, height_ratios=(0.7, 1, 1))
    if title is not None:
        figure.suptitle(title, fontsize=12)
    _draw_line(line, found)
    angular, linear = _velocities(np.asarray(poses, float), found)
    for axes, velocities, group, label in (
        (top, linear, "linear", "velocity of the origin [m/s]"),
        (bottom, angular, "angular", "angular velocity [rad/s]"),
    ):
        _draw_velocities(axes, found, velocities, group)
        axes.set_ylabel(label, fontsize=8)
        axes.tick_params(labelsize=8)
        for boundary in found.boundaries:
            axes.axvline(boundary.time, color="black", linewidth=0.6)
    bottom.set_xlabel("time [s]", fontsize=8)
    bottom.set_xlim(found.times[0], found.times[-1])
    return figure


def _velocities(poses: np.ndarray, found: Segmentation) -> tuple[np.ndarray, np.ndarray]:
    """Velocities (N-1, 3) along the axes of each segment's frames, rad/s and m/s; NaN elsewhere."""
    with jax.enable_x64(True):
        rates, maps = jax.device_get(_maps(jnp.asarray(poses), jnp.diff(jnp.asarray(found.times))))
    angular, linear = (np.full((len(poses) - 1, 3), np.nan) for _ in range(2))
    for segment in found.segments:
        one = segment.identification
        if one is None:
            continue
        own = slice(segment.start, segment.stop - 1)
        angular[own] = rates[int(one.angular.type_code), own] @ np.asarray(one.angular.axes)
        at = maps[int(one.linear.type_code), own]
        velocity = at[..., 0] + at[..., 1:] @ np.asarray(one.linear.position)
        linear[own] = velocity @ np.asarray(one.linear.axes)
    return angular, linear


@jax.jit
def _maps(poses: jax.Array, steps: jax.Array) -> tuple[jax.Array, jax.Array]:
    return kinematics.angular_velocities(poses, steps), kinematics.linear_velocity_maps(poses, steps)


def _draw_line(axes: "Axes", found: Segmentation) -> None:
    times = found.times
    for number, segment in enumerate(found.segments):
        start, stop = times[segment.start], times[min(segment.stop, len(times) - 1)]
        colour = _RESTING if segment.resting else LINES[segment.label % len(LINES)]
        axes.barh(0, stop - start, left=start, color=colour, alpha=0.6, height=0.8)
        # names of neighbours at different heights, so that short segments stay readable
        axes.text((start + stop) / 2, 0.55 + 0.35 * (number % 2), segment.name, ha="center", fontsize=7)
    for boundary in found.boundaries:
        axes.axvspan(times[boundary.earliest], times[boundary.latest], color="black", alpha=0.25, linewidth=0)
    axes.set_ylim(-0.5, 1.3)
    axes.set_yticks([])
    axes.tick_params(labelsize=8)


def _draw_velocities(axes: "Axes", found: Segmentation, velocities: np.ndarray, group: str) -> None:
    middle = (found.times[1:] + found.times[:-1]) / 2
    for segment in found.segments:
        if segment.identification is None:
            continue
        own = slice(segment.start, segment.stop - 1)
        dof = np.asarray(getattr(segment.identification, group).dof)
        # constrained axes on top
        for axis in np.argsort(-dof, kind="stable"):
            colour = FREE[axis] if dof[axis] else CONSTRAINED[axis]
            axes.plot(middle[own], velocities[own, axis], color=colour, linewidth=1)

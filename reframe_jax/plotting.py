"""Pictures of an identification. Needs Matplotlib: ``pip install "reframe-jax[plot]"``."""

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax import rotations
from reframe_jax.classify import Thresholds
from reframe_jax.frames import AngularType
from reframe_jax.kinematics import Discretization
from reframe_jax.report import frame_velocities
from reframe_jax.results import Identification

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d.axes3d import Axes3D

__all__ = ["plot_identification"]

# colours of Okabe & Ito, distinct for every kind of colour vision; the first axis of a kind is darkest
_FREE = ("#0072B2", "#56B4E9", "#00415F")
_CONSTRAINED = ("#D55E00", "#E69F00", "#7F3800")
_TURNING = "#009E73"
_BODY = "#999999"
_LEGEND_ABOVE: dict[str, Any] = {
    "loc": "lower center",
    "bbox_to_anchor": (0.46, 1),
    "ncols": 2,
    "fontsize": 7,
    "frameon": False,
    "columnspacing": 1,
}


def plot_identification(
    poses: Any,
    found: Identification,
    *,
    times: Any,
    thresholds: Thresholds = Thresholds(),  # noqa: B008
    discretization: Discretization = "chord",
    title: str | None = None,
) -> "Figure":
    """Draw one window: where its linear frame is, and how fast it moves along the axes.

    On the left the path of the body in the ground, with the linear frame and the free axes of rotation
    through its origin; what is fixed in the body is drawn at the first, the middle and the last pose,
    the first one palest. Free axes are arrows, constrained axes dashed lines without a head. On the
    right the velocities along the axes of both frames over time, with the thresholds.

    Args:
        poses: (K+1, 4, 4), m.
        found: identification of these poses.
        times: (K+1,) s.
        thresholds: those it was made with.
        discretization: the one it was made with.
        title: of the figure, by default the name of the constraint.

    Returns:
        A figure of its own, unknown to ``pyplot``: show it in a notebook, or ``figure.savefig(...)``.

    Raises:
        ImportError: if Matplotlib is not installed.
        ValueError: for a batch, or a window without a result.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('Plots need Matplotlib: pip install "reframe-jax[plot]".') from error
    if np.shape(found.status_code):
        raise ValueError("A batch has many frames: index one window first, found[i].")
    if found.status.failed:
        raise ValueError(f"There is nothing to draw: {found.status.message}")
    poses, times = np.asarray(poses), np.asarray(times)
    host = jax.device_get(found)
    steps = jnp.asarray(np.diff(times))
    angular, linear = jax.device_get(frame_velocities(jnp.asarray(poses), steps, found, discretization))
    figure = Figure(figsize=(9, 5.6), dpi=150, layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.15, 1), wspace=0.08)
    figure.suptitle(host.name if title is None else title, fontsize=12)
    _draw_space(figure.add_subplot(grid[:, 0], projection="3d"), poses, host)
    middle = (times[1:] + times[:-1]) / 2
    top, bottom = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1])
    _draw_velocities(top, middle, linear, host.linear.dof, float(thresholds.linear), "m/s")
    _draw_velocities(bottom, middle, angular, host.angular.dof, float(thresholds.angular), "rad/s")
    top.set_ylabel(f"velocity of the origin, {host.linear.frame_type} [m/s]", fontsize=8)
    bottom.set_ylabel(f"angular velocity, {host.angular.frame_type} [rad/s]", fontsize=8)
    bottom.set_xlabel("time [s]", fontsize=8)
    return figure


def _colours(dof: Any) -> list[str]:
    """A colour for each axis, of one family per kind."""
    families = {0: iter(_CONSTRAINED), 1: iter(_FREE)}
    return [next(families[int(free)]) for free in dof]


def _draw_velocities(
    axes: "Axes", times: np.ndarray, velocities: np.ndarray, dof: Any, threshold: float, unit: str
) -> None:
    rms = np.sqrt(np.mean(velocities**2, axis=0))
    lines = []
    for i, colour in enumerate(_colours(dof)):
        label = f"axis {i + 1}, {'free' if dof[i] else 'constrained'}: rms {rms[i]:.3g} {unit}"
        # slower axes on top
        lines += axes.plot(
            times, velocities[:, i], color=colour, linewidth=1.1, label=label, zorder=2 - rms[i]
        )
    for level in (-threshold, threshold):
        limit = axes.axhline(level, color="black", linestyle="--", linewidth=0.8)
    limit.set_label(f"threshold {threshold:g} {unit}")
    axes.margins(x=0)
    axes.tick_params(labelsize=8)
    axes.legend(handles=[*lines, limit], **_LEGEND_ABOVE)


def _draw_space(axes: "Axes3D", poses: np.ndarray, found: Identification) -> None:
    path = poses[:, :3, 3]
    origins, triads, rotation_axes = _frames_in_ground(poses, found)
    points = np.concatenate([path, origins])
    low, high = points.min(axis=0), points.max(axis=0)
    size = 1.1 * max(float(np.max(high - low)), 0.05)
    length = 0.22 * size

    axes.plot(*path.T, color=_BODY, linewidth=1.2, label="path and axes of the body")
    for pose in poses[np.linspace(0, len(poses) - 1, 5).astype(int)]:
        for axis in pose[:3, :3].T:
            _segment(axes, pose[:3, 3], pose[:3, 3] + 0.4 * length * axis, color=_BODY, linewidth=0.8)
    palest_first = (0.35, 0.6, 1.0)[-len(origins) :]
    for origin, triad, turning, alpha in zip(origins, triads, rotation_axes, palest_first, strict=True):
        _draw_frame(axes, origin, length * triad, length * turning, found.linear.dof, alpha)
    _draw_legend(axes, found, bool(len(rotation_axes[0])))
    centre = (low + high) / 2
    for i, name in enumerate("xyz"):
        getattr(axes, f"set_{name}lim")(centre[i] - size / 2, centre[i] + size / 2)
        getattr(axes, f"set_{name}label")(f"{name} [m]", fontsize=8)
        axes.locator_params(axis=name, nbins=5)
    axes.set_box_aspect((1, 1, 1), zoom=1.02)
    axes.tick_params(labelsize=7)


def _draw_frame(
    axes: "Axes3D", origin: np.ndarray, triad: np.ndarray, turning: np.ndarray, dof: Any, alpha: float
) -> None:
    """The linear frame at one pose, and the free axes of rotation through its origin."""
    axes.plot(*origin[:, None], "o", color="black", markersize=3, alpha=alpha)
    for axis in turning:
        _segment(axes, origin - 1.5 * axis, origin + 1.5 * axis, color=_TURNING, linestyle="-.", alpha=alpha)
    for i, (axis, colour) in enumerate(zip(triad.T, _colours(dof), strict=True)):
        if dof[i]:
            axes.quiver(*origin, *axis, arrow_length_ratio=0.25, color=colour, linewidth=1.8, alpha=alpha)
        else:
            _segment(axes, origin, origin + axis, linestyle="--", color=colour, linewidth=1.8, alpha=alpha)
        if alpha == 1:
            axes.text(*(origin + 1.15 * axis), str(i + 1), color=colour, ha="center", va="center")


def _draw_legend(axes: "Axes3D", found: Identification, turns: bool) -> None:
    kind, dof = found.linear.frame_type, np.asarray(found.linear.dof)
    for shown, colour, style, label in (
        (turns, _TURNING, "-.", "free axis of rotation"),
        ((dof == 1).any(), _FREE[0], "-", f"free axis of linear frame {kind}"),
        ((dof == 0).any(), _CONSTRAINED[0], "--", f"constrained axis of {kind}"),
    ):
        if shown:
            axes.plot([], [], color=colour, linestyle=style, label=label)
    axes.legend(**_LEGEND_ABOVE)


def _segment(axes: "Axes3D", start: np.ndarray, end: np.ndarray, **style: Any) -> None:
    axes.plot(*np.stack([start, end], axis=1), **style)


def _frames_in_ground(poses: np.ndarray, found: Identification) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The frames in the ground, at one pose if the linear one is fixed there, else at three.

    Returns:
        Origins (n, 3); axes of the linear frame (n, 3, 3), as columns; directions (n, m, 3) of the m free
        axes of rotation, none of them if all three are free.
    """
    kind = found.linear.frame_type
    in_ground = kind.orientation_body == kind.position_body == AngularType.G
    shown = poses[[len(poses) // 2] if in_ground else [0, len(poses) // 2, -1]]
    turn, shift = shown[:, :3, :3], shown[:, :3, 3]

    def seen(axes: np.ndarray, body: AngularType) -> np.ndarray:
        return turn @ axes if body == AngularType.B else np.broadcast_to(axes, turn.shape)

    position = np.asarray(found.linear.position)
    fixed = kind.position_body == AngularType.G
    origins = np.broadcast_to(position, shift.shape) if fixed else turn @ position + shift
    axes_of = jax.jit(rotations.rotation_exp)
    linear = seen(np.asarray(axes_of(found.linear.rotvec)), kind.orientation_body)
    angular = seen(np.asarray(axes_of(found.angular.rotvec)), found.angular.frame_type)
    free = np.asarray(found.angular.dof, dtype=bool) & (np.sum(found.angular.dof) < 3)
    return origins, linear, angular.swapaxes(1, 2)[:, free]

"""The body, its path and the constraint frame in space."""

from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from reframe_jax.constraints.located import Located, assemble_frame, locate_on_host
from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.export.common import axes_of
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

__all__ = [
    "check_window",
    "draw_arm",
    "draw_frame",
    "draw_legend",
    "draw_space",
    "frame_length",
    "frames_in_ground",
    "segment",
    "set_limits",
    "track",
]


def check_window(found: Identification) -> Identification:
    """Return a single window with a result, on the host; a ValueError otherwise."""
    if np.shape(found.status_code):
        raise ValueError("A batch has several frames: index one window first, found[i].")
    if found.status.failed:
        raise ValueError(f"There is nothing to draw: {found.status.message}")
    return jax.device_get(found)


def draw_space(axes: "Axes3D", poses: np.ndarray, found: Identification) -> None:
    """Draw path and axes of the body, the frame, a legend, and the outliers inside the picture."""
    counted = np.asarray(found.counted)
    out, poses = poses[~counted, :3, 3], poses[counted]
    path = poses[:, :3, 3]
    samples = frame_samples(poses, found)
    origins, triads, rotation_axes = frames_in_ground(poses, found, samples)
    points = np.concatenate([path, origins, track(poses, found)])
    length = frame_length(points)
    axes.plot(*path.T, color=BODY, linewidth=1.2, label="path and axes of the body")
    if found.linear.frame_type.position_body == AngularType.B:
        draw_arm(axes, path, track(poses, found), samples)
    for pose in poses[np.linspace(0, len(poses) - 1, 5).astype(int)]:
        for axis in pose[:3, :3].T:
            segment(axes, pose[:3, 3], pose[:3, 3] + 0.4 * length * axis, color=BODY, linewidth=0.8)
    palest_first = (0.35, 0.6, 1.0)[-len(origins) :]
    for origin, triad, turning, alpha in zip(origins, triads, rotation_axes, palest_first, strict=True):
        draw_frame(axes, origin, length * triad, length * turning, found.linear.dof, alpha)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    near = out[(np.abs(out - centre) < _size(points) / 2).all(axis=1)]
    if len(out):
        axes.plot(*near.T, **OUTLIERS)
    draw_legend(axes, found.linear.frame_type, found.linear.dof, bool(len(rotation_axes[0])))
    set_limits(axes, points)


def draw_arm(axes: "Axes3D", path: np.ndarray, origins: np.ndarray, samples: np.ndarray) -> None:
    """Draw the path (K+1, 3) of an origin that is fixed in the body, and a line from the body."""
    axes.plot(*origins.T, ":", color="black", linewidth=1.0, label="path of the frame's origin")
    for sample in samples:
        segment(axes, path[sample], origins[sample], color=BODY, linewidth=2.2, alpha=0.45)


def track(poses: np.ndarray, found: Identification) -> np.ndarray:
    """Compute the path of the linear frame's origin in the ground, (K+1, 3) m."""
    return poses[:, :3, 3] + _locate(poses, found).lever


def _locate(poses: np.ndarray, found: Identification) -> Located:
    """Locate the frames of a window at every pose (K+1, 4, 4)."""
    with jax.enable_x64(True):
        frame = assemble_frame(
            found.angular.type_code,
            found.linear.type_code,
            angular_axes=axes_of(found.angular.rotvec),
            linear_axes=axes_of(found.linear.rotvec),
            position=found.linear.position,
            angular_dof=found.angular.dof,
            linear_dof=found.linear.dof,
        )
    return locate_on_host(frame, poses)


def frame_samples(poses: np.ndarray, found: Identification) -> np.ndarray:
    """Indices of poses at which the frame is drawn: one if the frame is fixed in the ground, else three."""
    kind = found.linear.frame_type
    in_ground = kind.orientation_body == kind.position_body == AngularType.G
    middle = len(poses) // 2
    return np.array([middle] if in_ground else [0, middle, len(poses) - 1])


def _size(points: np.ndarray) -> float:
    return 1.1 * max(float(np.max(np.ptp(points, axis=0))), 0.05)


def frame_length(points: np.ndarray) -> float:
    """Length in m of the drawn axes of a frame, in a scene of points (N, 3)."""
    return 0.22 * _size(points)


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
    """Draw the linear frame at one pose, and the free axes of rotation through its origin."""
    axes.plot(*origin[:, None], "o", color="black", markersize=3, alpha=alpha)
    for axis in turning:
        segment(axes, origin - 1.5 * axis, origin + 1.5 * axis, color=TURNING, linestyle="-.", alpha=alpha)
    for i, (axis, colour) in enumerate(zip(triad.T, axis_colours(dof), strict=True)):
        if dof[i]:
            axes.quiver(*origin, *axis, arrow_length_ratio=0.25, color=colour, linewidth=2.4, alpha=alpha)
        else:
            segment(axes, origin, origin + axis, linestyle="--", color=colour, linewidth=2.4, alpha=alpha)
        if alpha == 1:
            axes.text(
                *(origin + 1.15 * axis), str(i + 1), color=colour, ha="center", va="center", fontsize=12
            )


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


def frames_in_ground(
    poses: np.ndarray, found: Identification, samples: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the frames of one window in the ground, at samples of its poses (see ``frame_samples``).

    Returns:
        Origins (n, 3); axes of the linear frame (n, 3, 3), as columns; directions (n, m, 3) of the m free
        rotation axes, with m = 0 if all three rotations are free.
    """
    samples = frame_samples(poses, found) if samples is None else samples
    located = jax.tree.map(lambda leaf: leaf[samples], _locate(poses, found))
    free = np.asarray(found.angular.dof, dtype=bool) & (np.sum(found.angular.dof) < 3)
    turning = located.angular_axes.swapaxes(1, 2)[:, free]
    return poses[samples, :3, 3] + located.lever, located.linear_axes, turning

"""Picture of a demonstration on the simulated arm."""

from typing import TYPE_CHECKING, Any

import jax
import mujoco
import numpy as np

from reframe_jax.constraints.frame import locate_on_host
from reframe_jax.plotting.scene import draw_frame, draw_legend, segment, set_limits, turning_axes
from reframe_jax.plotting.style import BODY, CONSTRAINED, FONT, FREE, new_figure
from reframe_jax.simulation.arm.demonstration import Demonstration
from reframe_jax.simulation.arm.model import PANDA, Arm, find_arm

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d.axes3d import Axes3D

__all__ = ["plot_demonstration"]


def plot_demonstration(made: Demonstration, *, arm: str | Arm = PANDA, title: str | None = None) -> "Figure":
    """Draw one demonstration: the arm, its constraint, the motion of the tool, and the reactions.

    The left panel shows the arm at the first, middle and last sample (the first one palest), the path of the
    TCP, and the true constraint frame. Free axes are solid, constrained axes dashed, and axes of free
    rotation green. The right panels show the motion along the free axes, and the moments and forces of the
    constraint on the tool along the constrained axes. A ValueError is raised for a batch.
    """
    if np.ndim(made.status_code):
        raise ValueError("A batch has several demonstrations: index one first, made[i].")
    made = jax.device_get(made)
    figure = new_figure(11, 6.6)
    grid = figure.add_gridspec(3, 2, width_ratios=(1.15, 1))
    if title is not None:
        figure.suptitle(title, fontsize=14)
    _draw_scene(figure.add_subplot(grid[:, 0], projection="3d"), made, find_arm(arm))
    free = np.array((*made.truth.angular_dof, *made.truth.linear_dof), dtype=bool)
    motion, moments, forces = (figure.add_subplot(grid[i, 1]) for i in range(3))
    for i in np.flatnonzero(free):
        # a common scale for rotations and translations: 1 rad moves a point at 0.1 m by 0.1 m
        factor, kind, unit, style = (1, "turn", "rad", "-") if i < 3 else (10, "shift", "0.1 m", "--")
        label, series = f"{kind} {'xyz'[i % 3]} [{unit}]", factor * made.slip[:, i]
        motion.plot(made.times, series, style, color=FREE[i % 3], linewidth=1.2, label=label)
    motion.set_ylabel("free motion\n[rad, 0.1 m]", fontsize=FONT)
    for axes, part, unit, name in (
        (moments, slice(0, 3), "N m", "moment"),
        (forces, slice(3, 6), "N", "force"),
    ):
        for i in np.flatnonzero(~free[part]):
            label, series = f"{name} {'xyz'[i]} [{unit}]", made.reaction[1:, part][:, i]
            axes.plot(made.times[1:], series, color=CONSTRAINED[i], linewidth=1.0, label=label)
        axes.set_ylabel(f"reaction\n{name} [{unit}]", fontsize=FONT)
        if free[part].all():
            axes.set_axis_off()
            axes.text(0.5, 0.5, f"no {name}s: all axes are free", transform=axes.transAxes, ha="center")
    forces.set_xlabel("time [s]", fontsize=FONT)
    for axes in (motion, moments, forces):
        axes.tick_params(labelsize=FONT, labelbottom=axes is forces)
        if axes.get_legend_handles_labels()[0]:
            axes.axhline(0, color="black", linewidth=0.5)
            place: Any = {"loc": "lower left", "bbox_to_anchor": (0, 1), "borderpad": 0.1}
            axes.legend(**place, ncols=3, fontsize=FONT, frameon=False)
        axes.set_xlim(0, float(made.times[-1]))
    return figure


def _joint_points(joints: np.ndarray, arm: Arm) -> np.ndarray:
    """Base, origins of the links, and TCP, (9, 3) m, for joint positions (7,)."""
    data = mujoco.MjData(arm.model)
    data.qpos[:7] = joints
    mujoco.mj_kinematics(arm.model, data)
    return np.concatenate([data.xpos[:8], data.site("tcp").xpos[None]])


def _draw_scene(axes: "Axes3D", made: Demonstration, arm: Arm) -> None:
    truth, shown = made.truth, [0, len(made.times) // 2, len(made.times) - 1]
    path = np.asarray(made.exact_poses)[:, :3, 3]
    located: Any = locate_on_host(truth, np.asarray(made.exact_poses)[shown])
    turns = turning_axes(truth.angular_dof)
    extent = [path, path[shown] + located.lever]
    for row, (index, alpha) in enumerate(zip(shown, (0.25, 0.5, 1.0), strict=True)):
        points, origin = _joint_points(np.asarray(made.joint_positions[index]), arm), extent[1][row]
        extent.append(points)
        axes.plot(*points.T, "o-", color=BODY, lw=3.5, markersize=4, alpha=alpha, solid_capstyle="round")
        segment(axes, path[index], origin, linestyle=":", color="black", linewidth=1, alpha=alpha)
        turning = 0.12 * located.angular_axes[row].T[turns]
        draw_frame(axes, origin, 0.13 * located.linear_axes[row], turning, truth.linear_dof, alpha)
    axes.plot(*path.T, color="black", linewidth=1.5, label="path of the TCP")
    draw_legend(axes, truth.linear_type, truth.linear_dof, bool(turns.any()))
    set_limits(axes, np.concatenate(extent))
    axes.view_init(elev=18, azim=-60)

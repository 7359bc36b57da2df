"""Panels of curves with common axes, such as errors over the noise."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.plotting.style import LINES, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Curve", "plot_curves"]


@dataclass(frozen=True)
class Curve:
    """One line of a panel.

    Attributes:
        name: entry in the legend; curves with equal names have one entry.
        values: (N,), in the unit of the panels' y axis.
        low, high: (N,) each, edges of a band around the values; None draws no band.
        colour: index into the colour cycle.
        dashed: whether the line is dashed.
    """

    name: str
    values: ArrayLike
    low: ArrayLike | None = None
    high: ArrayLike | None = None
    colour: int = 0
    dashed: bool = False


def plot_curves(
    x: ArrayLike,
    panels: Mapping[str, Sequence[Curve]],
    *,
    xlabel: str,
    ylabel: str,
    title: str | None = None,
    columns: int = 4,
    log: bool = True,
    notes: Mapping[str, str] | None = None,
) -> "Figure":
    """Draw one panel per entry, with common axes and a common legend above the panels.

    Args:
        x: (N,) x values of all curves.
        panels: curves of each panel, with the title of the panel as key.
        xlabel: label of the common x axis, with the unit.
        ylabel: label of the common y axis, with the unit.
        title: title of the figure.
        columns: number of panels per row.
        log: whether the axes are logarithmic.
        notes: a line of text inside a panel, with the title of the panel as key.

    Raises:
        ImportError: if Matplotlib is not installed.
    """
    x, columns = np.asarray(x), min(columns, len(panels))
    rows = -(-len(panels) // columns)
    figure = new_figure(2.3 * columns + 0.6, 1.8 * rows + 0.9)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    handles: dict[str, Any] = {}
    for axes, (name, curves) in zip(grid.flat, panels.items(), strict=False):
        for curve in curves:
            colour, style = LINES[curve.colour % len(LINES)], "--" if curve.dashed else "-"
            (line,) = axes.plot(x, curve.values, style, color=colour, linewidth=1.3, label=curve.name)
            handles.setdefault(curve.name, line)
            if curve.low is not None and curve.high is not None:
                axes.fill_between(x, curve.low, curve.high, color=colour, alpha=0.15, linewidth=0)
        if log:
            axes.set_xscale("log")
            axes.set_yscale("log")
        axes.set_title(name, fontsize=8)
        axes.grid(alpha=0.25, linewidth=0.5)
        axes.tick_params(labelsize=7)
        if notes and name in notes:
            axes.text(0.97, 0.04, notes[name], transform=axes.transAxes, ha="right", fontsize=6.5)
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    figure.supxlabel(xlabel, fontsize=9)
    figure.supylabel(ylabel, fontsize=9)
    if len(handles) <= 1:
        figure.suptitle(title or "", fontsize=11)
    else:
        figure.legend(
            handles=list(handles.values()),
            title=title,
            title_fontsize=11,
            loc="outside upper center",
            ncols=min(len(handles), 4),
            fontsize=8,
            frameon=False,
        )
    return figure

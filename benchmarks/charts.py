"""Charts of the reports and notebooks: curves, maps, bars, and reaction forces of reproductions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from reframe_jax.plotting.style import LINES, new_figure
from reframe_jax.simulation.reproduction import Comparison

__all__ = ["Curve", "plot_bars", "plot_comparison", "plot_curves", "plot_maps", "plot_reactions"]

_ROWS = {"exact": "exact frame", "identified": "identified"}


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
) -> Figure:
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


def plot_maps(
    maps: Mapping[str, ArrayLike],
    *,
    columns: Sequence[str],
    rows: Sequence[str],
    xlabel: str,
    ylabel: str,
    unit: str,
    title: str | None = None,
    limits: tuple[float, float] | None = None,
    log: bool = False,
    form: str = "{:.2g}",
    across: int = 3,
) -> Figure:
    """Draw maps side by side with one colour scale, and print the value in every cell.

    Args:
        maps: values (len(rows), len(columns)), with the title of the map as key; NaN leaves a cell empty.
        columns: labels of the columns, from the left.
        rows: labels of the rows, the first one at the bottom.
        xlabel: label of the common x axis.
        ylabel: label of the common y axis.
        unit: label of the colour scale.
        title: title of the figure.
        limits: range of the colour scale; by default the range of the values.
        log: whether the colour scale is logarithmic.
        form: format specification of the numbers.
        across: number of maps per row.
    """
    values = {name: np.asarray(array, dtype=float) for name, array in maps.items()}
    across = min(across, len(values))
    down = -(-len(values) // across)
    cell = 0.46
    width = across * (cell * len(columns) + 0.5) + 1.4
    figure = new_figure(max(width, 5.6), down * (0.75 * cell * len(rows) + 0.55) + 0.7)
    finite = np.concatenate([array[np.isfinite(array)] for array in values.values()])
    low, high = limits or ((finite.min(), finite.max()) if len(finite) else (0.0, 1.0))
    scale = LogNorm(low, high) if log else Normalize(low, high)
    grid = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False)
    image = None
    for axes, (name, array) in zip(grid.flat, values.items(), strict=False):
        image = axes.imshow(array, origin="lower", aspect="auto", cmap="cividis", norm=scale)
        for (i, j), value in np.ndenumerate(array):
            if np.isfinite(value):
                dark = scale(value) < 0.55
                axes.text(
                    j,
                    i,
                    form.format(value),
                    ha="center",
                    va="center",
                    fontsize=6,
                    color="white" if dark else "black",
                )
        axes.set_xticks(range(len(columns)), columns, fontsize=7)
        axes.set_yticks(range(len(rows)), rows, fontsize=7)
        axes.set_title(name, fontsize=8)
    for axes in grid.flat[len(values) :]:
        axes.set_visible(False)
    figure.supxlabel(xlabel, fontsize=9)
    figure.supylabel(ylabel, fontsize=9)
    if title is not None:
        figure.suptitle(title, fontsize=11)
    if image is not None:
        figure.colorbar(image, ax=grid, label=unit, shrink=0.9)
    return figure


def plot_bars(
    groups: Sequence[str],
    bars: Mapping[str, Mapping[str, Sequence[np.ndarray]]],
    *,
    ylabels: Mapping[str, str],
    title: str | None = None,
) -> Figure:
    """Draw panels of grouped bars: the mean of samples, their standard deviation, and the samples.

    Args:
        groups: names of the groups along the axis of every panel.
        bars: panels by title; each panel has bars by name; each bar has one array (N,) of samples per group.
        ylabels: label of the y axis of every panel, with the unit.
        title: title of the figure.
    """
    figure = new_figure(4.2 * len(bars), 3.6)
    panels = figure.subplots(1, len(bars), squeeze=False)[0]
    handles: dict[str, Any] = {}
    for axes, (panel, series) in zip(panels, bars.items(), strict=True):
        width = 0.8 / len(series)
        for i, (name, samples) in enumerate(series.items()):
            place = np.arange(len(groups)) + (i - (len(series) - 1) / 2) * width
            means = [np.mean(of_group) for of_group in samples]
            spread = [np.std(of_group) for of_group in samples]
            drawn = axes.bar(
                place, means, 0.9 * width, yerr=spread, color=LINES[i], alpha=0.75, label=name, capsize=2
            )
            handles.setdefault(name, drawn)
            for x, of_group in zip(place, samples, strict=True):
                offset = width * 0.3 * np.linspace(-1, 1, len(of_group))
                axes.plot(x + offset, of_group, ".", color="black", markersize=1.5, alpha=0.6)
        axes.set_xticks(range(len(groups)), groups)
        axes.set_title(panel, fontsize=9)
        axes.set_ylabel(ylabels[panel], fontsize=9)
        axes.tick_params(labelsize=8)
        axes.set_ylim(bottom=0)
    figure.legend(
        handles=list(handles.values()),
        loc="outside upper center",
        title=title,
        title_fontsize=11,
        ncols=len(handles),
        fontsize=8,
        frameon=False,
    )
    return figure


def plot_comparison(comparisons: Mapping[str, Comparison], *, title: str | None = None) -> Figure:
    """Draw peak reaction moments and forces of reproductions, like the paper's Figure 5.

    Bars are means, whiskers are one standard deviation, and dots are single trials.

    Args:
        comparisons: comparisons of frames, with the name of the task as key.
        title: title of the figure.
    """
    peaks = {"peak reaction moment": ("peak_moment", "N m"), "peak reaction force": ("peak_force", "N")}
    bars = {
        panel: {
            name: [np.asarray(getattr(task.rows[row], part)) for task in comparisons.values()]
            for row, name in _ROWS.items()
        }
        for panel, (part, _) in peaks.items()
    }
    return plot_bars(
        list(comparisons), bars, ylabels={panel: unit for panel, (_, unit) in peaks.items()}, title=title
    )


def plot_reactions(comparison: Comparison, index: int = 0, *, title: str | None = None) -> Figure:
    """Draw the reactions of one task over time, in exact and identified frames.

    Args:
        comparison: comparison of frames with any number of trials.
        index: number of the trial.
        title: title of the figure.
    """
    figure = new_figure(8, 3.2)
    panels = figure.subplots(1, 2)
    for axes, part, name in (
        (panels[0], slice(0, 3), "reaction moment [N m]"),
        (panels[1], slice(3, 6), "reaction force [N]"),
    ):
        for (row, name_of_row), colour, style in zip(_ROWS.items(), LINES, ("-", "--"), strict=False):
            trials = comparison.rows[row]
            size = np.linalg.norm(np.asarray(trials.reaction)[index, 1:, part], axis=-1)
            axes.plot(
                np.asarray(trials.times)[1:], size, style, color=colour, linewidth=1.6, label=name_of_row
            )
        axes.set_ylabel(f"norm of the {name}", fontsize=8)
        axes.set_xlabel("time [s]", fontsize=8)
        axes.set_ylim(bottom=0)
        axes.margins(x=0)
        axes.tick_params(labelsize=8)
    panels[0].legend(fontsize=8, frameon=False)
    if title is not None:
        figure.suptitle(title, fontsize=11)
    return figure

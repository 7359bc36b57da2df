"""Maps of a quantity over two variables, and grouped bars with standard deviations."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.plotting.style import LINES, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["plot_bars", "plot_maps"]


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
) -> "Figure":
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

    Raises:
        ImportError: if Matplotlib is not installed.
    """
    values = {name: np.asarray(array, dtype=float) for name, array in maps.items()}
    across = min(across, len(values))
    down = -(-len(values) // across)
    cell = 0.46
    width = across * (cell * len(columns) + 0.5) + 1.4
    figure = new_figure(max(width, 5.6), down * (0.75 * cell * len(rows) + 0.55) + 0.7)
    from matplotlib.colors import LogNorm, Normalize

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
) -> "Figure":
    """Draw panels of grouped bars: the mean of samples, their standard deviation, and the samples.

    Args:
        groups: names of the groups along the axis of every panel.
        bars: panels by title; each panel has bars by name; each bar has one array (N,) of samples per group.
        ylabels: label of the y axis of every panel, with the unit.
        title: title of the figure.

    Raises:
        ImportError: if Matplotlib is not installed.
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

"""Colours and helper functions of all pictures. Matplotlib is imported when a figure is created."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# colours of Okabe & Ito, safe for colour-blind readers; the first axis of each group is darkest
FREE = ("#0072B2", "#56B4E9", "#00415F")
CONSTRAINED = ("#D55E00", "#E69F00", "#7F3800")
TURNING = "#009E73"
BODY = "#999999"
FONT = 10  # points; at half the size of a picture, the text is still legible
LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
OUTLIERS: dict[str, Any] = {"marker": "x", "color": "#CC79A7", "markersize": 5, "label": "outliers"}
NOT_READ: dict[str, Any] = {"marker": "|", "color": "black", "markersize": 7, "label": "rows not read"}
LEGEND_ABOVE: dict[str, Any] = {
    "loc": "lower center",
    "bbox_to_anchor": (0.46, 1),
    "ncols": 2,
    "fontsize": FONT,
    "frameon": False,
    "columnspacing": 1,
}


def new_figure(width: float, height: float) -> "Figure":
    """Create a figure of a size in inches, without ``pyplot``; an ImportError names the extra to install."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('Plots need Matplotlib: pip install "reframe-jax[plot]".') from error
    return Figure(figsize=(width, height), dpi=150, layout="constrained")


def axis_colours(dof: Any) -> list[str]:
    """Return the colours of three axes from ``dof`` (3,): blues for 1 (free), oranges for 0 (constrained)."""
    families = {0: iter(CONSTRAINED), 1: iter(FREE)}
    return [next(families[int(free)]) for free in dof]

"""A check of pictures: text that is legible at half the size, and units on every axis."""

import re
from typing import Any

from matplotlib.text import Text

__all__ = ["check_legible"]

_SMALLEST = 9.5  # points


def check_legible(figure: Any) -> None:
    """Check the size of all text, and the units of all axes that have ticks with labels."""
    figure.canvas.draw()
    texts = [text for text in figure.findobj(Text) if text.get_visible() and text.get_text().strip()]
    assert texts
    small = [text.get_text() for text in texts if text.get_fontsize() < _SMALLEST]
    assert small == []
    for axes in figure.axes:
        for name in ("x", "y", "z") if axes.axison else ():
            axis = getattr(axes, f"{name}axis", None)
            ticks = [] if axis is None else [tick.get_text() for tick in axis.get_ticklabels()]
            if any(re.search(r"\d", text) and "axis" not in text for text in ticks):
                assert re.search(r"\[.+\]", axis.get_label_text()), (axes.get_title(), name, ticks)

"""Write the page as one static file, which opens without Python and without a network."""

import base64
import html
import io
from pathlib import Path

import numpy as np

from reframe_jax.plotting.style import new_figure
from reframe_jax.viewer.page import close_server, legend_html, open_server, velocity_series
from reframe_jax.viewer.tracks import WindowTrack

_FRAMES = 400  # largest number of poses in a file
_SIZE, _FONT = (3.5, 1.5), 7  # inches and points, of a plot
_STYLE = (Path(__file__).parent / "document.css").read_text(encoding="utf-8")


def write_page(path: Path | str, windows: list[WindowTrack], *, title: str = "reframe_jax") -> None:
    """Write a page as one HTML file that plays all windows in a loop, with the velocities along the axes.

    The file needs neither Python nor a network. It contains at most 400 poses; more are subsampled.

    Args:
        path: file to write.
        windows: windows of one recording, in the order of time.
        title: heading of the page.

    Raises:
        ImportError: if viser or Matplotlib is not installed.
        ValueError: without windows.
        OSError: if the file cannot be written.
    """
    server, drawing = open_server(windows, 0)
    try:
        drawing.draw(windows[0])
        recording = server.get_scene_serializer()
        samples_per_window = max(2, _FRAMES // len(windows))
        for index, window in enumerate(windows):
            if index:
                drawing.draw(window)
            samples = np.unique(np.linspace(0, len(window.times) - 1, samples_per_window).astype(int))
            waits = np.diff(window.times[samples], append=window.times[-1])
            for sample, wait in zip(samples, waits, strict=True):
                drawing.move_to(int(sample))
                recording.insert_sleep(float(wait))
        text = recording.as_html()
        captions = [drawing.caption(window) for window in windows]
    finally:
        close_server(server)
    # viser has no panel in a file: this library adds its own
    place = text.rindex("</body>")
    Path(path).write_text(text[:place] + _panel(windows, captions, title) + text[place:], encoding="utf-8")


def _panel(windows: list[WindowTrack], captions: list[str], title: str) -> str:
    parts = []
    for window, caption in zip(windows, captions, strict=True):
        begin, end = window.times[0], window.times[-1]
        plots = "".join(_plot(name, rows, window.velocity_times) for name, rows in velocity_series(window))
        parts.append(
            f"<details{' open' if len(windows) == 1 else ''}><summary>"
            f"<b>{html.escape(window.name.rstrip('.'))}</b>, {begin:.2f} to {end:.2f} s</summary>"
            f"<div>{html.escape(caption)}</div>{plots}"
            f"<details><summary>result</summary><pre>{html.escape(window.text)}</pre>"
            "</details></details>"
        )
    legend = f"<details><summary>legend</summary>{legend_html()}</details>"
    heading = f"<div><b>{html.escape(title)}</b></div>"
    return f'<style>{_STYLE}</style><div id="reframe-panel">{heading}{"".join(parts)}{legend}</div>'


def _plot(name: str, rows: list[tuple[str, str, np.ndarray]], times: np.ndarray) -> str:
    """Draw velocities over time as an image."""
    figure = new_figure(*_SIZE)
    axes = figure.add_subplot()
    for _, colour, row in rows:
        (line,) = axes.plot(times, row, color=colour, linewidth=1)
        line.set_gid("velocity")
    axes.set_xlabel("time [s]", fontsize=_FONT)
    axes.tick_params(labelsize=_FONT)
    axes.margins(x=0)
    drawn = io.BytesIO()
    figure.savefig(drawn, format="svg", transparent=True)
    labels = " ".join(
        f'<span style="color:{colour}">&#9632; {html.escape(label)}</span>' for label, colour, _ in rows
    )
    image = base64.b64encode(drawn.getvalue()).decode()
    return f'<div>{html.escape(name)} {labels}</div><img src="data:image/svg+xml;base64,{image}">'

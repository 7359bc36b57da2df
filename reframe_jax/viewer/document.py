"""Write the page as one static file, which opens without Python and without a network."""

import html
from pathlib import Path

import numpy as np

from reframe_jax.viewer.page import close_server, legend_html, open_server, velocity_series
from reframe_jax.viewer.tracks import WindowTrack

_FRAMES = 400  # largest number of poses in a file
_WIDTH, _HEIGHT, _MARGIN = 340, 130, 54  # px, size of a plot; the margin fits the label -1.2e-05
_STYLE = (Path(__file__).parent / "document.css").read_text(encoding="utf-8")


def write_page(path: Path | str, windows: list[WindowTrack], *, title: str = "reframe_jax") -> None:
    """Write a page as one HTML file that plays all windows in a loop, with the velocities along the axes.

    The file needs neither Python nor a network. It contains at most 400 poses; more are subsampled.

    Args:
        path: file to write.
        windows: windows of one recording, in the order of time.
        title: heading of the page.

    Raises:
        ImportError: if viser is not installed.
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
    """Draw velocities over time as an SVG."""
    values = np.concatenate([row for _, _, row in rows])
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    if high <= low:
        high = low + 1
    across = _MARGIN + (times - times[0]) / max(times[-1] - times[0], 1e-12) * (_WIDTH - _MARGIN - 4)
    lines = []
    for label, colour, row in rows:
        up = _HEIGHT - 14 - (row - low) / (high - low) * (_HEIGHT - 20)
        drawn = " ".join(
            f"{'M' if start else 'L'}{x:.1f},{y:.1f}"
            for x, y, start in zip(across, up, _starts(row), strict=True)
            if np.isfinite(y)
        )
        shape = f'<path d="{drawn}" fill="none" stroke="{colour}" stroke-width="1.3">'
        lines.append(f"{shape}<title>{html.escape(label)}</title></path>")
    labels = " ".join(
        f'<span style="color:{colour}">&#9632; {html.escape(label)}</span>' for label, colour, _ in rows
    )
    ticks = "".join(
        f'<text x="{x}" y="{y}" font-size="11" text-anchor="{anchor}">{text}</text>'
        for x, y, anchor, text in (
            (_MARGIN - 3, 10, "end", f"{high:.2g}"),
            (_MARGIN - 3, _HEIGHT - 12, "end", f"{low:.2g}"),
            (_MARGIN, _HEIGHT - 2, "start", f"{times[0]:.2f} s"),
            (_WIDTH - 4, _HEIGHT - 2, "end", f"{times[-1]:.2f} s"),
        )
    )
    size = f'width="{_WIDTH}" height="{_HEIGHT}"'
    return f"<div>{html.escape(name)} {labels}</div><svg {size}>{''.join(lines)}{ticks}</svg>"


def _starts(row: np.ndarray) -> np.ndarray:
    """Indices at which a line starts: the first value, and the first value after every gap."""
    finite = np.isfinite(row)
    return finite & ~np.concatenate([[False], finite[:-1]])

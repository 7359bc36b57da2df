"""Serve the page to a browser on this machine, or write it as one file, which opens without Python."""

import base64
import contextlib
import html
import io
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from reframe_jax.plotting.style import axis_colours, new_figure
from reframe_jax.viewer.drawing import LEGEND, Drawing, scene_box
from reframe_jax.viewer.tracks import WindowTrack

if TYPE_CHECKING:
    import viser

_HOST = "127.0.0.1"
_TICK = 0.05  # s between two poses during playback
_VIEW = np.array([0.6, -0.88, 0.52])  # position of the camera relative to the centre, in scene sizes
_FRAMES = 400  # largest number of poses in a file
_CHART: Any = {"scales": {"x": {"time": False}}, "axes": ({"label": "time [s]"}, {}), "aspect": 1.6}
_SIZE, _FONT = (3.5, 1.5), 7  # inches and points, of a plot in a file
_SCENE_STYLE, _FILE_STYLE = (
    (Path(__file__).parent / name).read_text(encoding="utf-8") for name in ("page.css", "document.css")
)


def open_server(windows: list[WindowTrack], port: int) -> tuple["viser.ViserServer", Drawing]:
    """Start a server on this machine only, with the camera at the scene; errors as in :class:`Page`."""
    try:
        import viser
    except ImportError as error:
        raise ImportError("The viewer needs viser: pip install 'reframe-jax[viewer]'") from error
    if not windows:
        raise ValueError("Expected at least one window.")
    centre, size = scene_box(windows)
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints a banner
        server = viser.ViserServer(host=_HOST, port=port, verbose=False)
    server.scene.set_up_direction("+z")
    server.scene.add_frame("/ground", axes_length=0.15 * size, axes_radius=0.003 * size)
    server.initial_camera.look_at = tuple(centre)
    server.initial_camera.position = tuple(centre + size * _VIEW)
    server.initial_camera.near = 0.01 * size
    return server, Drawing(server.scene, size)


def close_server(server: "viser.ViserServer") -> None:
    """Stop a server without output."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


class Page:
    """A served page with a window of a recording, a time slider, and the velocities along the axes.

    The server listens on 127.0.0.1 only, in a separate thread; the page needs no network. With several
    windows, a second slider selects one. A port that is in use is replaced by the next free port. Keep a
    reference to this object, and close the page at the end. An ImportError is raised if viser is not
    installed, a ValueError without windows.
    """

    def __init__(self, windows: list[WindowTrack], *, title: str = "reframe_jax", port: int = 8080) -> None:
        self._windows = windows
        self._lock = threading.RLock()
        self._server, self._drawing = open_server(windows, port)
        self._current = windows[0]
        self._charts: list[Any] = []
        gui = self._server.gui
        gui.configure_theme(control_width="large", show_share_button=False)
        gui.set_panel_label(title)
        self._heading = gui.add_markdown("")
        if len(windows) > 1:
            choice = gui.add_slider("window", 0, len(windows) - 1, 1, 0)
            choice.on_update(lambda _: self._select(int(choice.value)))
        self._time: Any = gui.add_slider("time [s]", 0.0, 1.0, 0.001, 0.0)
        self._time.on_update(lambda _: self._move_to_time())
        self._playing = gui.add_checkbox("play", False)
        self._plots = gui.add_folder("velocities along the axes")
        self._table = gui.add_folder("result", expand_by_default=False)
        with gui.add_folder("legend", expand_by_default=False):
            gui.add_html(legend_html())
        gui.add_html(f"<style>{_SCENE_STYLE}</style>")
        self._select(0)

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{_HOST}:{self._server.get_port()}"

    def run(self) -> None:
        """Move through the poses while the checkbox "play" is set; this method does not return."""
        while True:
            time.sleep(_TICK)
            if self._playing.value:
                self.advance(_TICK)

    def advance(self, seconds: float) -> None:
        """Advance the time by one step; after the end of the window, continue at its start."""
        times = self._current.times
        later = self._time.value + seconds
        self._time.value = float(later if later <= times[-1] else times[0])
        self._move_to_time()

    def close(self) -> None:
        """Stop the server."""
        close_server(self._server)

    def _select(self, index: int) -> None:
        """Show another window from its start."""
        with self._lock:
            window = self._current = self._windows[index]
            with self._server.atomic():
                self._drawing.draw(window)
                begin, end = float(window.times[0]), float(window.times[-1])
                heading = f"**{window.name.rstrip('.')}**, {begin:.2f} to {end:.2f} s"
                self._heading.content = "\n\n".join(filter(None, [heading, self._drawing.caption(window)]))
                self._time.min, self._time.max = min(begin, self._time.min), end
                self._time.value = begin
                self._time.min = begin
                self._draw_plots(window)

    def _draw_plots(self, window: WindowTrack) -> None:
        gui = self._server.gui
        for chart in self._charts:
            chart.remove()
        self._charts = []
        with self._plots:
            for title, rows in velocity_series(window):
                data = (window.velocity_times, *(values for _, _, values in rows))
                series: list[Any] = [{"label": "time [s]"}]
                series += [{"label": label, "stroke": colour, "width": 1.5} for label, colour, _ in rows]
                self._charts.append(gui.add_uplot(data, tuple(series), title=title, **_CHART))
        with self._table:
            text = f"<pre style='font-size:9px;overflow-x:auto'>{html.escape(window.text)}</pre>"
            self._charts.append(gui.add_html(text))

    def _move_to_time(self) -> None:
        """Move the scene to the pose nearest to the time of the slider."""
        with self._lock:
            sample = int(np.argmin(np.abs(self._current.times - self._time.value)))
            with self._server.atomic():
                self._drawing.move_to(sample)


def velocity_series(window: WindowTrack) -> list[tuple[str, list[tuple[str, str, np.ndarray]]]]:
    """Return the plots of a window: a title, and a label, colour and values (K,) for every axis.

    The first plot shows the residuals: the velocities along the constrained axes, which are zero for an ideal
    constraint. The next plots show all axes. The titles contain the units.
    """
    if window.frame is None or not len(window.velocity_times):
        return []
    residuals, plots = [], []
    frame = window.frame
    for group, title, unit, free, columns in (
        ("linear", "velocity of the origin", "m/s", frame.linear_free, slice(3, 6)),
        ("angular", "angular velocity", "rad/s", frame.angular_free, slice(0, 3)),
    ):
        values = frame.velocities[:, columns].T
        rows = []
        for i, colour in enumerate(axis_colours(free)):
            rows.append((f"{i + 1} {'free' if free[i] else 'constrained'}", colour, values[i]))
            if not free[i]:
                residuals.append((f"{group} {i + 1} [m{unit}]", colour, 1e3 * values[i]))
        plots.append((f"{title} [{unit}]", rows))
    return [("residuals [mm/s, mrad/s]", residuals), *plots] if residuals else plots


def legend_html() -> str:
    """Legend of the page as HTML: each colour with its meaning."""
    rows = (
        f'<div><span style="color:{colour}">&#9632;</span> {html.escape(text)}</div>'
        for colour, text in LEGEND
    )
    return f'<div style="font-size:12px;padding:4px 12px">{"".join(rows)}</div>'


def write_page(path: Path | str, windows: list[WindowTrack], *, title: str = "reframe_jax") -> None:
    """Write a page as one HTML file that plays all windows in a loop, with the velocities along the axes.

    The file needs neither Python nor a network. It contains at most 400 poses; more are subsampled. The
    windows of one recording are in the order of time. Errors are those of :class:`Page`; Matplotlib is needed
    too, and an OSError is raised if the file cannot be written.
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
    return f'<style>{_FILE_STYLE}</style><div id="reframe-panel">{heading}{"".join(parts)}{legend}</div>'


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

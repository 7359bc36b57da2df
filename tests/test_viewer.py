"""The viewer: what is drawn, on a page in a real browser, and in one file without a network."""

import base64
import builtins
import gc
import re
import socket
import time
import warnings
import webbrowser
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from browsers import headless_browser, near, picture, wait_for

import reframe_jax as rf
from reframe_jax import plotting
from reframe_jax.cli import program
from reframe_jax.plotting.style import BODY, CONSTRAINED, OUTLIERS, TURNING
from reframe_jax.recordings.writing import save_recording
from reframe_jax.simulation import synthetic
from reframe_jax.viewer import Page, WindowTrack, track_window, write_page
from reframe_jax.viewer.drawing import Drawing, scene_box
from reframe_jax.viewer.page import velocity_series

# connections that are cut off while a server stops are closed by the collector, sooner or later
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")

POSES = 21
WIDTH, HEIGHT = 1280, 800
SCENE = slice(320, 870)  # columns of the picture with nothing but the scene
_IMAGE = re.compile(r'src="data:image/svg\+xml;base64,([^"]+)"')


def record(label: str, seed: int = 0) -> tuple[np.ndarray, np.ndarray, rf.Identification]:
    """Poses with one outlier, their times, and their identification."""
    simulation = synthetic.simulate(label, jax.random.key(seed), noise=1e-4)
    poses = np.array(simulation.poses[:POSES])
    poses[7, :3, 3] += 0.5
    return poses, np.asarray(simulation.times[:POSES]), rf.identify(poses, dt=0.1)


@pytest.fixture(scope="module", autouse=True)
def collect_connections() -> Iterator[None]:
    """Collect what the servers left open here, so that no test of another module is blamed for it."""
    yield
    time.sleep(0.5)  # their threads end
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        gc.collect()


@pytest.fixture(scope="module")
def hinge() -> tuple[np.ndarray, np.ndarray, rf.Identification]:
    return record("A")


@pytest.fixture(scope="module")
def tracks(hinge: tuple[np.ndarray, np.ndarray, rf.Identification]) -> list[WindowTrack]:
    """A hinge with a known uncertainty, and a later window without a result."""
    poses, times, found = hinge
    first = track_window(poses, times, found, covariance=np.diag([1e-5, 4e-5, 1e-5]))
    failed = replace(found, status_code=np.int32(rf.Status.NO_MOTION))
    return [first, track_window(poses, times + 2, failed)]


# what is drawn


@pytest.mark.parametrize("label", ["A", "K"])
def test_tracks_are_where_the_pictures_are(label: str) -> None:
    poses, times, found = record(label)
    track = track_window(poses, times, found)
    assert track.frame is not None
    figure = plotting.plot_identification(poses, found, times=times)
    dots = [line for line in figure.axes[0].lines if line.get_marker() == "o"]
    last = np.ravel(dots[-1].get_data_3d())
    middle_of_one = len(dots) == 1
    counted = np.flatnonzero(found.counted)
    shown = counted[len(counted) // 2] if middle_of_one else counted[-1]
    np.testing.assert_allclose(track.frame.origins[shown], last, atol=1e-12)
    for group, kind in (("linear", found.linear.frame_type), ("angular", found.angular.frame_type)):
        axes = np.asarray(getattr(found, group).axes)
        expected = poses[:, :3, :3] @ axes if kind.name[0] == "B" else np.tile(axes, (POSES, 1, 1))
        np.testing.assert_allclose(getattr(track.frame, f"{group}_axes"), expected, atol=1e-12)
    if track.frame.in_body is not None:
        tip = poses[:, :3, :3] @ track.frame.in_body + poses[:, :3, 3]
        np.testing.assert_allclose(track.frame.origins, tip, atol=1e-12)
    assert track.name == found.name
    assert not track.counted[7]
    assert track.frame.spread is None


def test_uncertainty_is_fixed_where_the_origin_is() -> None:
    poses, times, found = record("K", seed=1)  # its origin is fixed in the body
    assert found.linear.frame_type == rf.LinearType.GB
    covariance = np.array([[4e-4, 1e-4, 0], [1e-4, 3e-4, 0], [0, 0, 1e-6]])
    track = track_window(poses, times, found, covariance=covariance)
    assert track.frame is not None
    assert track.frame.spread is not None
    np.testing.assert_allclose(track.frame.spread @ track.frame.spread, covariance, atol=1e-12)
    np.testing.assert_array_equal(track.frame.in_body, found.linear.position)


def test_residuals_are_the_velocities_of_constrained_axes(tracks: list[WindowTrack]) -> None:
    first, failed = tracks
    assert first.frame is not None
    (title, rows), (_, linear), (_, angular) = velocity_series(first)
    assert title == "residuals [mm/s, mrad/s]"
    assert [label for label, _, _ in rows] == [
        *(f"linear {i} [mm/s]" for i in (1, 2, 3)),
        *(f"angular {i} [mrad/s]" for i in (1, 2)),
    ]
    assert [label for label, _, _ in angular] == ["1 constrained", "2 constrained", "3 free"]
    np.testing.assert_array_equal(rows[0][2], 1e3 * linear[0][2])
    assert all(len(values) == len(first.velocity_times) for _, _, values in (*rows, *linear, *angular))
    assert np.isnan(first.frame.velocities).any()  # at the outlier
    assert velocity_series(failed) == []


def test_the_heading_has_the_length_of_the_axes_and_the_uncertainty(
    hinge: tuple[np.ndarray, np.ndarray, rf.Identification],
) -> None:
    """Two standard deviations of 6 mm are seen in a scene of 0.2 m, 60 micrometres are not."""
    poses, times, found = hinge
    covariance = np.diag([9e-6, 4e-6, 0])
    scene: Any = None  # nothing is drawn

    def caption(scale: float) -> str:
        track = track_window(poses, times, found, covariance=scale * covariance)
        return Drawing(scene, 0.2).caption(track)

    length = "axes 1 to 3: 50 mm long"
    assert caption(1) == f"origin ± 6, 4 mm (two standard deviations); {length}"
    assert (
        caption(1e-4) == f"origin ± 0.06, 0.04 mm (two standard deviations), drawn 100 times larger; {length}"
    )
    assert caption(0) == length
    track = track_window(poses, times, found)
    for size, millimetres in ((0.2, 50), (0.35, 100), (1.0, 200), (9.0, 2000)):
        assert Drawing(scene, size).caption(track) == f"axes 1 to 3: {millimetres} mm long"
    assert Drawing(scene, 0.2).caption(replace(track, frame=None)) == ""


def test_the_scene_holds_the_motion_without_outliers(tracks: list[WindowTrack]) -> None:
    centre, size = scene_box(tracks)
    assert tracks[0].frame is not None
    counted = tracks[0].counted
    points = np.concatenate([tracks[0].poses[counted, :3, 3], tracks[0].frame.origins[counted]])
    assert (np.abs(points - centre) <= size / 2 + 1e-12).all()
    nothing = replace(tracks[1], poses=np.full_like(tracks[1].poses, np.nan))
    assert scene_box([nothing])[1] == 1


def test_what_cannot_be_drawn_is_refused(hinge: tuple[np.ndarray, np.ndarray, rf.Identification]) -> None:
    poses, times, found = hinge
    with pytest.raises(ValueError, match="Expected the 21 identified poses and their times"):
        track_window(poses[1:], times, found)
    with pytest.raises(ValueError, match=r"a finite covariance of shape \(3, 3\), not one of \(2, 2\)"):
        track_window(poses, times, found, covariance=np.eye(2))
    for wrong in (np.diag([1, 1, -1.0]), np.triu(np.ones((3, 3)))):
        with pytest.raises(ValueError, match="symmetric, without negative eigenvalues"):
            track_window(poses, times, found, covariance=wrong)
    batch = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), found)
    with pytest.raises(ValueError, match="index one window first"):
        track_window(poses, times, batch)
    with pytest.raises(ValueError, match="at least one window"):
        Page([])


def test_the_viewer_names_what_is_missing(
    tracks: list[WindowTrack], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = builtins.__import__

    def without(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.split(".")[0] == "viser":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r"pip install 'reframe-jax\[viewer\]'"):
        write_page(tmp_path / "page.html", tracks)


# in a browser


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    pytest.importorskip("viser", reason="needs viser")
    with headless_browser() as found:
        yield found


def shows_the_scene(page: Any) -> bool:
    """Whether the hinge is seen: its path, its dashes, its axis of rotation and the outlier."""
    scene = picture(page)[:, SCENE]
    lines = all(near(scene, colour).sum() > 40 for colour in (BODY, CONSTRAINED[0], TURNING))
    return lines and near(scene, OUTLIERS["color"], 40).sum() > 5


def shows_the_ellipsoid(page: Any) -> bool:
    """Whether a pale patch of its colour is seen, which nothing else in the scene has."""
    red, green, blue = np.moveaxis(picture(page)[:, SCENE], -1, 0)
    pale = (green > 140) & (red - green > 12) & (red - green < 60) & (blue - green > 6)
    return bool(pale.sum() > 200)


TELEPHONE, DESKTOP = {"width": 390, "height": 844}, {"width": WIDTH, "height": HEIGHT}
_PLACES = """() => {
  const scene = [...document.querySelectorAll("canvas")].map(e => e.getBoundingClientRect())
    .sort((a, b) => b.width * b.height - a.width * a.height)[0];
  return [scene.left, scene.top, scene.right, scene.bottom];
}"""
_CUT_OFF = """() => [...document.querySelectorAll("*")].filter(
  e => !e.children.length && e.innerText && e.clientWidth && e.scrollWidth > e.clientWidth + 1
).map(e => e.innerText)"""


def check_layout(view: Any, width: int, height: int, heading: Any) -> None:
    """Check that the whole hinge is seen beside or above the panel, and that no text is cut off."""
    wait_for(lambda: view.evaluate(_PLACES)[2 if width > height else 3] < max(width, height) - 100)
    left, top, right, bottom = view.evaluate(_PLACES)
    assert (right - left) * (bottom - top) > 0.4 * width * height
    place = heading.bounding_box()
    assert place["x"] >= right or place["y"] >= bottom  # right of the scene or below it
    scene = slice(int(top), int(bottom)), slice(int(left), int(right))
    for colour in (BODY, CONSTRAINED[0], TURNING):
        wait_for(lambda colour=colour: near(picture(view)[scene], colour).any())
    seen = near(picture(view)[scene], TURNING)  # the longest line of the scene
    assert not np.concatenate(
        [seen[:3].ravel(), seen[-3:].ravel(), seen[:, :3].ravel(), seen[:, -3:].ravel()]
    ).any()
    assert view.evaluate(_CUT_OFF) == []
    assert view.evaluate("document.documentElement.scrollWidth") <= width


def check_layouts(view: Any, heading: Callable[[], Any]) -> None:
    """Check the layout of a loaded page with the size of a telephone, and then of a desktop."""
    for size in (TELEPHONE, DESKTOP):
        view.set_viewport_size(size)
        wait_for(lambda: view.get_by_text("residuals").first.is_visible())
        check_layout(view, size["width"], size["height"], heading())


def test_the_page_shows_the_window_beside_a_panel_and_needs_no_network(
    browser: Any, tracks: list[WindowTrack]
) -> None:
    page = Page(tracks, title="door.csv", port=8190)
    try:
        view = browser.new_page(viewport=TELEPHONE)
        asked: list[str] = []
        view.on("request", lambda request: asked.append(request.url))
        view.goto(page.url)
        check_layouts(view, lambda: view.get_by_text("door.csv").first)
        wait_for(lambda: shows_the_scene(view))
        for words in ("door.csv", "Revolute joint", "residuals", "time [s]", "window"):
            assert view.get_by_text(words).first.is_visible(), words
        before = picture(view)[:, SCENE]
        wait_for(lambda: bool((picture(view)[:, SCENE] == before).all()))

        # the slider of the time moves the body
        field = view.locator("input:visible:not([type=checkbox])").last
        field.fill("1.5")
        field.press("Enter")
        wait_for(lambda: bool((picture(view)[:, SCENE] != before).sum() > 500))
        assert shows_the_scene(view)

        # the other window has no result, and so no axes
        field = view.locator("input:visible:not([type=checkbox])").first
        field.fill("1")
        field.press("Enter")
        wait_for(lambda: view.get_by_text("No result").first.is_visible())
        wait_for(lambda: not near(picture(view)[:, SCENE], TURNING).any())
        assert near(picture(view)[:, SCENE], BODY).sum() > 40

        local = re.compile(r"(blob:)?http://127\.0\.0\.1:\d+/|data:|ws://127\.0\.0\.1:\d+")
        assert asked
        assert all(local.match(url) for url in asked), asked
    finally:
        page.close()


def test_the_panel_of_a_file_does_not_cover_the_scene(
    browser: Any, tracks: list[WindowTrack], tmp_path: Path
) -> None:
    write_page(tmp_path / "page.html", tracks[:1], title="door.csv")
    view = browser.new_page(viewport=TELEPHONE)
    view.goto((tmp_path / "page.html").as_uri())
    check_layouts(view, lambda: view.locator("#reframe-panel"))
    view.close()


def test_the_page_is_for_this_machine_only(tracks: list[WindowTrack]) -> None:
    """A server on all addresses would answer at 127.0.0.2 too."""
    pytest.importorskip("viser", reason="needs viser")
    page = Page(tracks, port=8190)
    try:
        port = int(page.url.rsplit(":", 1)[1])
        assert page.url.startswith("http://127.0.0.1:")
        socket.create_connection(("127.0.0.1", port), timeout=5).close()
        with pytest.raises(OSError, match="refused"):
            socket.create_connection(("127.0.0.2", port), timeout=5)
    finally:
        page.close()


def test_playing_moves_the_body_and_starts_again(tracks: list[WindowTrack]) -> None:
    pytest.importorskip("viser", reason="needs viser")
    page = Page(tracks[:1], port=8190)
    try:
        body = page._drawing._moving["body"]
        np.testing.assert_allclose(body.position, tracks[0].poses[0, :3, 3])
        page.advance(1.04)
        np.testing.assert_allclose(body.position, tracks[0].poses[10, :3, 3])
        page.advance(1.5)
        np.testing.assert_allclose(body.position, tracks[0].poses[0, :3, 3])
    finally:
        page.close()


def test_one_file_shows_the_same_without_a_network(
    browser: Any, tracks: list[WindowTrack], tmp_path: Path
) -> None:
    path = tmp_path / "page.html"
    write_page(path, tracks, title="a <door>")
    context = browser.new_context(viewport=DESKTOP)
    context.set_offline(True)
    view = context.new_page()
    asked: list[str] = []
    view.on("request", lambda request: asked.append(request.url))
    view.goto(path.as_uri())
    # it plays: the hinge is seen during the first window
    wait_for(lambda: shows_the_scene(view))
    wait_for(lambda: shows_the_ellipsoid(view))
    panel = view.locator("#reframe-panel")
    assert panel.get_by_text("a <door>").is_visible()
    assert panel.get_by_text("Revolute joint").first.is_visible()
    panel.locator("summary").first.click()
    assert all(panel.locator("img").evaluate_all("images => images.map(image => image.naturalWidth > 0)"))
    drawn = [base64.b64decode(image).decode() for image in _IMAGE.findall(path.read_text())]
    assert [image.count('id="velocity"') for image in drawn] == [5, 3, 3]
    assert panel.get_by_text("residuals").is_visible()
    assert panel.get_by_text("(two standard deviations)").is_visible()
    assert all(url.startswith(("file:", "data:", "blob:")) for url in asked), asked
    context.close()


# on the command line


@pytest.fixture
def door(tmp_path: Path) -> Path:
    """A recording of 51 poses, as in most tests of the covariance: its program is the same."""
    simulation = synthetic.simulate("A", jax.random.key(0), noise=1e-4)
    path = tmp_path / "door.csv"
    save_recording(path, np.asarray(simulation.times), np.asarray(simulation.poses))
    return path


def test_the_command_writes_a_file(door: Path, tmp_path: Path, capsys: Any) -> None:
    pytest.importorskip("viser", reason="needs viser")
    out = tmp_path / "door.html"
    assert program.main(["view", "--no-cache", str(door), "--html", str(out)]) == 0
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == (f"{out}: Revolute joint\n", "")
    text = out.read_text()
    assert "door.csv" in text
    assert re.search(r"origin ± [\d., ]+ mm \(two standard deviations\)", text)
    assert len(_IMAGE.findall(text)) == 3
    assert not re.search(r'(src|href)="https?:', text)
    with pytest.raises(SystemExit) as stopped:
        program.main(["view", str(door), "--html", str(tmp_path / "no" / "a.html")])
    assert stopped.value.code == 2
    assert "--html: there is no directory" in capsys.readouterr().err
    assert program.main(["view", str(tmp_path / "no.csv")]) == 1
    assert "cannot be read: No such file" in capsys.readouterr().err


def test_the_command_serves_a_page_until_it_is_interrupted(
    door: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("viser", reason="needs viser")
    served: list[tuple[str, int]] = []
    opened: list[str] = []

    def interrupted(page: Page) -> None:
        host, port = page.url.removeprefix("http://").split(":")
        socket.create_connection((host, int(port)), timeout=5).close()
        served.append((host, int(port)))
        raise KeyboardInterrupt

    monkeypatch.setattr(Page, "run", interrupted)
    monkeypatch.setattr(webbrowser, "open", opened.append)
    assert program.main(["view", "--no-cache", str(door), "--port", "8190", "--open"]) == 130
    ((host, port),) = served
    assert opened == [f"http://{host}:{port}"]
    assert capsys.readouterr().out == f"{door}: {opened[0]} (Ctrl-C ends it)\n"
    with pytest.raises(OSError, match="refused"):
        socket.create_connection((host, port), timeout=5)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--stride", "2"], "--stride needs --window"),
        (["--window", "3"], "--window must be at least 5 poses"),
        (["--window", "9", "--stride", "0"], "--stride must be at least 1"),
        (["--port", "70000"], "--port must be at most 65535, not 70000"),
    ],
)
def test_wrong_options_are_refused(options: list[str], problem: str, capsys: Any) -> None:
    with pytest.raises(SystemExit) as caught:
        program.main(["view", "a.csv", *options])
    assert caught.value.code == 2
    assert problem in capsys.readouterr().err

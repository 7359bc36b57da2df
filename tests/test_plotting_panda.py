"""Pictures and films of the arm: they show what they say, and fail with a reason."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
import pytest
from legible import check_legible

from benchmarks import charts
from reframe_jax.cli import program
from reframe_jax.plotting import arm as pictures_of
from reframe_jax.simulation import arm as panda
from reframe_jax.simulation import reproduction
from reframe_jax.simulation.arm import render

KEY = jax.random.key(11)
BATCH = 8  # the shape that other tests compile


@pytest.fixture(scope="module")
def made() -> panda.Demonstration:
    return jax.device_get(panda.demonstrate("I", KEY, batch=BATCH, spread=panda.SPREAD))


def test_demonstration(made: panda.Demonstration) -> None:
    figure = pictures_of.plot_demonstration(made[0], title="pin")
    space, motion, moments, forces = figure.axes
    limits = np.array([space.get_xlim(), space.get_ylim(), space.get_zlim()])
    np.testing.assert_allclose(np.ptp(limits, axis=1), np.ptp(limits[0]))
    assert {axes.get_xlim() for axes in (motion, moments, forces)} == {(0, 5)}
    labels = [axes.get_legend_handles_labels()[1] for axes in (motion, moments, forces)]
    assert labels[0] == ["turn y [rad]", "shift x [0.1 m]"]
    assert labels[1] == ["moment x [N m]", "moment z [N m]"]
    assert labels[2] == ["force y [N]", "force z [N]"]
    check_legible(figure)
    with pytest.raises(ValueError, match="index one first"):
        pictures_of.plot_demonstration(made)


def test_the_drawn_arm_ends_at_the_tcp(made: panda.Demonstration) -> None:
    for row, pose in zip(made.joint_positions[0, ::30], made.exact_poses[0, ::30], strict=True):
        points = pictures_of._joint_points(row, panda.PANDA)
        np.testing.assert_allclose(points[-1], pose[:3, 3], atol=1e-12)


def test_reactions() -> None:
    compared = jax.device_get(reproduction.compare("A", KEY, BATCH))
    figure = charts.plot_comparison({"A": compared}, title="Figure 5")
    assert [axes.get_title() for axes in figure.axes] == ["peak reaction moment", "peak reaction force"]
    heights = [bars[0].get_height() for bars in figure.axes[0].containers if hasattr(bars, "patches")]
    trials = compared.rows.values()
    np.testing.assert_allclose(heights, [np.mean(row.peak_moment) for row in trials])
    figure = charts.plot_reactions(compared, 2)
    drawn = figure.axes[0].get_lines()[0].get_ydata()
    np.testing.assert_allclose(np.max(drawn), compared.exact.peak_moment[2])


@pytest.fixture(scope="module")
def opengl() -> None:
    """Skips where MuJoCo by itself, in another process, can open no context: errors of ours fail."""
    environment = dict(os.environ)
    if sys.platform == "linux" and "DISPLAY" not in environment:
        environment.setdefault("MUJOCO_GL", "egl")
    script = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 64, 64)"
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, check=False)
    if done.returncode != 0:
        pytest.skip("MuJoCo can open no OpenGL context")


@pytest.mark.usefixtures("opengl")
def test_film(made: panda.Demonstration, tmp_path: Path) -> None:
    pictures = render.film_frames(made.joint_positions[0, ::25], made[0].truth, size=(160, 120))
    assert pictures.shape == (5, 120, 160, 3)
    blue, red = pictures[..., 2].astype(int), pictures[..., 0].astype(int)
    assert np.any(blue - red > 80)
    assert np.any(red - blue > 80)
    assert np.abs(np.diff(pictures.astype(int), axis=0)).max() > 50
    from PIL import Image

    render.save_film(tmp_path / "film.gif", pictures)
    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames == 5
    with pytest.raises(ValueError, match="must end in"):
        render.save_film(tmp_path / "film.avi", pictures)


def test_film_keeps_its_shades_and_its_few_coloured_pixels(tmp_path: Path) -> None:
    from PIL import Image

    shades = np.linspace(60, 240, 160 * 120).reshape(120, 160, 1).repeat(3, axis=2).astype(np.uint8)
    pictures = np.stack([shades] * 5)
    pictures[-1, 50:54, 60:70] = (0, 158, 115)
    pictures[:, 80:100, 100:140] = (0, 114, 178)
    render.save_film(tmp_path / "film.gif", pictures)
    with Image.open(tmp_path / "film.gif") as film:
        film.seek(film.n_frames - 1)
        off = np.abs(np.asarray(film.convert("RGB")).astype(int) - pictures[-1])
    assert off.mean() < 2
    assert off.max() < 10


def test_no_opengl(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise mujoco.FatalError("no context")

    monkeypatch.setattr(mujoco, "Renderer", fail)
    with pytest.raises(render.RenderError, match="MUJOCO_GL"):
        render.film_frames(np.zeros((1, 7)))


def test_command_writes_a_picture_and_says_why_there_is_no_film(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: Any) -> None:
        raise mujoco.FatalError("no context")

    monkeypatch.setattr(mujoco, "Renderer", fail)
    files = {name: str(tmp_path / name) for name in ("demos.npz", "demo.png", "demo.gif")}
    command = ["demonstrate", "--no-cache", "--constraint", "K", "--count", str(BATCH)]
    drawn = ["--plot", files["demo.png"], "--render", files["demo.gif"]]
    assert program.main([*command, "--out", files["demos.npz"], *drawn]) == 1
    assert "no film: OpenGL cannot render" in capsys.readouterr().err
    assert Path(files["demo.png"]).stat().st_size > 10_000
    assert Path(files["demos.npz"]).exists()
    assert not Path(files["demo.gif"]).exists()


def test_opengl_that_is_not_installed_is_named() -> None:
    """MuJoCo itself fails to load then, with a traceback from within PyOpenGL."""
    command = [sys.executable, "-c", "import reframe_jax.simulation.arm"]
    run = subprocess.run(
        command, env={**os.environ, "MUJOCO_GL": "nonsense"}, capture_output=True, text=True, check=False
    )
    assert run.returncode == 1
    assert "cannot be loaded with MUJOCO_GL=nonsense" in run.stderr

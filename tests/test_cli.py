"""The command line, in this process and on one compiled shape: windows of 21 poses, one at a time."""

import argparse
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax
from reframe_jax.cli import arguments, program, reading
from reframe_jax.cli import identify as command
from reframe_jax.constraints.catalogue import CONSTRAINTS, OTHER_CONSTRAINTS
from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.identification.entry import identify
from reframe_jax.motion.checks import Status
from reframe_jax.recordings.reading import load_recording
from reframe_jax.recordings.recording import Recording
from reframe_jax.recordings.writing import save_recording
from reframe_jax.simulation import synthetic

DATA = Path(__file__).parents[2] / "shared" / "data"
POSES = 21

Captured = pytest.CaptureFixture[str]


def simulate(path: Path, label: str = "A", *options: str) -> Path:
    assert program.main(["simulate", "--no-cache", "--constraint", label, "--out", str(path), *options]) == 0
    return path


@pytest.fixture(scope="module")
def door(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of 36 poses of a revolute joint, almost without noise."""
    path = tmp_path_factory.mktemp("cli") / "door.csv"
    return simulate(path, "A", "--duration", "3.5", "--noise", "1e-5")


@pytest.fixture
def clip(door: Path, tmp_path: Path) -> Path:
    """The first 21 poses of it."""
    recording = load_recording(door)
    path = tmp_path / "clip.csv"
    save_recording(path, recording.times[:POSES], recording.poses[:POSES])
    return path


def parse(*arguments: str | Path | int) -> argparse.Namespace:
    words = list(map(str, arguments))
    return program.build_parser(words).parse_args(words)


def run(*arguments: str | Path) -> int:
    return program.main(["identify", "--no-cache", *map(str, arguments)])


def read_json(text: str) -> list[dict[str, Any]]:
    document = json.loads(text)
    assert document["schema"] == "reframe-jax/identification/3"
    recordings: list[dict[str, Any]] = document["recordings"]
    return recordings


# identify


def test_explains_in_plain_words(tmp_path: Path, capsys: Captured) -> None:
    # of 51 poses, as in most tests of the covariance, which share its program
    assert run(simulate(tmp_path / "door.csv", "A", "--noise", "1e-5"), "--explain") == 0
    lines = capsys.readouterr().out.strip().splitlines()
    words = lines[next(i for i, line in enumerate(lines) if line.startswith("The body moves")) :]
    assert words[0].startswith("The body moves like a door on its hinge")
    assert words[1].startswith("Along the constrained axes the RMS displacement is at most ")
    assert "(95 %)" in words[2]
    assert words[2].endswith("Any point on this axis is equally valid.")
    assert words[3].startswith("It turns about the direction")
    assert words[4].startswith("The motion covered a single path;")
    assert words[5].startswith("To check, try to turn the body")
    assert len(words) == 6


def test_a_recording_is_identified(clip: Path, tmp_path: Path, capsys: Captured) -> None:
    assert run(clip, "--json", tmp_path / "out.json") == 0
    out, err = capsys.readouterr()
    (heading, noise) = (out.splitlines()[i] for i in (0, -2))
    assert re.fullmatch(re.escape(f"{clip}: Revolute joint (") + r"(0\.\d\d|>0\.99)\)", heading)
    assert re.fullmatch(r"Noise   .* mm, .* deg; blocks of \d+ samples? \(0\.\d+ s\)", noise)
    assert err == ""
    (recording,) = read_json((tmp_path / "out.json").read_text())
    (window,) = recording["windows"]
    assert (window["label"], window["status"], window["start"], window["stop"]) == ("A", "OK", 0, POSES)
    read = load_recording(clip)
    assert (window["start_time"], window["stop_time"]) == (read.times[0], read.times[-1])
    found = identify(read.poses, times=read.times)
    np.testing.assert_allclose(window["linear"]["position"], found.linear.position, atol=1e-9)
    assert window["probability"] == pytest.approx(found.probability)
    assert (window["scale"], window["outliers"], window["notes"]) == (int(found.scale), [], [])
    # the hinge of the simulations: y through (0.1, -, 0.1), which is where the body starts
    np.testing.assert_allclose(np.array(window["linear"]["position"])[[0, 2]], [0.1, 0.1], atol=2e-3)
    (direction,) = window["linear"]["free_position"]
    np.testing.assert_allclose(np.abs(direction), [0, 1, 0], atol=1e-3)


def test_json_on_standard_output_stands_alone(clip: Path, capsys: Captured) -> None:
    assert run(clip, "--json", "-") == 0
    (recording,) = read_json(capsys.readouterr().out)
    assert recording["recording"] == str(clip)


def test_one_bad_file_does_not_stop_the_others(clip: Path, tmp_path: Path, capsys: Captured) -> None:
    bad, missing = tmp_path / "bad.csv", tmp_path / "missing.csv"
    bad.write_text("t,x,y,z\n0,0,0,0\n")
    assert run(bad, clip, missing, "--json", tmp_path / "out.json") == 1
    out, err = capsys.readouterr()
    assert out.count("Revolute joint") == 1
    first, second = err.splitlines()
    assert first.startswith(f"reframe-jax: error: {bad}: no column for qx")
    assert second == f"reframe-jax: error: {missing}: cannot be read: No such file or directory."
    records = read_json((tmp_path / "out.json").read_text())
    assert [record["error"] is None for record in records] == [False, True, False]
    assert [len(record["windows"]) for record in records] == [0, 1, 0]


@pytest.mark.parametrize("error", [MemoryError("too large"), ValueError("no"), ZeroDivisionError("by zero")])
def test_no_error_of_a_file_loses_the_others(
    clip: Path, tmp_path: Path, capsys: Captured, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    bad = tmp_path / "bad.csv"
    bad.write_text(clip.read_text())

    def load(path: Path, **options: Any) -> Recording:
        if path == bad:
            raise error
        return load_recording(path, **options)

    monkeypatch.setattr(reading, "load_recording", load)
    assert run(clip, bad, "--json", "-") == 1
    out, err = capsys.readouterr()
    problem = f"{bad}: {type(error).__name__}: {error}"
    assert err == f"reframe-jax: error: {problem}\n"
    first, second = read_json(out)
    assert (len(first["windows"]), first["error"]) == (1, None)
    assert second["error"] == problem


def test_repaired_input_is_noted(clip: Path, capsys: Captured) -> None:
    lines = clip.read_text().splitlines()
    lines.insert(4, lines[3])
    clip.write_text("\n".join(lines))
    assert run(clip, "--json", "-") == 0
    out, err = capsys.readouterr()
    assert err == f"reframe-jax: {clip}: line 5 left out: the previous row is repeated.\n"
    assert read_json(out)[0]["notes"] == ["line 5 left out: the previous row is repeated."]


def test_outliers_are_left_out_and_told(door: Path, tmp_path: Path, capsys: Captured) -> None:
    recording = load_recording(door)
    recording.poses[15, :3, :3] = recording.poses[15, :3, :3] @ np.diag([-1.0, -1.0, 1.0])
    bad = tmp_path / "bad.csv"
    save_recording(bad, recording.times[:-1], recording.poses[:-1])
    assert run(bad, "--json", tmp_path / "out.json") == 0
    out, err = capsys.readouterr()
    jump = "the pose jumps 180 deg at line 17 and back at line 18"
    assert err == f"reframe-jax: {bad}: {jump}; if tracking was lost there, remove these rows.\n"
    assert "; 1 pose left out: sample 15\n" in out
    assert out.rstrip().endswith("line 17: the pose jumps away from its neighbours and back")
    (recording,) = read_json((tmp_path / "out.json").read_text())
    (window,) = recording["windows"]
    assert (window["label"], window["outliers"]) == ("A", [15])


def test_unit_and_sample_time(clip: Path, tmp_path: Path, capsys: Captured) -> None:
    recording = load_recording(clip)
    poses = recording.poses.copy()
    poses[:, :3, 3] *= 1000
    np.save(tmp_path / "a.npy", poses)
    assert run(tmp_path / "a.npy", "--unit", "mm", "--dt", "0.1", "--json", "-") == 0
    (scaled,) = read_json(capsys.readouterr().out)
    assert run(clip, "--json", "-") == 0
    (expected,) = read_json(capsys.readouterr().out)
    for name in ("position", "rms", "norm"):
        np.testing.assert_allclose(
            scaled["windows"][0]["linear"][name], expected["windows"][0]["linear"][name], rtol=1e-5
        )
    assert run(tmp_path / "a.npy", "--unit", "mm") == 1
    assert "the sample time, dt (--dt)" in capsys.readouterr().err


def test_a_body_at_rest_is_an_error(clip: Path, tmp_path: Path, capsys: Captured) -> None:
    recording = load_recording(clip)
    save_recording(clip, recording.times, np.repeat(recording.poses[:1], POSES, axis=0))
    assert run(clip, "--plot", tmp_path / "out.png") == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines()[-1] == f"reframe-jax: error: {clip}: {Status.NO_MOTION.message}"
    assert not (tmp_path / "out.png").exists()


def test_what_is_odd_about_a_result_is_said(clip: Path, capsys: Captured) -> None:
    assert run(clip, "--angular-threshold", "50", "--linear-threshold", "50") == 0
    assert Status.NOT_EXCITED.message in capsys.readouterr().out


def test_options_reach_the_identification(clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, Any] = {}

    def spy(poses: np.ndarray, *, times: np.ndarray, **options: Any) -> Any:
        seen.clear()
        seen.update(options)
        return identify(poses, times=times)

    monkeypatch.setattr(command, "identify", spy)
    options = ["--norm=-inf", "--discretization", "left", "--bounds", "0.5", "--linear-threshold", "0.01"]
    assert run(clip, *options) == 0
    thresholds = seen.pop("thresholds")
    assert (thresholds.angular, thresholds.linear) == (0.160, 0.01)
    assert seen == {
        "scales": "auto",
        "assume": None,
        "norm": -np.inf,
        "discretization": "left",
        "bounds": 0.5,
    }
    assert run(clip, "--angular-threshold", "0.3") == 0
    assert (seen["thresholds"].angular, seen["thresholds"].linear) == (0.3, 0.037)
    for text, scales in (("auto", "auto"), ("1", (1,)), ("1,2", (1, 2))):
        assert run(clip, "--scales", text, "--assume", "hinge") == 0
        assert (seen["scales"], seen["assume"], seen["thresholds"]) == (scales, "hinge", None)


@pytest.mark.parametrize("count", [1, 3])
def test_windows(
    door: Path, tmp_path: Path, capsys: Captured, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    """Also in chunks of which the last one is not full."""
    sizes = []

    def one_by_one(poses: np.ndarray, *, times: np.ndarray, **options: Any) -> Any:
        sizes.append(len(poses))
        parts = [identify(poses[i, None], times=times[i, None], **options) for i in range(len(poses))]
        return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)

    monkeypatch.setattr(command, "identify", one_by_one)
    monkeypatch.setattr(command, "_CHUNK", count)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    options = ["--window", str(POSES), "--stride", "5", "--json", str(tmp_path / "out.json")]
    assert run(door, *options) == 0
    assert sizes == ([1, 1, 1, 1] if count == 1 else [3, 1])
    out, err = capsys.readouterr()
    lines = out.splitlines()
    assert lines[0] == f"{door}: 4 windows"
    assert [line.split()[0] for line in lines[2:6]] == ["0", "1", "2", "3"]
    assert re.search(r"\r\[#+\] 4 of 4 windows, .*\n$", err)
    (recording,) = read_json((tmp_path / "out.json").read_text())
    read = load_recording(door)
    for i, window in enumerate(recording["windows"]):
        part = slice(5 * i, 5 * i + POSES)
        assert (window["index"], window["start"], window["stop"]) == (i, part.start, part.stop)
        assert window["stop_time"] == read.times[part][-1]
        found = identify(read.poses[part][None], times=read.times[part][None])[0]
        np.testing.assert_allclose(window["linear"]["norm"], found.linear.norm, rtol=1e-12)


def test_interruptions_leave_no_traceback(clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*arguments: Any, **options: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "identify", interrupt)
    assert run(clip) == 130


def test_windows_do_not_overlap_by_default(
    door: Path, capsys: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "_CHUNK", 1)
    assert run(door, "--window", "21", "--json", "-") == 0
    (recording,) = read_json(capsys.readouterr().out)
    assert len(recording["windows"]) == 1  # 36 poses hold one window of 21, and a rest


def test_windows_longer_than_the_recording(clip: Path, capsys: Captured) -> None:
    assert run(clip, "--window", "22") == 1
    assert capsys.readouterr().err == (
        f"reframe-jax: error: {clip}: has 21 poses; expected at least 22, the length of a window.\n"
    )


def test_plots(clip: Path, tmp_path: Path, capsys: Captured, monkeypatch: pytest.MonkeyPatch) -> None:
    other = tmp_path / "other.csv"
    other.write_text(clip.read_text())
    assert run(clip, "--plot", tmp_path / "out.png") == 0
    assert (tmp_path / "out.png").read_bytes().startswith(b"\x89PNG")
    assert run(clip, other, "--plot", tmp_path / "many.png") == 0
    assert {path.name for path in tmp_path.glob("many*")} == {"many-clip.png", "many-other.png"}
    capsys.readouterr()
    (tmp_path / "taken.png").mkdir()
    monkeypatch.setattr(Path, "is_dir", lambda path: path == tmp_path)  # as if it came into being meanwhile
    assert run(clip, "--plot", tmp_path / "taken.png") == 1
    assert capsys.readouterr().err.startswith(f"reframe-jax: error: {tmp_path / 'taken.png'}: cannot be writ")


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("", "--plot must name a file; .* is a directory"),
        ("folder.png", "--plot must name a file; .* is a directory"),
        ("out.strange", r"--plot must end in .png, .pdf, .svg, .jpg, .webp, not 'out.strange'"),
        ("out", "--plot must end in .*, not 'out'"),
        ("none/out.png", "--plot: there is no directory"),
    ],
)
def test_pictures_that_could_not_be_written(
    clip: Path, tmp_path: Path, capsys: Captured, name: str, problem: str
) -> None:
    """Are refused before anything is computed, and nothing is written elsewhere."""
    (tmp_path / "folder.png").mkdir()
    before = set(tmp_path.rglob("*"))
    with pytest.raises(SystemExit) as caught:
        run(clip, "--plot", tmp_path / name)
    assert caught.value.code == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert re.search(problem, err)
    assert set(tmp_path.rglob("*")) == before
    assert not tmp_path.with_suffix(".png").exists()


@pytest.mark.usefixtures("no_matplotlib")
def test_plots_without_matplotlib(clip: Path, capsys: Captured) -> None:
    assert run(clip, "--plot", "out.png") == 1
    out, err = capsys.readouterr()
    assert "Revolute joint" in out
    assert 'pip install "reframe-jax[plot]"' in err


def test_results_that_could_not_be_written(clip: Path, tmp_path: Path, capsys: Captured) -> None:
    """Are refused before anything is computed."""
    for target, problem in (
        (tmp_path / "none" / "out.json", "there is no directory"),
        (tmp_path, "must name a file"),
    ):
        with pytest.raises(SystemExit) as caught:
            run(clip, "--json", target)
        assert caught.value.code == 2
        out, err = capsys.readouterr()
        assert out == ""
        assert problem in err


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a full device")
def test_results_that_cannot_be_written(clip: Path, capsys: Captured) -> None:
    assert run(clip, "--json", "/dev/full") == 1
    assert capsys.readouterr().err.startswith("reframe-jax: error: /dev/full: cannot be written")


@pytest.mark.skipif(not DATA.is_dir(), reason="needs the real recordings, in ../shared/data")
def test_real_recordings(capsys: Captured, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "_CHUNK", 1)
    files = sorted(DATA.glob("*.csv"))
    assert run(*files, "--window", str(POSES), "--stride", "60", "--json", "-") == 0
    for path, recording in zip(files, read_json(capsys.readouterr().out), strict=True):
        samples = len(load_recording(path).times)
        assert len(recording["windows"]) == (samples - POSES) // 60 + 1
        assert all(window["name"] for window in recording["windows"])


# simulate, constraints, and the rest


def test_simulations_repeat(door: Path, tmp_path: Path, capsys: Captured) -> None:
    assert len(load_recording(door).times) == 36
    options = ["--duration", "1", "--noise", "1e-3"]
    first, again, other, npz = (
        load_recording(simulate(tmp_path / name, label, *options, "--seed", seed))
        for name, label, seed in (
            ("a.csv", "pin-plane contact", "1"),
            ("b.csv", "k", "1"),
            ("c.csv", "K", "2"),
            ("d.npz", "K", "1"),
        )
    )
    assert f"{tmp_path / 'a.csv'}: Pin-plane contact, 11 poses" in capsys.readouterr().out
    np.testing.assert_array_equal(first.poses, again.poses)
    np.testing.assert_allclose(first.poses, npz.poses, atol=1e-14)
    assert np.abs(first.poses - other.poses).max() > 1e-3
    np.testing.assert_allclose(first.times, 0.1 * np.arange(11), atol=1e-12)


def test_options_reach_the_simulation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, Any] = {}

    def spy(constraint: str, key: jax.Array, noise: jax.Array, **options: Any) -> synthetic.Simulation:
        seen.update(options, constraint=constraint)
        poses = jnp.tile(jnp.eye(4), (6, 1, 1)) * (1 + 0 * noise)
        truth = ConstraintFrame.named(constraint)
        return synthetic.Simulation(times=jnp.arange(6.0), poses=poses, exact_poses=poses, truth=truth)

    monkeypatch.setattr(synthetic, "simulate", spy)
    simulate(tmp_path / "a.csv", "cylinder joint")
    defaults = {"constraint": "C", "duration": 5.0, "dt": 0.1, "excitation": "exciting", "exact": True}
    assert seen == defaults
    options = ["--duration", "2", "--dt", "0.5", "--excitation", "paper", "--generator", "paper"]
    simulate(tmp_path / "a.csv", "C", *options)
    assert seen == {"constraint": "C", "duration": 2.0, "dt": 0.5, "excitation": "paper", "exact": False}


def test_simulations_that_cannot_be_written(tmp_path: Path, capsys: Captured) -> None:
    arguments = ["simulate", "--no-cache", "--constraint", "K", "--out", str(tmp_path / "a.txt")]
    with pytest.raises(SystemExit) as stopped:
        program.main([*arguments, "--duration", "1"])
    assert stopped.value.code == 2
    assert "--out must end in .csv, .npz, not 'a.txt'" in capsys.readouterr().err


def test_outputs_replace_neither_recordings_nor_each_other(
    door: Path, tmp_path: Path, capsys: Captured
) -> None:
    recording = tmp_path / "a.csv"
    recording.write_bytes(door.read_bytes())
    same = str(tmp_path / "b.xml")
    for outputs, problem in (
        (["--csv", str(recording)], f"--csv would replace the recording {recording}"),
        (["--urdf", same, "--mjcf", same], f"--urdf and --mjcf name the same file, {same}"),
    ):
        with pytest.raises(SystemExit) as stopped:
            program.main(["identify", "--no-cache", str(recording), *outputs])
        assert stopped.value.code == 2
        assert problem in capsys.readouterr().err
    assert recording.read_bytes() == door.read_bytes()


def test_sentences_are_not_dropped_without_a_word(door: Path, capsys: Captured) -> None:
    with pytest.raises(SystemExit):
        program.main(["identify", str(door), "--json", "-", "--explain"])
    assert "--explain prints sentences, and --json - only JSON" in capsys.readouterr().err


def test_a_summary_with_thresholds_has_no_probabilities(door: Path, capsys: Captured) -> None:
    arguments = ["identify", "--no-cache", "--summary", "--angular-threshold", "0.1", str(door)]
    assert program.main(arguments) == 0
    printed = capsys.readouterr().out
    assert "nan" not in printed
    assert re.search(r"Revolute joint +- ", printed)


def test_the_catalogue_is_listed(capsys: Captured) -> None:
    assert program.main(["constraints"]) == 0
    rows = capsys.readouterr().out.splitlines()[1:18]
    for row, entry in zip(rows, (CONSTRAINTS | OTHER_CONSTRAINTS).values(), strict=True):
        assert row.split()[0] == entry.label
        assert entry.name in row
    assert rows[10].split()[-4:] == ["111", "110", "GB", "xyz"]
    assert rows[1].split()[-4:] == ["000", "100", "any", "-"]


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ([], "required: COMMAND"),
        (["identify"], "required: FILE"),
        (["identify", "a.csv", "--norm", "3"], "must lie in"),
        (["identify", "a.csv", "--norm", "x"], "expected a number, not 'x'"),
        (["identify", "a.csv", "--window", "long"], "expected a whole number, not 'long'"),
        (["identify", "a.csv", "--dt", "0"], "expected a positive number"),
        (["identify", "a.csv", "--dt", "fast"], "expected a positive number, not 'fast'"),
        (["identify", "a.csv", "--dt", "1e-200"], "from 1e-09 to 1e\\+06, not 1e-200"),
        (["identify", "a.csv", "--bounds", "1e200"], "from 1e-06 to 1e\\+06, not 1e200"),
        (["identify", "a.csv", "--bounds", "nan"], "from 1e-06 to 1e\\+06, not nan"),
        (["simulate", "--constraint", "A", "--out", "a.csv", "--duration", "1e300"], "not 1e300"),
        (["simulate", "--constraint", "A", "--out", "a.csv", "--noise", "1e200"], "to 1e\\+06, not 1e200"),
        (
            ["simulate", "--constraint", "A", "--out", "a.csv", "--dt", "1e-9"],
            "makes 5000000001 poses; expected 5 to 8388608",
        ),
        (["demonstrate", "--constraint", "A", "--out", "a", "--dt", "1e-9"], "at most 100000 times --dt"),
        (["identify", "a.csv", "--unit", "inch"], "invalid choice"),
        (["identify", "a.csv", "--scales", "long"], "expected auto, .* such as 1 or 4,8,16, not 'long'"),
        (["identify", "a.csv", "--scales", "0"], "expected auto, .*, not '0'"),
        (["identify", "a.csv", "--scales", "1,2.5"], "expected auto, .*, not '1,2.5'"),
        (
            ["identify", "a.csv", "--assume", "wheel"],
            "No constraint 'wheel'; choose from A, .*hinge.*reframe-jax constraints",
        ),
        (
            ["identify", "a.csv", "--clean"],
            "identify: error: unrecognized arguments: --clean; see .* identify",
        ),
        (["constraints", "all"], "constraints: error: unrecognized arguments: all; see .* constraints"),
        (["identify", "a.csv", "--stride", "2"], "--stride needs --window"),
        (["identify", "a.csv", "--window", "4"], "--window must be at least 5"),
        (["identify", "a.csv", "--window", "9", "--stride", "0"], "--stride must be at least 1"),
        (["identify", "a.csv", "--window", "9", "--plot", "a.png"], "remove --window"),
        (["identify", "a/a.csv", "b/a.csv", "--plot", "a.png"], "different names"),
        (["simulate", "--out", "a.csv", "--constraint", "Z"], r"A \(Revolute joint\)"),
        (["reproduce", "--constraint", "spherical"], "expected a constraint from A to L"),
        (["simulate", "--constraint", "A"], "required: --out"),
        (["simulate", "--constraint", "A", "--out", "a.csv", "--noise", "-1"], "from 0 to 1e\\+06, not -1"),
        (["simulate", "--constraint", "A", "--out", "a.csv", "--noise", "nan"], "from 0 to 1e\\+06, not nan"),
        (["simulate", "--constraint", "A", "--out", "a.csv", "--seed", str(2**70)], "whole number from 0 to"),
        (["simulate", "--constraint", "A", "--out", "a.csv", "--dt", "10"], "makes 1 poses; expected 5"),
        (
            ["demonstrate", "--constraint", "A", "--out", "a", "--count", "many"],
            "expected a positive whole number",
        ),
    ],
)
def test_wrong_command_lines(arguments: list[str], problem: str, capsys: Captured) -> None:
    with pytest.raises(SystemExit) as caught:
        program.main(arguments)
    assert caught.value.code == 2
    err = capsys.readouterr().err
    (line,) = err.splitlines()
    assert re.fullmatch(r"reframe-jax.*: error: .*; see reframe-jax.* --help", line)
    assert re.search(problem, line)


def test_a_window_that_any_motion_fits_is_noted(clip: Path, tmp_path: Path, capsys: Captured) -> None:
    recording = load_recording(clip)
    save_recording(clip, recording.times[:6], recording.poses[:6])
    assert run(clip, "--json", tmp_path / "out.json") == 0
    (note,) = read_json((tmp_path / "out.json").read_text())[0]["windows"][0]["notes"]
    assert note.startswith("The window has only 6 poses (5 steps)")
    assert note in capsys.readouterr().out.splitlines()


def test_axes_close_to_a_threshold_are_noted(clip: Path, capsys: Captured) -> None:
    assert run(clip, "--angular-threshold", "1e-9", "--linear-threshold", "1e-9") == 0
    assert "close to the threshold" not in capsys.readouterr().err
    rms = identify(load_recording(clip).poses, times=load_recording(clip).times).angular.rms
    fast = float(rms[2])
    assert run(clip, "--angular-threshold", f"{1.2 * fast}", "--json", "-") == 0
    captured = capsys.readouterr()
    assert f"close to the threshold: angular axis 3 ({fast:.3g} rad/s" in captured.err
    (window,) = read_json(captured.out)[0]["windows"]
    assert any("close to the threshold" in note for note in window["notes"])


def test_compiled_programs_are_kept_unless_switched_off(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[None] = []
    monkeypatch.setattr(arguments, "cache_programs", lambda: calls.append(None))
    arguments.configure_jax(cache=False)
    monkeypatch.setenv("REFRAME_JAX_CACHE", "0")
    arguments.configure_jax(cache=True)
    assert not calls
    monkeypatch.delenv("REFRAME_JAX_CACHE")
    arguments.configure_jax(cache=True)
    assert len(calls) == 1


def test_help_shows_examples(capsys: Captured) -> None:
    with pytest.raises(SystemExit) as caught:
        program.main(["identify", "--help"])
    assert caught.value.code == 0
    out = capsys.readouterr().out
    assert "reframe-jax identify door.csv --plot door.png" in out
    assert "reframe-jax calibrate" not in out
    assert "delete the folder reframe_jax" in " ".join(out.split())


def test_the_module_runs() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "reframe_jax", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout == f"reframe-jax {reframe_jax.__version__}\n"

"""Files for other programs, and tables of many recordings, from the command line."""

import argparse
import csv
import json
import re
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
import yaml

from reframe_jax.cli import identify as command
from reframe_jax.cli import program
from reframe_jax.cli.reading import expand
from reframe_jax.identification.entry import identify
from reframe_jax.recordings.reading import load_recording
from reframe_jax.recordings.writing import save_recording

POSES = 21  # one compiled shape for all tests

Captured = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a door (revolute), a pen (on a plane), and a file that is no recording."""
    folder = tmp_path_factory.mktemp("recordings")
    simulate(folder / "door.csv", "A")
    simulate(folder / "pen.csv", "K")
    (folder / "notes.csv").write_text("t,x,y,z\n0,0,0,0\n")
    return folder


def simulate(path: Path, label: str) -> None:
    words = f"simulate --no-cache --constraint {label} --noise 1e-5 --duration 3.5 --seed 1".split()
    assert program.main([*words, "--out", str(path)]) == 0
    recording = load_recording(path)
    save_recording(path, recording.times[:POSES], recording.poses[:POSES])


def run(*arguments: str | Path) -> int:
    return program.main(["identify", "--no-cache", *map(str, arguments)])


def test_a_recording_becomes_robot_descriptions(recordings: Path, tmp_path: Path, capsys: Captured) -> None:
    door = recordings / "door.csv"
    options: list[str | Path] = []
    for name in ("urdf", "mjcf", "sdf"):
        options += [f"--{name}", tmp_path / f"door.{name}"]
    options += ["--task-frame", tmp_path / "door.yaml", "--parent", "wall", "--child", "door"]
    assert run(door, *options) == 0
    assert capsys.readouterr().err == ""
    recording = load_recording(door)
    joint = identify(recording.poses, times=recording.times).to_joint(recording.poses)
    for name in ("urdf", "mjcf"):
        model = mujoco.MjModel.from_xml_path(str(tmp_path / f"door.{name}"))
        assert model.njnt == 1
        assert joint.range is not None
        np.testing.assert_allclose(model.jnt_range[0], joint.range, atol=1e-5)
        assert model.body("door").id > model.body("wall").id > 0
    model = ElementTree.parse(tmp_path / "door.sdf").getroot()
    assert [link.get("name") for link in model.iter("link")] == ["wall", "door"]
    task = yaml.safe_load((tmp_path / "door.yaml").read_text())
    assert task["header"]["frame_id"] in ("wall", "door")
    assert sum(task["control"]["motion_selection"]) == 1


def test_what_a_format_cannot_say_is_one_line(recordings: Path, tmp_path: Path, capsys: Captured) -> None:
    """And the other recordings and formats are written all the same."""
    cart, out = tmp_path / "cart.csv", tmp_path / "out"
    simulate(cart, "G")
    out.mkdir()
    task = out / "task.json"
    files = recordings / "[dp]*.csv", cart
    assert run(*files, "--urdf", out / "a.urdf", "--mjcf", out / "a.xml", "--task-frame", task) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(
        f"reframe-jax: error: {cart}: URDF and MJCF cannot express 'Cart on a curved surface'."
    )
    assert line.count("Cart") == 1
    written = {"a-door.urdf", "a-door.xml", "a-pen.urdf", "a-pen.xml"}
    written |= {f"task-{name}.json" for name in ("cart", "door", "pen")}
    assert {path.name for path in out.iterdir()} == written
    assert json.loads((out / "task-pen.json").read_text())["constraint"] == "Pin-plane contact"


def test_what_a_chain_does_not_hold_is_said(tmp_path: Path, capsys: Captured) -> None:
    recording, out = tmp_path / "blade.csv", tmp_path / "a.urdf"
    simulate(recording, "E")
    assert run(recording, "--urdf", out, "--child", "blade") == 0
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1].startswith(
        f"reframe-jax: {recording}: The chain constrains the plane of the motion only."
    )
    assert mujoco.MjModel.from_xml_path(str(out)).njnt == 3


def test_patterns_end_with_one_table(recordings: Path, tmp_path: Path, capsys: Captured) -> None:
    assert run(str(recordings / "*.csv"), "--csv", tmp_path / "out.csv") == 1
    out, err = capsys.readouterr()
    assert err.count("notes.csv: no column for qx") == 1
    header, *rows = out.splitlines()[-4:]
    assert header.split("  ")[0] == "recording"
    assert [Path(row.split()[0]).name for row in rows] == ["door.csv", "notes.csv", "pen.csv"]
    assert "Revolute joint" in rows[0]
    assert rows[1].split()[1:] == ["0", *"-" * 6, "error"]
    assert rows[2].split()[-1] == "OK"
    assert "Linear frame" in out
    with (tmp_path / "out.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [Path(row["recording"]).name for row in table] == ["door.csv", "pen.csv"]
    assert [row["label"] for row in table] == ["A", "K"]


def test_summaries_stand_alone(recordings: Path, tmp_path: Path, capsys: Captured) -> None:
    door = recordings / "door.csv"
    assert run(door, "--summary", "--parquet", tmp_path / "out.parquet") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2
    parquet = pytest.importorskip("pyarrow.parquet")
    assert parquet.read_table(tmp_path / "out.parquet")["name"].to_pylist() == ["Revolute joint"]


def test_windows_are_counted_in_the_summary() -> None:
    def window(name: str | None, status: str) -> dict[str, Any]:
        return {"name": name, "status": status}

    windows = [window("Revolute joint", "OK"), window(None, "NO_MOTION"), window("Revolute joint", "OK")]
    table = command.summary_table([{"recording": "a.csv", "windows": windows, "error": None}])
    row = table.splitlines()[1]
    assert row.startswith("a.csv      3        Revolute joint (2 of 3)")
    assert row.endswith("2 OK, 1 NO_MOTION")


def test_many_recordings_show_their_progress(
    recordings: Path, capsys: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    assert run(recordings / "door.csv", recordings / "pen.csv", "--summary") == 0
    err = capsys.readouterr().err
    assert "[##########----------] 1 of 2 recordings" in err
    assert err.rstrip(" \n").split("\r")[-1].startswith("[####################] 2 of 2 recordings")


def test_patterns_that_match_nothing_are_missing_files(tmp_path: Path, capsys: Captured) -> None:
    assert run(tmp_path / "*.csv") == 1
    problem = f"{tmp_path / '*.csv'}: cannot be read: No such file or directory."
    assert capsys.readouterr().err == f"reframe-jax: error: {problem}\n"
    odd = tmp_path / "run[1].csv"
    odd.write_text("t,x,y,z\n")
    assert expand([odd]) == [odd]
    assert expand([tmp_path / "**" / "run*"]) == [odd]


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--urdf", "{folder}"], "--urdf must name a file; .* is a directory"),
        (["--sdf", "{folder}/no/a.sdf"], "--sdf: there is no directory"),
        (["--csv", "{folder}/no/a.csv"], "--csv: there is no directory"),
        (["--mjcf", "a.xml", "--window", "9"], "--mjcf describes whole recordings: remove --window"),
        (["b/a.csv", "--urdf", "a.urdf"], "--urdf needs recordings with different names"),
        (["--task-frame", "a.txt"], "--task-frame must end in .yaml, .yml, .json, not 'a.txt'"),
        (["--parent", "body"], "--parent and --child must be two different names"),
    ],
)
def test_wrong_exports_are_refused_at_once(
    options: list[str], problem: str, tmp_path: Path, capsys: Captured
) -> None:
    with pytest.raises(SystemExit) as caught:
        run("a.csv", *(option.format(folder=tmp_path) for option in options))
    assert caught.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("reframe-jax identify: error: ")
    assert re.search(problem, line)


def test_files_that_cannot_be_written_are_told(
    recordings: Path, tmp_path: Path, capsys: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*arguments: Any, **options: Any) -> Any:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    out = tmp_path / "a.urdf"
    assert run(recordings / "door.csv", "--urdf", out) == 1
    problem = f"{out}: cannot be written: No space left on device."
    assert capsys.readouterr().err == f"reframe-jax: error: {problem}\n"
    monkeypatch.setattr(Path, "open", full)
    assert run(tmp_path / "missing.csv", "--csv", out) == 1
    assert f"{out}: not written: no recording has a result." in capsys.readouterr().err


# parser


def test_the_full_parser_reads_what_the_lean_one_does() -> None:
    words = ["identify", "a.csv", "--scales", "1,2"]
    full, lean = (program.build_parser(each).parse_args(words) for each in (program.COMMANDS, words))

    def plain(options: argparse.Namespace) -> dict[str, Any]:
        return {name: value for name, value in vars(options).items() if name != "usage_error"}

    assert plain(full) == plain(lean)

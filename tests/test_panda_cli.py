"""The commands that simulate the arm, in this process and on one compiled shape."""

from pathlib import Path

import numpy as np
import pytest

from reframe_jax.cli import demonstrate, program
from reframe_jax.recordings.reading import load_recording
from reframe_jax.simulation import arm as panda

COUNT = "8"


def test_demonstrations_of_all_in_one_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "demos.npz"
    command = ["demonstrate", "--no-cache", "--constraint", "K", "--count", COUNT, "--out", str(path)]
    assert program.main(command) == 0
    assert "8 demonstrations of 5 s" in capsys.readouterr().out
    with np.load(path) as made:
        assert made["poses"].shape == (8, 101, 4, 4)
        assert made["joint_positions"].shape == (8, 101, 7)
        assert made["true_position"].shape == (8, 3)
        assert str(made["true_linear_type"]) == "GB"
        assert not np.any(made["status_code"])
        assert len(np.unique(made["true_position"][:, 0])) == 8
    # one key, one demonstration
    assert program.main([*command[:-1], str(tmp_path / "again.npz")]) == 0
    with np.load(path) as first, np.load(tmp_path / "again.npz") as again:
        np.testing.assert_array_equal(first["poses"], again["poses"])


def test_demonstrations_in_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(demonstrate, "_CHUNK", int(COUNT))
    folder = tmp_path / "demos"
    command = ["demonstrate", "--no-cache", "--constraint", "K", "--out", str(folder)]
    assert program.main([*command, "--count", "1"]) == 0
    first = (folder / "part-00000000.npz").stat().st_mtime_ns
    assert program.main([*command, "--count", "10"]) == 0
    assert (folder / "part-00000000.npz").stat().st_mtime_ns == first
    parts = list(panda.stored_demonstrations(folder))
    number = sum(len(part.poses) for part in parts)
    assert f"{folder}: {number} demonstrations of 5 s" in capsys.readouterr().out
    assert number >= 10
    assert len(parts) == 2
    assert program.main([*command, "--count", "10", "--seed", "1"]) == 1
    assert "other options" in capsys.readouterr().err


def test_demonstrations_as_recordings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "demo.csv"
    command = ["demonstrate", "--no-cache", "--constraint", "pin-plane contact", "--count", COUNT]
    assert program.main([*command, "--out", str(path), "--fixed", "--keep"]) == 0
    files = sorted(tmp_path.glob("demo-*.csv"))
    assert f"{files[0]} to {files[-1]}: 8 demonstrations of 5 s" in capsys.readouterr().out
    assert [file.name for file in files][:2] == ["demo-000.csv", "demo-001.csv"]
    assert len(files) == 8
    recording = load_recording(files[0])
    assert recording.poses.shape == (101, 4, 4)
    np.testing.assert_allclose(recording.poses[0, :3, 3], [0.379, 0, 0.506], atol=1e-3)


def test_reproduction(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["reproduce", "--no-cache", "--constraint", "A", "--trials", COUNT]
    assert program.main(command) == 0
    out = capsys.readouterr().out
    assert "Revolute joint, 8 trials" in out
    assert "angular axis" in out
    assert "position" in out
    assert "linear axis" not in out
    for row in ("exact", "identified"):
        line = next(line for line in out.splitlines() if line.startswith(row))
        assert "100 %" in line


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--constraint", "Z", "--out", "x.npz"], "No constraint 'Z'"),
        (["--constraint", "A", "--out", "x.gif"], "--out must end in .npz, .csv, not"),
        (["--constraint", "A", "--out", "x.npz", "--count", "0"], "whole number from 1 to inf, not 0"),
        (["--constraint", "A", "--out", "x.npz", "--count", "2.5"], "positive whole number, not '2.5'"),
        (["--constraint", "A", "--out", "x.npz", "--seed", "9" * 20], "whole number from 0 to 9.22337e+18"),
        (["--constraint", "A", "--out", "nowhere/x.npz"], "there is no directory nowhere"),
        (["--constraint", "A", "--out", "x.npz", "--plot", "nowhere/x.png"], "there is no directory nowhere"),
        (["--constraint", "A", "--out", "x.npz", "--plot", "x.txt"], "--plot must end in .png, .pdf"),
        (["--constraint", "A", "--out", "x.npz", "--duration", "0.01"], "--dt must not be longer"),
    ],
)
def test_wrong_command(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        program.main(["demonstrate", *arguments])
    assert ended.value.code == 2
    assert message in capsys.readouterr().err


def test_output_that_cannot_be_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "file"
    file.write_text("")
    command = ["demonstrate", "--no-cache", "--constraint", "A", "--out"]
    for path, message in (
        (file, f"{file} is a file; expected a folder for the demonstrations."),
        (file / "folder", f"{file / 'folder'}: cannot be written: Not a directory."),
    ):
        assert program.main([*command, str(path)]) == 1
        assert message in capsys.readouterr().err

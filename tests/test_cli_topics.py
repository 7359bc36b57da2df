"""``reframe-jax topics``, and the options of the other commands that it names."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_files import POSE, START, TF, Messages, write_bag
from export_files import motion, motive

from reframe_jax.cli import identify, program, segment, view
from reframe_jax.recordings.reading import load_recording
from reframe_jax.recordings.recording import Recording, RecordingError

Captured = pytest.CaptureFixture[str]


def write(folder: Path, poses: np.ndarray) -> Path:
    messages, samples = Messages("a.mcap"), []
    for k, pose in enumerate(poses):
        stamp = START + 10**7 * k
        samples.append(("/pose", POSE, messages.pose(POSE, stamp, pose), stamp))
        samples.append(("/tf", TF, messages.tf(stamp, [("map", "tool", pose)]), stamp))
    return write_bag(folder, "a.mcap", samples)


def test_contents_are_listed(tmp_path: Path, capsys: Captured, rng: np.random.Generator) -> None:
    bag = write(tmp_path, motion(rng))
    export = tmp_path / "a.csv"
    export.write_text(motive({"Rod": motion(rng)}))
    empty = write_bag(tmp_path, "b.bag", [])
    (tmp_path / "a.txt").write_text("0 0 0 0 0 0 0 1\n")
    assert program.main(["topics", *map(str, (bag, export, empty, tmp_path / "a.txt"))]) == 0
    out, err = capsys.readouterr()
    assert out.splitlines() == [
        f"{bag}: a ROS bag",
        "  --topic /pose  geometry_msgs/PoseStamped, 12 messages",
        "  --from map     tf frame without a parent",
        "  --to tool      tf frame in map, 12 transforms",
        f"{export}: an export of OptiTrack Motive",
        "  --body Rod  rigid body",
        f"{empty}: a ROS bag: nothing that can be read",
        f"{tmp_path / 'a.txt'}: a TUM trajectory: a single recording",
    ]
    assert err == ""


def test_files_that_cannot_be_listed(tmp_path: Path, capsys: Captured) -> None:
    (tmp_path / "a.bag").write_text("no bag")
    (tmp_path / "a.txt").write_text("0 0 0 0 0 0 0 1\n")
    missing = tmp_path / "b.bag"
    assert program.main(["topics", str(tmp_path / "a.bag"), str(missing), str(tmp_path / "a.txt")]) == 1
    out, err = capsys.readouterr()
    assert out == f"{tmp_path / 'a.txt'}: a TUM trajectory: a single recording\n"
    first, second = err.splitlines()
    assert first == (
        f"reframe-jax: error: {tmp_path / 'a.bag'}: expected a ROS bag; the content has another format; "
        "if it is a table of numbers, give it the suffix .csv."
    )
    assert second == f"reframe-jax: error: {missing}: cannot be read: No such file or directory."


@pytest.mark.parametrize("command", ["identify", "segment", "view"])
@pytest.mark.parametrize(
    "options",
    [
        {"topic": "/pose", "unit": "mm"},
        {"from_frame": "map", "to_frame": "tool", "dt": 0.5},
    ],
)
def test_options_of_reading_reach_the_reader(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    rng: np.random.Generator,
    command: str,
    options: dict[str, Any],
) -> None:
    bag, read = write(tmp_path, motion(rng)), []

    def windows(recording: Recording, options: argparse.Namespace) -> Any:
        read.append((recording.times, recording.poses))
        raise RecordingError("enough")

    def segments(poses: np.ndarray, times: np.ndarray, **options: Any) -> Any:
        read.append((times, poses))
        raise RecordingError("enough")

    monkeypatch.setattr(identify, "identify_recording", windows)
    monkeypatch.setattr(view, "identify_recording", windows)
    monkeypatch.setattr(segment, "segment", segments)
    names = {"from_frame": "--from", "to_frame": "--to"}
    words = [word for name, value in options.items() for word in (names.get(name, f"--{name}"), str(value))]
    assert program.main([command, "--no-cache", str(bag), *words]) == 1
    expected = load_recording(bag, **options)
    ((times, poses),) = read
    np.testing.assert_array_equal(poses, expected.poses)
    np.testing.assert_array_equal(times, expected.times)

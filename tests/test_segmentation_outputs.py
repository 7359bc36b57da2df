"""What becomes of a segmentation: the command line, tables, JSON, pictures."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest
from legible import check_legible

import reframe_jax as rf
from reframe_jax.cli import program
from reframe_jax.export.segments import SCHEMA, segments_to_record, segments_to_table
from reframe_jax.plotting import plot_segmentation
from reframe_jax.plotting.segmentation import segment_velocities
from reframe_jax.recordings.writing import save_recording
from reframe_jax.simulation.motions import PoseErrors
from reframe_jax.simulation.sequences import SequenceSimulation, simulate_sequence

DT = 0.025


@pytest.fixture(scope="module")
def truth() -> SequenceSimulation:
    return simulate_sequence(["A", "K"], jax.random.key(1), dt=DT, errors=PoseErrors(sigma=1e-5))


@pytest.fixture(scope="module")
def recording(truth: SequenceSimulation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("segments") / "task.csv"
    save_recording(path, truth.times, truth.poses)
    return path


@pytest.fixture(scope="module")
def found(truth: SequenceSimulation) -> rf.Segmentation:
    return rf.segment(np.asarray(truth.poses), dt=DT)


def test_the_command_prints_and_writes_segments(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "task.json"
    picture = tmp_path / "task.png"
    arguments = ["segment", "--no-cache", str(recording), "--json", str(out), "--plot", str(picture)]
    assert program.main(arguments) == 0
    printed = capsys.readouterr().out
    assert "2 segments" in printed
    assert "Revolute joint" in printed
    assert "Pin-plane contact" in printed
    document = json.loads(out.read_text())
    assert document["schema"] == SCHEMA
    (record,) = document["recordings"]
    assert record["error"] is None
    assert [part["name"] for part in record["segments"]] == ["Revolute joint", "Pin-plane contact"]
    assert record["segments"][1]["start"] == record["boundaries"][0]["index"]
    assert record["segments"][0]["identification"]["name"] == "Revolute joint"
    assert picture.stat().st_size > 10_000


def test_a_bad_recording_is_reported_and_the_others_are_not_lost(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = tmp_path / "bad.csv"
    bad.write_text("t,x\n0,1\n")
    assert program.main(["segment", "--no-cache", str(bad), str(recording), "--json", "-"]) == 1
    output = capsys.readouterr()
    assert str(bad) in output.err
    records = json.loads(output.out)["recordings"]
    assert records[0]["error"] is not None
    assert len(records[1]["segments"]) == 2


def test_wrong_options_are_refused_before_anything_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for options, message in (
        (["--plot", str(tmp_path)], "is a directory"),
        (["--unit", "mile"], "invalid choice"),
        (["no/missing.csv", "--plot", str(tmp_path / "a.png")], "recordings with different names"),
        (["--plot", str(tmp_path / "a.txt")], "must end in .png"),
    ):
        with pytest.raises(SystemExit):
            program.main(["segment", "missing.csv", *options])
        assert message in capsys.readouterr().err


def test_velocities_along_constrained_axes_are_noise(
    truth: SequenceSimulation, found: rf.Segmentation
) -> None:
    angular, linear = segment_velocities(np.asarray(truth.poses), found)
    for segment in found.segments:
        assert segment.identification is not None
        # a border is known to some poses only
        own = slice(segment.start + 25, segment.stop - 25)
        for velocities, frame in (
            (angular, segment.identification.angular),
            (linear, segment.identification.linear),
        ):
            rms = np.sqrt(np.nanmean(velocities[own] ** 2, axis=0))
            free = np.asarray(frame.dof) == 1
            assert np.all(rms[~free] < 0.02)
            assert np.all(rms[free] > 0.05)
    assert np.isnan(linear[-1]).all()


def test_the_picture_shows_every_segment(truth: SequenceSimulation, found: rf.Segmentation) -> None:
    figure = plot_segmentation(np.asarray(truth.poses), found, title="task")
    line, top, bottom = figure.axes
    assert [text.get_text() for text in line.texts] == [segment.name for segment in found.segments]
    widths = [patch.get_width() for patch in line.patches[: len(found)]]
    assert sum(widths) == pytest.approx(found.times[-1] - found.times[0])
    curves = 3 * len(found) + len(found.boundaries)
    assert len(top.lines) - 2 == len(bottom.lines) == curves  # two empty lines for the legend
    assert [text.get_text() for text in top.get_legend().get_texts()] == ["free axis", "constrained axis"]
    check_legible(figure)
    _, linear = segment_velocities(np.asarray(truth.poses), found)
    drawn = np.concatenate([curve.get_ydata() for curve in top.lines[:3]])
    own = linear[: found.segments[0].stop]
    assert np.nanmax(np.abs(drawn)) == pytest.approx(np.nanmax(np.abs(own)))


def test_the_table_says_when_and_how_sure(found: rf.Segmentation) -> None:
    rows = segments_to_table(found, label="task").splitlines()
    assert rows[0] == "task: 2 segments"
    assert len(rows) == 2 + len(found)
    assert "since" in rows[-1]
    nothing = {"motion_time": None, "segments": [], "boundaries": []}
    assert segments_to_record(None, label="x", error="no") == {"recording": "x", "error": "no"} | nothing

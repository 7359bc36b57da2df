"""The benchmark of known joints: textbook estimators find planted centres and axes; a run in miniature."""

import json
from pathlib import Path

import numpy as np
import pytest

import reframe_jax as rf
from benchmarks import assumed


@pytest.mark.parametrize("reach", assumed.RANGES)
def test_textbooks_find_exact_centres_and_axes(reach: str) -> None:
    poses, lines = assumed.make(assumed.Setting("ball", 0.0, reach, False), 3)
    for fit in assumed.BALL.values():
        for each, line in zip(poses, lines, strict=True):
            assert assumed.centre_errors(fit(each), line, each)[1] < 1e-6
    poses, lines = assumed.make(assumed.Setting("hinge", 0.0, reach, False), 3)
    for fit in assumed.HINGE.values():
        for each, line in zip(poses, lines, strict=True):
            assert np.max(assumed.axis_errors(fit(each), line, each)) < 1e-3


def test_soft_errors_are_millimetres() -> None:
    poses, lines = assumed.make(assumed.Setting("ball", 0.0, "large", True), 5)
    fits = [assumed.score(each) for each in poses]
    errors = [assumed.centre_errors(*each)[1] for each in zip(fits, lines, poses, strict=True)]
    assert 0.5 < np.median(errors) < 50
    assert poses.shape == (5, assumed.POSES, 4, 4)


def test_errors_of_an_axis() -> None:
    poses = np.tile(np.eye(4), (5, 1, 1))
    truth = np.array([0, 0, 1.0]), np.zeros(3)
    found = np.array([0, np.sin(0.01), -np.cos(0.01)]), np.array([0.002, 0, 0])
    angle, distance = assumed.axis_errors(found, truth, poses)
    np.testing.assert_allclose([angle, distance], [np.degrees(0.01), 2.0])


def test_a_run_in_miniature(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "out.json"
    assert assumed.main(["--quick", "--json", str(file)]) == 0
    rows = json.loads(file.read_text())["rows"]
    contestants = {row["contestant"] for row in rows}
    assert contestants == {"assume", "SCoRE", "calibrate", "SARA", "circle"}
    hard = [row for row in rows if row["contestant"] == "assume" and "soft" not in row["case"]]
    assert len(hard) == 2
    assert all(row["distance_largest_mm"] < 5 for row in hard)
    assert "hinge, large, 1 mm, soft" in capsys.readouterr().out


def test_an_assumed_hinge_is_at_least_as_accurate_as_least_squares() -> None:
    poses, lines = assumed.make(assumed.Setting("hinge", 1e-3, "small", False), 16)
    found = [rf.identify(each, assume="hinge", dt=assumed.DT) for each in poses]
    lists = [assumed.axis_of(*each) for each in zip(found, poses, strict=True)], map(assumed.sara, poses)
    errors = [[assumed.axis_errors(*each) for each in zip(ours, lines, poses, strict=True)] for ours in lists]
    (angle, distance), (sara_angle, sara_distance) = np.sqrt(np.mean(np.square(errors), axis=1))
    assert angle < sara_angle
    assert distance < sara_distance

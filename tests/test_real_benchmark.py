"""The benchmark of recordings: fits that outliers do not move, a made door, and the real ones if present."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import reframe_jax as rf
from benchmarks import real

RADII = {"kitchen_door_389": 0.530, "kitchen_door_391": 0.313, "kitchen_door_403": 0.522}  # m
needs_recordings = pytest.mark.skipif(
    not real.DATA.is_dir(), reason=f"the recordings of shared/data are not beside this checkout: {real.DATA}"
)


def door(rng: np.random.Generator, noise: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times and poses of a door with a handle 0.4 m from its hinge; direction and a point of the hinge."""
    times = 0.1 * np.arange(51)
    upright = Rotation.from_rotvec([0.3, -0.2, 0.5])
    hinge = np.array([0.7, -0.2, 0.4])
    angles = 0.7 * np.sin(1.3 * times)
    turn = upright * Rotation.from_rotvec(angles[:, None] * [0, 0, 1])
    poses = np.tile(np.eye(4), (51, 1, 1))
    poses[:, :3, 3] = hinge + turn.apply([0.4, 0, 0.1]) + noise * rng.normal(size=(51, 3))
    poses[:, :3, :3] = (Rotation.from_rotvec(noise * rng.normal(size=(51, 3))) * turn).as_matrix()
    return times, poses, upright.apply([0, 0, 1]), hinge


def test_a_circle_is_found_in_spite_of_outliers(rng):
    _, poses, direction, hinge = door(rng, 1e-4)
    positions = poses[:, :3, 3]
    positions[[7, 30]] += [0.2, -0.1, 0.15]
    circle = real.circle_axis(positions)
    away = circle.point - hinge
    assert np.linalg.norm(away - (away @ direction) * direction) < 5e-4
    assert real.angle_between(circle.direction, direction) < 0.1
    assert 5e-5 < circle.residual < 3e-4


def test_a_line_is_found_in_spite_of_outliers(rng):
    direction = np.array([0.6, 0.0, -0.8])
    positions = np.linspace(0, 0.3, 60)[:, None] * direction + 1e-4 * rng.normal(size=(60, 3))
    positions[[5, 40]] += [0.1, 0.1, 0.1]
    line = real.line_axis(positions)
    assert real.angle_between(line.direction, direction) < 0.05
    assert 5e-5 < line.residual < 4e-4


@pytest.mark.parametrize(("b", "degrees"), [([0, 2, 0], 90), ([-3, 0, 0], 0), ([1, 1e-6, 0], 5.73e-5)])
def test_angles_are_those_between_lines(b, degrees):
    np.testing.assert_allclose(real.angle_between(np.array([1.0, 0, 0]), np.array(b)), degrees, rtol=1e-3)


def test_a_made_door_is_scored_and_what_is_absent_is_named(rng, tmp_path, capsys):
    times, poses, _, _ = door(rng, 1e-5)
    rf.save_recording(tmp_path / "kitchen_door_1.csv", times, poses)
    file = tmp_path / "out.json"
    assert real.main(["--data", str(tmp_path), "--json", str(file)]) == 0
    record = json.loads(file.read_text())
    (row,) = record["recordings"]
    assert row["classes"]["default"]["name"] == row["classes"]["lag 1"]["name"] == "Revolute joint"
    for figures in row["figures"].values():
        assert 0 < figures["distance_mm"] < 2
        assert 0 < figures["angle_deg"] < 0.5
    assert record["metrics"]["door_default_distance_mm_rms"] == row["figures"]["default"]["distance_mm"]
    printed = capsys.readouterr()
    assert "Revolute joint" in printed.out
    assert "there is no contour*.csv" in printed.err
    assert "kitchen_door" not in printed.err


def test_tool_points_are_taken_at_chords_up_to_the_longest(monkeypatch):
    times = np.arange(40) / 30
    recording = rf.Recording(times, np.tile(np.eye(4), (40, 1, 1)), real.DATA)
    asked = []

    def pretend(lag, poses, **options):
        asked.append(lag)
        position = np.arange(12.0).reshape(4, 3) + lag
        linear = SimpleNamespace(position=position)
        return SimpleNamespace(
            candidates=SimpleNamespace(linear=linear), linear=SimpleNamespace(frame_type=rf.LinearType.BB)
        )

    monkeypatch.setattr(real, "identify_at", pretend)
    monkeypatch.setattr(real, "takes_lag", lambda: True)
    rows = real.tool_points(recording)
    assert asked == [1, 2, 3, 4, 6, 10]
    assert rows[2] == {"lag": 3, "type": "BB", "tool_point_m": [3.0, 4.0, 5.0]}
    monkeypatch.setattr(real, "takes_lag", lambda: False)
    assert [row["lag"] for row in real.tool_points(recording)] == [1]


@needs_recordings
@pytest.mark.parametrize("name", RADII)
def test_real_doors_lie_on_circles(name):
    positions = rf.load_recording(real.DATA / f"{name}.csv").poses[:, :3, 3]
    circle = real.circle_axis(positions)
    away = positions - circle.point
    radii = np.linalg.norm(away - np.outer(away @ circle.direction, circle.direction), axis=1)
    np.testing.assert_allclose(np.median(radii), RADII[name], atol=2e-3)
    assert circle.residual < 3e-3


@needs_recordings
def test_a_real_door_turns_about_the_axis_of_its_circle():
    row = real.examine(real.DATA / "kitchen_door_391.csv")
    assert row["figures"]["default"]["distance_mm"] < 20
    assert row["figures"]["default"]["angle_deg"] < 12

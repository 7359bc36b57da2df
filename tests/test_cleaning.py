"""Cleaning of recordings: on simulations with injected errors, and on real ones where they are at hand."""

from pathlib import Path

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from reframe_jax.identification.classify import Thresholds
from reframe_jax.identification.entry import identify
from reframe_jax.recordings.cleaning import clean_recording, pose_noise, pose_outliers, recording_warnings
from reframe_jax.recordings.reading import load_recording
from reframe_jax.recordings.recording import Recording
from reframe_jax.simulation import synthetic

DATA = Path(__file__).parents[2] / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="needs the real recordings, in ../shared/data")
AXIS = np.array([0.1, 0.97, 0.22]) / np.linalg.norm([0.1, 0.97, 0.22])


def door(
    seed: int, dt: float, angle: float = 0.0, distance: float = 0.0, rest: float = 1.0, radius: float = 0.5
) -> tuple[Recording, np.ndarray]:
    """A body on a hinge through a point, opened and closed between two rests, with white noise."""
    rng = np.random.default_rng(seed)
    times = np.arange(0, 12 + 2 * rest, dt)
    swing = 0.6 * (1 - np.cos(np.clip(times - rest, 0, 12) * np.pi / 3))
    turn, pivot = Rotation.from_rotvec(swing[:, None] * AXIS), np.array([0.3, -0.1, 0.8])
    arm = np.cross(AXIS, [0.0, 0.0, 1.0])
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    error = Rotation.from_rotvec(angle * rng.normal(size=(len(times), 3)))
    poses[:, :3, :3] = (turn * error).as_matrix()
    poses[:, :3, 3] = pivot + turn.apply(radius * arm / np.linalg.norm(arm))
    poses[:, :3, 3] += distance * rng.normal(size=(len(times), 3))
    return Recording(times, poses, Path("door.csv")), pivot


def distance_to_hinge(found: object, pivot: np.ndarray) -> float:
    offset = np.asarray(found.candidates.linear.position[3]) - pivot  # type: ignore[attr-defined]
    return float(np.linalg.norm(offset - AXIS * (AXIS @ offset)))


@settings(max_examples=12)
@given(st.sampled_from("ABCDEFGHIJKL"), st.integers(0, 99), st.sampled_from([0.05, 0.1]))
def test_clean_motion_is_left_alone(label: str, seed: int, dt: float) -> None:
    simulation = jax.device_get(synthetic.simulate(label, jax.random.key(seed), noise=1e-5, dt=dt))
    recording = Recording(np.asarray(simulation.times), np.asarray(simulation.poses), Path("a.csv"))
    cleaned = clean_recording(recording)
    assert cleaned.notes == ()
    np.testing.assert_array_equal(cleaned.poses, recording.poses)


@settings(max_examples=30)
@given(
    st.integers(0, 99),
    st.sets(st.integers(4, 110), min_size=1, max_size=5),
    st.booleans(),
    st.sampled_from([0.0, 0.002]),
)
def test_what_jumps_away_and_back_is_an_outlier(
    seed: int, where: set[int], turned: bool, noise: float
) -> None:
    apart = [k for k in sorted(where) if not {k - 1, k - 2, k - 3} & where]
    recording, _ = door(seed, 0.1, noise, noise / 10)
    rng = np.random.default_rng(seed)
    for k in apart:
        if turned:
            jump = rng.normal(size=3)
            jump *= rng.uniform(0.3, np.pi) / np.linalg.norm(jump)
            recording.poses[k, :3, :3] = recording.poses[k, :3, :3] @ Rotation.from_rotvec(jump).as_matrix()
        else:
            recording.poses[k, :3, 3] += AXIS * 0.1
    found = np.flatnonzero(pose_outliers(recording.times, recording.poses))
    assert set(apart) <= set(found)
    assert len(found) <= len(apart) + 4
    assert f"sample{'s' if len(found) > 1 else ''} {found[0]}" in " ".join(clean_recording(recording).notes)
    assert any("away and back" in warning for warning in recording_warnings(recording))


def test_lost_frames_are_no_outliers() -> None:
    recording, _ = door(0, 0.05)
    kept = np.delete(np.arange(len(recording.times)), np.r_[60:70, 100:103])
    assert not pose_outliers(np.arange(len(kept)) * 0.05, recording.poses[kept]).any()


@pytest.mark.parametrize("dt", [0.02, 0.05])
@pytest.mark.parametrize(("angle", "distance"), [(1e-4, 1e-4), (3e-3, 3e-4), (1e-3, 2e-3)])
def test_noise_is_estimated(dt: float, angle: float, distance: float) -> None:
    recording, _ = door(1, dt, angle, distance)
    np.testing.assert_allclose(pose_noise(recording.poses) / np.sqrt(3), [angle, distance], rtol=0.3)


@pytest.mark.parametrize(
    ("angle", "distance", "radius"), [(1e-3, 2e-4, 0.5), (3e-3, 5e-4, 0.3), (6e-3, 5e-4, 0.5)]
)
def test_a_noisy_door_is_a_hinge(angle: float, distance: float, radius: float) -> None:
    recording, pivot = door(2, 0.05, angle, distance, rest=4.0, radius=radius)
    recording.poses[90, :3, :3] = (
        recording.poses[90, :3, :3] @ Rotation.from_rotvec([0.4, 0.1, 0]).as_matrix()
    )
    cleaned = clean_recording(recording)
    assert not np.isin(recording.times[90], cleaned.times)
    found = identify(cleaned.poses, times=cleaned.times)
    assert found.name == "Revolute joint"
    assert distance_to_hinge(found, pivot) < 0.01
    rows = np.searchsorted(recording.times, cleaned.times)
    np.testing.assert_array_equal(cleaned.poses, recording.poses[rows])  # left out, never moved


def test_steps_as_told() -> None:
    recording, _ = door(3, 0.05, 3e-3, 5e-4)
    cleaned = clean_recording(recording, step=0.2)
    steps = np.diff(cleaned.times)
    assert steps.min() > 0.199
    assert "as told" in cleaned.notes[-1]
    assert len(clean_recording(recording, step=0.0).times) > 0.9 * len(recording.times)
    assert "too few" in clean_recording(recording, step=10.0).notes[-1]
    with pytest.raises(ValueError, match="0 or more"):
        clean_recording(recording, step=-1.0)


def test_short_recordings_pass() -> None:
    recording, _ = door(4, 0.05, 3e-3, 5e-4)
    short = Recording(recording.times[:5], recording.poses[:5], Path("a.csv"))
    assert clean_recording(short).times.shape == (5,)
    assert recording_warnings(short) == []
    assert pose_noise(short.poses).tolist() == [0, 0]


def test_warnings() -> None:
    recording, _ = door(5, 0.05, 3e-3, 5e-4)
    recording.poses[100, :3, :3] = recording.poses[100, :3, :3] @ Rotation.from_rotvec([1, 0, 0]).as_matrix()
    share, jumps, noise = recording_warnings(recording)
    assert share.startswith("2 of ")
    assert share.endswith("angular velocity: to samples 100, 101.")
    assert jumps.startswith("poses jump away and back")
    assert noise.startswith("noise of 0.")
    assert recording_warnings(door(5, 0.05)[0]) == []


@needs_data
@pytest.mark.parametrize(("number", "radius"), [(389, 0.530), (391, 0.313), (403, 0.522)])
def test_real_doors_are_hinges(number: int, radius: float) -> None:
    recording = clean_recording(load_recording(DATA / f"kitchen_door_{number}.csv"))
    found = identify(recording.poses, times=recording.times, lag=1, thresholds=Thresholds())
    assert found.name == "Revolute joint"
    positions = recording.poses[:, :3, 3]
    normal = np.linalg.svd(positions - positions.mean(axis=0))[2][2]
    axis = Rotation.from_rotvec(np.array(found.candidates.angular.rotvec[0])).as_matrix()[:, 2]
    assert np.degrees(np.arccos(abs(axis @ normal))) < 4
    arms = positions - np.asarray(found.candidates.linear.position[3])
    lengths = np.linalg.norm(arms - np.outer(arms @ normal, normal), axis=1)
    assert abs(lengths.mean() - radius) < 0.006


@needs_data
@pytest.mark.parametrize("number", [394, 407])
def test_real_drawers_slide(number: int) -> None:
    recording = clean_recording(load_recording(DATA / f"kitchen_drawer_{number}.csv"))
    found = identify(recording.poses, times=recording.times, lag=1, thresholds=Thresholds())
    assert found.name == "Prismatic joint"
    positions = recording.poses[:, :3, 3]
    line = np.linalg.svd(positions - positions.mean(axis=0))[2][0]
    assert np.degrees(np.arccos(abs(np.asarray(found.linear.axes[:, 2]) @ line))) < 1


@needs_data
@pytest.mark.parametrize(("name", "dof"), [("contour_a_1", 1), ("contour_b_1", 1), ("pouring", 2)])
def test_other_recordings_stay_what_they_are(name: str, dof: int) -> None:
    recording = clean_recording(load_recording(DATA / f"{name}.csv"))
    found = identify(recording.poses, times=recording.times, lag=1, thresholds=Thresholds())
    assert (found.angular.dof.sum(), found.linear.dof.sum()) == (2, dof)

"""Recordings written, and read again."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from recording_files import poses_of
from scipy.spatial.transform import Rotation

from reframe_jax.recordings.lost import find_lost_poses
from reframe_jax.recordings.reading import load_recording
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.writing import save_recording

vectors = st.lists(st.floats(-5, 5), min_size=3, max_size=3)


@given(st.lists(st.tuples(st.floats(1e-3, 0.9), vectors, vectors), min_size=5, max_size=8))
def test_round_trip(
    tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[float, list[float], list[float]]]
) -> None:
    folder = tmp_path_factory.mktemp("io")
    times = np.cumsum([row[0] for row in rows])
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, 3] = [row[1] for row in rows]
    poses[:, :3, :3] = Rotation.from_rotvec([row[2] for row in rows]).as_matrix()
    assume((find_lost_poses(poses, times) == "").all())
    for name in ("a.csv", "a.npz"):
        save_recording(folder / name, times, poses)
        read = load_recording(folder / name)
        np.testing.assert_array_equal(read.times, times)
        np.testing.assert_array_equal(read.poses[:, :, 3], poses[:, :, 3])
        np.testing.assert_allclose(read.poses, poses, rtol=0, atol=1e-14)


@pytest.mark.parametrize("rotvec", [(0, 0, 0), (np.pi, 0, 0), (0, np.pi, 0), (0, 0, np.pi), (2.2, 2.2, 0)])
def test_half_turns_survive_the_csv(tmp_path: Path, rotvec: tuple[float, float, float]) -> None:
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    save_recording(tmp_path / "a.csv", np.arange(5) * 0.1, poses)
    np.testing.assert_allclose(load_recording(tmp_path / "a.csv").poses, poses, rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", ["a.csv", "a.npz"])
def test_wrenches_are_written_and_read(
    name: str, tmp_path: Path, table: np.ndarray, rng: np.random.Generator
) -> None:
    wrenches = rng.normal(size=(len(table), 6))
    wrenches[3, 2] = np.nan
    save_recording(tmp_path / name, table[:, 0], poses_of(table), wrenches=wrenches)
    read = load_recording(tmp_path / name)
    np.testing.assert_array_equal(read.wrenches, wrenches)
    np.testing.assert_allclose(read.poses, poses_of(table), rtol=0, atol=1e-14)
    save_recording(tmp_path / name, table[:, 0], poses_of(table))
    assert load_recording(tmp_path / name).wrenches is None


def test_wrenches_that_do_not_fit_are_refused(tmp_path: Path, table: np.ndarray) -> None:
    times, poses = table[:, 0], poses_of(table)
    with pytest.raises(RecordingError, match=r"expected wrenches of shape \(9, 6\), not \(9, 3\)"):
        save_recording(tmp_path / "a.csv", times, poses, wrenches=np.zeros((9, 3)))
    with pytest.raises(RecordingError, match="expected finite wrenches, or NaN"):
        save_recording(tmp_path / "a.npz", times, poses, wrenches=np.full((9, 6), np.inf))
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_written_is_refused(tmp_path: Path, table: np.ndarray) -> None:
    times, poses = table[:, 0], poses_of(table)
    with pytest.raises(RecordingError, match=r"expected times \(N,\) and poses"):
        save_recording(tmp_path / "a.csv", times[1:], poses)
    with pytest.raises(RecordingError, match=r"written as \.csv or \.npz, not '\.txt'"):
        save_recording(tmp_path / "a.txt", times, poses)
    with pytest.raises(RecordingError, match=r"none.*cannot be written"):
        save_recording(tmp_path / "none" / "a.csv", times, poses)
    poses[2, 0, 0] = np.nan
    with pytest.raises(RecordingError, match="expected finite times and poses"):
        save_recording(tmp_path / "a.csv", times, poses)
    poses[2, 0, 0] = 7
    with pytest.raises(RecordingError, match="sample 2: expected a pose matrix"):
        save_recording(tmp_path / "a.csv", times, poses)

"""Columns of data sets in Parquet and HDF5 files, which pyarrow and h5py wrote."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from export_files import motion
from scipy.spatial.transform import Rotation

from reframe_jax.recordings.reading import list_contents, load_recording
from reframe_jax.recordings.recording import Recording, RecordingError

FINE = 1e-6  # of single precision
STATE: dict[str, Any] = {
    "position": "observation.state[1:4]",
    "orientation": "observation.state[4:8]",
    "quaternion": "xyzw",
}
DEMO = "data/demo_0/obs/"
EEF: dict[str, Any] = {"position": DEMO + "robot0_eef_pos", "orientation": DEMO + "robot0_eef_quat"}


@pytest.fixture
def poses(rng: np.random.Generator) -> np.ndarray:
    return motion(rng)


def quaternions(poses: np.ndarray) -> np.ndarray:
    quaternion: np.ndarray = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    return quaternion


def same(recording: Recording, poses: np.ndarray, step: float = 0.1) -> None:
    np.testing.assert_allclose(recording.poses, poses, atol=FINE)
    np.testing.assert_allclose(recording.times, step * np.arange(len(poses)), atol=1e-6)


def lerobot(path: Path, episodes: list[np.ndarray], **more: Any) -> Path:
    """A file in the layout of LeRobot: a state of 8 numbers, single precision, 10 Hz."""
    states = [np.column_stack([np.ones(len(each)), each[:, :3, 3], quaternions(each)]) for each in episodes]
    rows = np.concatenate(states).astype(np.float32)
    columns = {
        "observation.state": pa.FixedSizeListArray.from_arrays(pa.array(rows.ravel()), 8),
        "timestamp": pa.array(
            np.concatenate([0.1 * np.arange(len(each)) for each in episodes]).astype(np.float32)
        ),
        "frame_index": pa.array(np.concatenate([np.arange(len(each)) for each in episodes])),
        "episode_index": pa.array(np.repeat(np.arange(len(episodes)), [len(each) for each in episodes])),
        "task": pa.array(["wipe"] * len(rows)),
        **more,
    }
    pq.write_table(pa.table(columns), path, row_group_size=7)
    return path


def robomimic(path: Path, poses: np.ndarray) -> Path:
    with h5py.File(path, "w") as file:
        file[EEF["position"]] = poses[:, :3, 3]
        file[EEF["orientation"]] = quaternions(poses)
        file[DEMO + "agentview_image"] = np.zeros((len(poses), 4, 4, 3), np.uint8)
        file[DEMO + "object"] = np.zeros((len(poses), 10))
        file["data/demo_1/obs/robot0_eef_pos"] = np.zeros((3, 3))
        file["mask/train"] = np.array([b"demo_0"])
    return path


# Parquet


def test_one_episode(tmp_path: Path, poses: np.ndarray) -> None:
    path = lerobot(tmp_path / "a.parquet", [poses])
    same(load_recording(path, **STATE), poses)
    same(load_recording(path, **STATE, dt=0.5), poses, 0.5)


def test_episodes_are_named(tmp_path: Path, poses: np.ndarray) -> None:
    path = lerobot(tmp_path / "a.parquet", [poses, poses[::-1], poses[2:]])
    same(load_recording(path, **STATE, episode=1), poses[::-1])
    same(load_recording(path, **STATE, episode=2), poses[2:])
    for episode in (None, 3):
        with pytest.raises(RecordingError, match=r"contains the episodes 0, 1, 2; name one, episode \(--ep"):
            load_recording(path, **STATE, episode=episode)


@pytest.mark.parametrize("kind", ["xyzw", "wxyz", "vector", "XYZ", "zyx", "matrix"])
def test_orientations_of_any_kind(tmp_path: Path, poses: np.ndarray, kind: str) -> None:
    turned = Rotation.from_matrix(poses[:, :3, :3])
    values = {
        "xyzw": turned.as_quat(),
        "wxyz": turned.as_quat(scalar_first=True),
        "vector": turned.as_rotvec(),
        "matrix": turned.as_matrix().reshape(-1, 9),
    }
    rows = values[kind] if kind in values else turned.as_euler(kind)
    how = {4: {"quaternion": kind}, 3: {"angles": kind}}.get(rows.shape[1], {})
    more = {name: pa.array(poses[:, i, 3]) for i, name in enumerate("xyz")}
    path = lerobot(tmp_path / "a.parquet", [poses], turn=pa.array(rows.tolist()), **more)
    same(load_recording(path, position="x, y,z", orientation="turn", **how), poses)  # type: ignore[arg-type]
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["turn"] = turned.as_matrix() if kind == "matrix" else rows
        file["p"] = poses[:, :3, 3]
    same(load_recording(tmp_path / "a.h5", position="p", orientation="turn", dt=0.1, **how), poses)  # type: ignore[arg-type]


def test_rows_with_missing_numbers_are_dropped(tmp_path: Path, poses: np.ndarray) -> None:
    more = {name: pa.array(poses[:, i, 3]) for i, name in enumerate("xyz")}
    more["y"] = pa.array([None if i == 4 else value for i, value in enumerate(poses[:, 1, 3])])
    path = lerobot(tmp_path / "a.parquet", [poses], **more)
    recording = load_recording(path, **{**STATE, "position": "x,y,z"})
    np.testing.assert_allclose(recording.poses, np.delete(poses, 4, axis=0), atol=FINE)
    assert recording.notes == ("sample 4 left out: a number is missing or not finite.",)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (
            {},
            r"name its columns, position \(--position\) and orientation \(--orientation\): observation.st",
        ),
        ({**STATE, "position": "pos"}, "has no column 'pos'; columns: observation.state, timestamp, "),
        (
            {**STATE, "quaternion": None},
            r"does not state the meaning of the 4 numbers of an orientation; give quaternion \(--quat",
        ),
        ({**STATE, "angles": "XYZ"}, r"has 4 orientation numbers; leave out angles"),
        ({**STATE, "position": "observation.state"}, "expected 3 numbers of a position, .*; found 8 and 4"),
        ({**STATE, "position": "task"}, "expected numbers in task, not string"),
        ({**STATE, "position": "ragged"}, "the lists of ragged have different lengths"),
        ({**STATE, "topic": "/pose"}, "is a Parquet file, which does not use topic"),
    ],
)
def test_columns_that_cannot_be_read(
    tmp_path: Path, poses: np.ndarray, options: dict[str, Any], problem: str
) -> None:
    ragged = pa.array([[1.0] * (1 + (i == 3)) for i in range(len(poses))])
    with pytest.raises(RecordingError, match=problem):
        load_recording(lerobot(tmp_path / "a.parquet", [poses], ragged=ragged), **options)


def test_files_without_episodes_and_times(tmp_path: Path, poses: np.ndarray) -> None:
    table = pq.read_table(lerobot(tmp_path / "a.parquet", [poses])).drop(["episode_index", "timestamp"])
    pq.write_table(table, tmp_path / "b.parquet")
    with pytest.raises(RecordingError, match="has no column episode_index; leave out episode"):
        load_recording(tmp_path / "b.parquet", **STATE, episode=0)
    with pytest.raises(RecordingError, match=r"has no times; .*dt"):
        load_recording(tmp_path / "b.parquet", **STATE)
    same(load_recording(tmp_path / "b.parquet", **STATE, dt=0.1), poses)
    pq.write_table(table.slice(0, 0), tmp_path / "c.parquet")
    with pytest.raises(RecordingError, match="has no rows"):
        load_recording(tmp_path / "c.parquet", **STATE)


# HDF5


def test_robomimic(tmp_path: Path, poses: np.ndarray) -> None:
    path = robomimic(tmp_path / "a.hdf5", poses)
    same(load_recording(path, **EEF, quaternion="xyzw", dt=0.05), poses, 0.05)
    with pytest.raises(RecordingError, match=r"has no times; .*dt \(--dt\)"):
        load_recording(path, **EEF, quaternion="xyzw")
    with pytest.raises(RecordingError, match=r"of the same length; found 3, 12"):
        load_recording(path, **{**EEF, "position": "data/demo_1/obs/robot0_eef_pos"}, quaternion="xyzw", dt=1)
    with pytest.raises(
        RecordingError, match="has no column 'data/demo_0'; columns: data/demo_0/obs/object, "
    ):
        load_recording(path, **{**EEF, "position": "data/demo_0"}, quaternion="xyzw", dt=1)


def test_columns_are_listed(tmp_path: Path, poses: np.ndarray) -> None:
    listed = {}
    for path in (robomimic(tmp_path / "a.hdf5", poses), lerobot(tmp_path / "a.parquet", [poses])):
        entries = list_contents(path)[1]
        assert entries is not None
        listed[path.suffix] = [(entry.option, entry.name, entry.detail) for entry in entries]
    assert listed[".hdf5"] == [
        ("position", DEMO + "object", "(12, 10) float64"),
        ("position", DEMO + "robot0_eef_pos", "(12, 3) float64"),
        ("orientation", DEMO + "robot0_eef_quat", "(12, 4) float64"),
        ("position", "data/demo_1/obs/robot0_eef_pos", "(3, 3) float64"),
    ]
    (state, _) = listed[".parquet"]
    assert state[:2] == ("position", "observation.state")
    assert state[2].endswith("[8], 12 rows")


def test_long_lists_of_columns_end(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for k in range(250):
            file[f"demo_{k}/p"] = np.zeros((5, 3))
    entries = list_contents(tmp_path / "a.h5")[1]
    assert entries is not None
    assert (len(entries), entries[-1].detail) == (201, "and 50 more columns")


# damaged files


@pytest.mark.parametrize(("name", "what"), [("a.parquet", "Parquet"), ("a.hdf5", "HDF5")])
def test_damaged_files(tmp_path: Path, poses: np.ndarray, name: str, what: str) -> None:
    path = tmp_path / name
    (lerobot(path, [poses]) if what == "Parquet" else robomimic(path, poses))
    options = STATE if what == "Parquet" else {**EEF, "quaternion": "xyzw", "dt": 1}
    whole = path.read_bytes()
    for content in (whole[:100], whole[: len(whole) // 2], whole[:20] + bytes(200)):
        path.write_bytes(content)
        with pytest.raises(RecordingError) as caught:
            load_recording(path, **options)
        message = str(caught.value)
        assert message.startswith(f"{path}: expected a whole {what} file; it cannot be read: ")
        assert message.isprintable()
        assert len(message) < 500
    path.write_bytes(b"")
    with pytest.raises(RecordingError, match=f"expected an? {what} file; the content has another format"):
        load_recording(path, **options)

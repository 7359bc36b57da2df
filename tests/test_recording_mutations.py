"""Files as accidents leave them: each is a valid recording, or refused in words; nothing else, no warning."""

import io
import tempfile
import tracemalloc
import warnings
import zipfile
from functools import cache, partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from bag_files import POSE, START, Messages, write_bag
from export_files import motive, qualisys, vicon
from recording_files import poses_of

from benchmarks.mutations import FORMATS as TEXT_AND_ARRAYS
from benchmarks.mutations import ROWS, make_recording, motion
from reframe_jax.recordings.reading import load_recording
from reframe_jax.recordings.recording import RecordingError

FEW, MANY = 100, 6000  # files of each format
MOST_MEMORY = 2**24  # bytes; 2**20 are enough for these files


def make_motive(rng: np.random.Generator) -> bytes:
    rotation = str(rng.choice(["Quaternion", "XYZ"]))
    return motive({"Rod": poses_of(motion(rng))}, rotation=rotation, lost=(4,)).encode()


def make_vicon(rng: np.random.Generator) -> bytes:
    return vicon({"Rod": poses_of(motion(rng))}, lost=(4,)).encode()


def make_qualisys(rng: np.random.Generator) -> bytes:
    bodies = {"Rod": poses_of(motion(rng))}
    return qualisys(bodies, titles=bool(rng.random() < 0.5), lost=(4,)).encode()


def make_bag(rng: np.random.Generator, name: str) -> bytes:
    return bag(name, int(rng.integers(3)))


@cache
def bag(name: str, seed: int) -> bytes:
    messages, poses = Messages(name), poses_of(motion(np.random.default_rng(seed)))
    stamps = [START + 10**7 * k for k in range(ROWS)]
    with tempfile.TemporaryDirectory() as folder:
        samples = [
            ("/pose", POSE, messages.pose(POSE, t, pose), t) for t, pose in zip(stamps, poses, strict=True)
        ]
        return write_bag(Path(folder), name, samples).read_bytes()


def make_parquet(rng: np.random.Generator) -> bytes:
    table = motion(rng)
    columns = {"timestamp": table[:, 0], **dict(zip(["x", "y", "z"], table[:, 1:4].T, strict=True))}
    columns["q"] = pa.FixedSizeListArray.from_arrays(pa.array(table[:, 4:].ravel()), 4)
    sink = io.BytesIO()
    pq.write_table(pa.table(columns), sink)
    return sink.getvalue()


def make_hdf5(rng: np.random.Generator) -> bytes:
    table, sink = motion(rng), io.BytesIO()
    with h5py.File(sink, "w") as file:
        file["p"], file["q"] = table[:, 1:4], table[:, 4:]
    return sink.getvalue()


FORMATS = {
    **TEXT_AND_ARRAYS,
    **{"motive.csv": make_motive, "vicon.csv": make_vicon, "qualisys.tsv": make_qualisys},
    **{".bag": partial(make_bag, name="a.bag"), ".mcap": partial(make_bag, name="a.mcap")},
    **{".parquet": make_parquet, ".hdf5": make_hdf5},
}
OPTIONS: dict[str, Any] = {
    "vicon.csv": {"angles": "vector"},
    ".parquet": {"position": "x,y,z", "orientation": "q", "quaternion": "xyzw"},
    ".hdf5": {"position": "p", "orientation": "q", "quaternion": "xyzw"},
}


def outcome(path: Path, dt: float | None, **options: Any) -> str:
    """Loads a file and checks what comes of it."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            recording = load_recording(path, dt=dt, **options)
    except RecordingError as error:
        check_message(str(error), path)
        return "refused"
    times, poses = recording.times, recording.poses
    assert times.shape == (len(poses),)
    assert poses.shape == (len(times), 4, 4)
    assert len(times) >= 5
    assert np.isfinite(times).all()
    assert np.isfinite(poses).all()
    assert (times[1:] > times[:-1]).all()
    rotations = poses[:, :3, :3]
    np.testing.assert_allclose(
        rotations.swapaxes(1, 2) @ rotations, np.broadcast_to(np.eye(3), rotations.shape), atol=1e-12
    )
    assert (np.linalg.det(rotations) > 0).all()
    assert (poses[:, 3] == [0, 0, 0, 1]).all()
    return "read"


def check_message(message: str, path: Path) -> None:
    assert message.startswith(f"{path}: ")
    assert len(message) < 2000
    assert message.isprintable()


def read_mutated(folder: Path, suffix: str, count: int) -> dict[str, int]:
    """Reads so many files of a format, one after the other; returns how many came out how."""
    outcomes = {"read": 0, "refused": 0}
    for seed in range(count):
        rng = np.random.default_rng([seed, *suffix.encode()])
        path = folder / f"{seed}{suffix}"
        path.write_bytes(make_recording(rng, suffix, FORMATS[suffix]))
        tracemalloc.reset_peak()
        try:
            dt = 0.1 if suffix == ".hdf5" or rng.random() < 0.3 else None
            outcomes[outcome(path, dt, **OPTIONS.get(suffix, {}))] += 1
        except BaseException as error:
            error.add_note(f"of the file {path}")
            raise
        assert tracemalloc.get_traced_memory()[1] < MOST_MEMORY, path  # where it is traced
        path.unlink()
    return outcomes


@pytest.mark.parametrize("suffix", FORMATS)
def test_files_that_are_whole_are_read(tmp_path: Path, suffix: str) -> None:
    """The files that are mutated below are recordings."""
    makers = {**FORMATS, ".npy": whole_npy, ".npz": whole_npz}
    path = tmp_path / f"a{suffix}"
    path.write_bytes(makers[suffix](np.random.default_rng(3)))
    assert outcome(path, 0.1 if suffix == ".hdf5" else None, **OPTIONS.get(suffix, {})) == "read"


def whole_npy(rng: np.random.Generator) -> bytes:
    file = io.BytesIO()
    np.save(file, motion(rng))
    return file.getvalue()


def whole_npz(rng: np.random.Generator) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("poses.npy", whole_npy(rng))
    return file.getvalue()


@pytest.mark.parametrize("suffix", FORMATS)
def test_mutated_files_are_read_or_refused(tmp_path: Path, suffix: str) -> None:
    tracemalloc.start()
    try:
        outcomes = read_mutated(tmp_path, suffix, FEW)
    finally:
        tracemalloc.stop()
    assert min(outcomes.values()) > 0, outcomes


@pytest.mark.slow
@pytest.mark.parametrize("suffix", FORMATS)
def test_many_mutated_files_are_read_or_refused(tmp_path: Path, suffix: str) -> None:
    outcomes = read_mutated(tmp_path, suffix, MANY)
    assert min(outcomes.values()) > MANY // 100, outcomes

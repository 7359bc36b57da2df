"""Files as accidents leave them: each is a valid recording, or refused in words; nothing else, no warning."""

import io
import tempfile
import tracemalloc
import warnings
import zipfile
from collections.abc import Callable
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
from test_recording_shapes import trc

from benchmarks.mutations import FORMATS as TEXT_AND_ARRAYS
from benchmarks.mutations import ROWS, make_recording, motion
from reframe_jax.recordings.checks import MIN_POSES
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


def make_kitti(rng: np.random.Generator) -> bytes:
    table = motion(rng)
    numbers = np.column_stack([table[:, 0], poses_of(table)[:, :3].reshape(ROWS, 12)])
    return "".join(" ".join(map(repr, row)) + "\n" for row in numbers.tolist()).encode()


def make_angles(rng: np.random.Generator) -> bytes:
    """A table with units in its header, and angles."""
    rows = np.round(np.column_stack([motion(rng)[:, :4], rng.uniform(-1, 1, (ROWS, 3))]), 6).tolist()
    header = "time [s];x [mm];y [mm];z [mm];roll [deg];pitch [deg];yaw [deg]\n"
    return (header + "".join(";".join(map(repr, row)).replace(".", ",") + "\n" for row in rows)).encode()


def make_echo(rng: np.random.Generator) -> bytes:
    rows = motion(rng)[:, 1:].tolist()
    return "".join(f"{5 + k},{k},map,{','.join(map(repr, row))}\n" for k, row in enumerate(rows)).encode()


def make_ndi(rng: np.random.Generator) -> bytes:
    rows = motion(rng)[:, [7, 4, 5, 6, 1, 2, 3]] * [1, 1, 1, 1, 1e3, 1e3, 1e3]
    lines = [
        f"{k},0A,{5 + k},{k},{'Missing' if k == 4 else 'OK'},{','.join(map(repr, row))},0.1"
        for k, row in enumerate(rows.tolist())
    ]
    header = "Frame#,PortHandle,timespec_s,timespec_ns,State,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error"
    return "\n".join([header, *lines]).encode()


def make_trc(rng: np.random.Generator) -> bytes:
    marks = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.08, 0], [0, 0, 0.06]])
    poses = poses_of(motion(rng))
    points = np.einsum("nij,kj->nki", poses[:, :3, :3], marks) + poses[:, None, :3, 3]
    return trc(1e3 * points, ["rod1", "rod2", "rod3", "rod4"]).encode()


def make_mha(rng: np.random.Generator) -> bytes:
    lines = ["ObjectType = Image"]
    for k, pose in enumerate(poses_of(motion(rng))):
        lines.append(f"Seq_Frame{k:04d}_AToBTransform = {' '.join(map(repr, pose.ravel().tolist()))}")
        lines.append(f"Seq_Frame{k:04d}_AToBTransformStatus = {'INVALID' if k == 4 else 'OK'}")
        lines.append(f"Seq_Frame{k:04d}_Timestamp = {0.1 * k:.6f}")
    return "\n".join([*lines, "ElementDataFile = LOCAL", ""]).encode() + bytes(64)


FORMATS: dict[str, Callable[[np.random.Generator], bytes]] = {
    **TEXT_AND_ARRAYS,
    **{"kitti.txt": make_kitti, "angles.csv": make_angles, "echo.csv": make_echo, "ndi.csv": make_ndi},
    **{".trc": make_trc, ".mha": make_mha},
    **{"motive.csv": make_motive, "vicon.csv": make_vicon, "qualisys.tsv": make_qualisys},
    **{".bag": partial(make_bag, name="a.bag"), ".mcap": partial(make_bag, name="a.mcap")},
    **{".parquet": make_parquet, ".hdf5": make_hdf5},
}
OPTIONS: dict[str, Any] = {
    "angles.csv": {"angles": "xyz"},
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
    assert len(times) >= MIN_POSES
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

"""Files as accidents leave them: each is a valid recording, or refused in words; nothing else, no warning."""

import io
import tracemalloc
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest

from benchmarks.mutations import FORMATS, make_recording, motion
from reframe_jax.recordings.reading import load_recording
from reframe_jax.recordings.recording import RecordingError

FEW, MANY = 100, 6000  # files of each format; together 400, or 24,000 on request
MOST_MEMORY = 2**24  # bytes; 2**20 are enough for these files


def outcome(path: Path, dt: float | None) -> str:
    """Loads a file and checks what comes of it."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            recording = load_recording(path, dt=dt)
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
        path.write_bytes(make_recording(rng, suffix))
        tracemalloc.reset_peak()
        try:
            outcomes[outcome(path, dt=0.1 if rng.random() < 0.3 else None)] += 1
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
    assert outcome(path, None) == "read"


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

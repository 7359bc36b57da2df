"""Recordings for the tests of reading them: as files, and as the poses they should become."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from reframe_jax.recordings.reading import load_recording

HEADER = ["t", "x", "y", "z", "qx", "qy", "qz", "qw"]


def write(
    path: Path, header: list[str] | None, rows: np.ndarray | list[list[object]], sep: str = ","
) -> Path:
    lines = [sep.join(str(cell) for cell in row) for row in np.asarray(rows, dtype=object).tolist()]
    path.write_text("\n".join(([sep.join(header)] if header else []) + lines) + "\n")
    return path


def poses_of(table: np.ndarray) -> np.ndarray:
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, 3] = table[:, 1:4]
    poses[:, :3, :3] = Rotation.from_quat(table[:, 4:]).as_matrix()
    return poses


def check(path: Path, table: np.ndarray, **options: object) -> None:
    recording = load_recording(path, **options)  # type: ignore[arg-type]
    np.testing.assert_allclose(recording.times, table[:, 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(recording.poses, poses_of(table), rtol=0, atol=1e-12)
    assert recording.times.dtype == recording.poses.dtype == np.float64
    assert recording.notes == ()

"""Writing of recordings."""

import csv
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.geometry.numpy_rotations import matrices_to_quaternions
from reframe_jax.recordings.checks import make_poses
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import HEADER, Rows

__all__ = ["save_recording"]


def save_recording(path: str | Path, times: ArrayLike, poses: ArrayLike) -> None:
    """Write a recording: a ``.csv`` of ``t,x,y,z,qx,qy,qz,qw``, or an ``.npz`` of ``times`` and ``poses``.

    Args:
        path: the file; its suffix selects the format.
        times: (K+1,) s.
        poses: (K+1, 4, 4), m.

    Raises:
        RecordingError: if the shapes do not fit, a pose is not a rigid transform, or the file cannot be
            written.
    """
    path, times, poses = Path(path), np.asarray(times, dtype=float), np.asarray(poses, dtype=float)
    if not times.size or times.ndim != 1 or poses.shape != (len(times), 4, 4):
        raise RecordingError(
            f"{path}: expected times (N,) and poses (N, 4, 4), N > 0, not {times.shape} and {poses.shape}."
        )
    if not (np.isfinite(times).all() and np.isfinite(poses).all()):
        raise RecordingError(f"{path}: expected finite times and poses; remove the samples that are not.")
    with np.errstate(all="ignore"):  # rotations too large to be squared are refused
        poses = make_poses(Rows(path, "sample", np.arange(len(times)), poses.reshape(-1, 16), times))
    try:
        if path.suffix.lower() == ".npz":
            np.savez(path, times=times, poses=poses)
        elif path.suffix.lower() == ".csv":
            table = np.column_stack([times, poses[:, :3, 3], matrices_to_quaternions(poses[:, :3, :3])])
            with path.open("w", newline="", encoding="utf-8") as file:
                csv.writer(file, lineterminator="\n").writerows([HEADER.split(","), *table.tolist()])
        else:
            raise RecordingError(f"{path}: recordings are written as .csv or .npz, not {path.suffix!r}.")
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror}.") from error

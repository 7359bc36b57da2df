"""Write recordings to files."""

import csv
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.geometry.numpy_rotations import matrices_to_quaternions
from reframe_jax.recordings.checks import make_poses
from reframe_jax.recordings.recording import HEADER, RecordingError, Rows, writing


def save_recording(
    path: str | Path, times: "ArrayLike", poses: "ArrayLike", *, wrenches: "ArrayLike | None" = None
) -> None:
    """Write a recording: a ``.csv`` of ``t,x,y,z,qx,qy,qz,qw``, or an ``.npz`` of ``times`` and ``poses``.

    The suffix selects the format. Times are (K+1,) s, and poses (K+1, 4, 4) m. Both formats can contain
    wrenches, columns ``fx,fy,fz,tx,ty,tz`` or an array ``wrenches``: (K+1, 6) force in N, then torque in Nm,
    written unchanged; NaN where a number is missing. Rotations with an error of at most 1e-2 in an element of
    R^T R are replaced by the nearest rotation.

    Raises:
        RecordingError: if the shapes do not fit each other, a number is not finite, a pose is not a rigid
            transform, or the file cannot be written.
    """
    path, times, poses = Path(path), np.asarray(times, dtype=float), np.asarray(poses, dtype=float)
    if not times.size or times.ndim != 1 or poses.shape != (len(times), 4, 4):
        found = f"{times.shape} and {poses.shape}"
        raise RecordingError(f"{path}: expected times (N,) and poses (N, 4, 4), N > 0, not {found}.")
    if not (np.isfinite(times).all() and np.isfinite(poses).all()):
        raise RecordingError(f"{path}: expected finite times and poses; remove the other samples.")
    forces = np.empty((len(times), 0)) if wrenches is None else np.asarray(wrenches, dtype=float)
    if wrenches is not None and forces.shape != (len(times), 6):
        raise RecordingError(f"{path}: expected wrenches of shape ({len(times)}, 6), not {forces.shape}.")
    if np.isinf(forces).any():
        raise RecordingError(f"{path}: expected finite wrenches, or NaN where a number is missing.")
    with np.errstate(all="ignore"):  # make_poses refuses rotations whose squares are infinite
        poses = make_poses(Rows(path, "sample", np.arange(len(times)), poses.reshape(-1, 16), times))
    with writing(path):
        if path.suffix.lower() == ".npz":
            arrays = {"times": times, "poses": poses} | ({} if wrenches is None else {"wrenches": forces})
            with path.open("wb") as file:  # with the suffix as it is
                np.savez(file, **arrays)
        elif path.suffix.lower() == ".csv":
            quaternions = matrices_to_quaternions(poses[:, :3, :3])
            table = np.column_stack([times, poses[:, :3, 3], quaternions, forces])
            header = HEADER if wrenches is None else f"{HEADER},fx,fy,fz,tx,ty,tz"
            with path.open("w", newline="", encoding="utf-8") as file:
                csv.writer(file, lineterminator="\n").writerows([header.split(","), *table.tolist()])
        else:
            raise RecordingError(f"{path}: recordings are written as .csv or .npz, not {path.suffix!r}.")

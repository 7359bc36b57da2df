"""Rotations of three angles: what they mean is for the user to say, and their unit if the file does not."""

from pathlib import Path

import numpy as np

from reframe_jax.geometry.numpy_rotations import euler_matrices, rotation_matrices
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.selection import ANGLE_UNITS, Selection, flag

__all__ = ["angle_matrices"]

_TURN = 2 * np.pi * 1.001


def angle_matrices(
    path: Path, angles: np.ndarray, wanted: Selection, stated: float | None = None
) -> np.ndarray:
    """Rotation matrices (N, 3, 3) of rotation vectors or Euler angles (N, 3).

    Args:
        path: the file.
        angles: in the order of the letters of the option ``angles``, or a rotation vector.
        wanted: what they mean, and their unit.
        stated: their unit in rad, if the file states it.

    Raises:
        RecordingError: if the unit is given twice, or not at all while angles exceed a turn in radians.
    """
    if stated is not None and wanted.angle_unit is not None:
        raise RecordingError(f"{path}: states the unit of its angles; leave out {flag('angle_unit')}.")
    vector = wanted.angles == "vector"
    if stated is None and wanted.angle_unit is None:
        sizes = np.linalg.norm(angles, axis=1) if vector else np.abs(angles)
        largest = np.max(sizes[np.isfinite(sizes)], initial=0.0)
        if largest > _TURN:
            what = "rotation vectors have a length of" if vector else "angles are"
            raise RecordingError(
                f"{path}: its {what} up to {largest:.4g}, more than the 6.28 rad of a turn; if they are in "
                "degrees, give angle_unit='deg' (--angle-unit deg), else angle_unit='rad' (--angle-unit rad)."
            )
    radians = angles * (stated or ANGLE_UNITS[wanted.angle_unit or "rad"])
    return rotation_matrices(radians) if vector else euler_matrices(str(wanted.angles), radians)

"""The motion of one body relative to another."""

from dataclasses import replace
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from reframe_jax.geometry.numpy_rotations import rotation_matrices, rotation_vectors
from reframe_jax.recordings.checks import MIN_POSES
from reframe_jax.recordings.recording import LeftOut, Recording, RecordingError

_GAP = 5.0  # median steps; in a longer gap, the body counts as lost
_BLOCK = 2**14  # poses per block, so that intermediate arrays stay small


def relative_poses(a: Recording, b: Recording) -> Recording:
    """Express the poses of one body in the frame of another: ``inv(B) A``, at the times of ``a``.

    The pose of ``b`` is interpolated: the position linearly, the orientation by a rotation about one axis at
    a constant rate. Times before or after ``b``, and times in gaps of ``b`` longer than five of its median
    steps, are left out with a note. Both recordings must have the same ground frame and the same clock; their
    origins may differ. The result has the notes of both; wrenches are unchanged. A RecordingError is raised
    if the recordings have fewer than four times in common.
    """
    if len(b.times) < 2:
        raise RecordingError(f"{b.path}: expected two poses or more of the other body, found {len(b.times)}.")
    times = a.times + origin_shift(a.path, a.origin, b.origin)
    poses, known = interpolate_poses(b.times, b.poses, times)
    if known.sum() < MIN_POSES:
        raise RecordingError(
            f"{a.path}: only {known.sum()} of its poses are at times of the other body, in {b.path}; "
            f"expected {MIN_POSES} or more."
        )
    notes = [*a.notes, *(f"of the other body: {note}" for note in b.notes if note not in a.notes)]
    left_out = a.left_out
    if left := len(times) - int(known.sum()):
        why = "the other body was not tracked at their times"
        notes.append(f"{left} of {len(times)} poses left out: {why}.")
        if a.rows is not None:
            left_out = (*left_out, LeftOut(a.rows[~known], "relative", why))
    return replace(
        a,
        times=a.times[known],
        poses=invert_poses(poses) @ a.poses[known],
        notes=tuple(notes),
        wrenches=None if a.wrenches is None else a.wrenches[known],
        rows=None if a.rows is None else a.rows[known],
        left_out=left_out,
    )


def interpolate_poses(
    times: np.ndarray, poses: np.ndarray, wanted: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate poses: positions linearly, orientations along the shortest rotation at a constant rate.

    The poses (N, 4, 4) have increasing times (N,) s. The result is poses (L, 4, 4) at the wanted times that
    are known, and ``known`` (M,) bool: whether a time is between the first and the last one, and in no gap
    longer than five median steps.
    """
    after = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    steps = np.diff(times)
    inside = (wanted >= times[0]) & (wanted <= times[-1])
    known = np.isin(wanted, times) | (inside & (steps[after - 1] <= _GAP * np.median(steps)))
    after, wanted = after[known], wanted[known]
    fraction = (wanted - times[after - 1]) / steps[after - 1]
    found = poses[after - 1]
    for start in range(0, len(wanted), _BLOCK):
        between = np.flatnonzero(fraction[start : start + _BLOCK]) + start  # exact at 0 and 1
        first, second, part = found[between], poses[after[between]], fraction[between, None]
        turns = rotation_vectors(first[:, :3, :3].swapaxes(1, 2) @ second[:, :3, :3])
        found[between, :3, :3] = first[:, :3, :3] @ rotation_matrices(part * turns)
        found[between, :3, 3] += part * (second[:, :3, 3] - first[:, :3, 3])
    found[fraction == 1] = poses[after[fraction == 1]]
    return found, known


def invert_poses(poses: np.ndarray) -> np.ndarray:
    """Return the inverses (N, 4, 4) of poses (N, 4, 4)."""
    found = np.zeros_like(poses)
    found[:, :3, :3] = poses[:, :3, :3].swapaxes(1, 2)
    found[:, :3, 3] = -np.einsum("nij,nj->ni", found[:, :3, :3], poses[:, :3, 3])
    found[:, 3, 3] = 1
    return found


def origin_shift(path: Path, origin: str | None, other: str | None) -> float:
    """Return the difference of two origins in s, which converts times from the first to the second."""
    try:
        return float(Decimal(origin or 0) - Decimal(other or 0))
    except InvalidOperation as error:
        both = f"{origin!r} and {other!r}"
        raise RecordingError(f"{path}: expected origins that are numbers of seconds, not {both}.") from error

"""Compute the poses of a rigid body from the positions of its markers."""

import numpy as np

from reframe_jax.geometry.numpy_rotations import nearest_rotations

__all__ = ["fit_rigid_body"]

_REFERENCE = 1000  # largest number of frames in the mean shape of the body
_PASSES = 3
_THIN = 0.05  # second extent of the markers over the first, below which they are nearly on a line


def fit_rigid_body(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit a rigid body to its markers in each sample (Kabsch).

    The shape of the body is the mean over samples with all markers. The origin of the body is the centroid of
    the markers, and its axes are parallel to the ground in the first sample with all markers.

    Args:
        points: (N, M, 3), NaN where a marker is not seen.

    Returns:
        Poses (N, 4, 4) in the unit of the points, and RMS distances (N,) of the seen markers from the body.
        NaN where fewer than three markers are seen, or where all are on a line.

    Raises:
        ValueError: if no frame has all markers, or if they are on a line.
    """
    seen = np.isfinite(points).all(axis=2)
    whole = np.flatnonzero(seen.all(axis=1))
    if not len(whole):
        raise ValueError("no frame has all markers")
    shape = points[whole[0]] - points[whole[0]].mean(axis=0)
    if not _spans(shape):
        raise ValueError("the markers are on a line")
    some = points[whole[np.linspace(0, len(whole) - 1, min(len(whole), _REFERENCE)).astype(int)]]
    for _ in range(_PASSES):
        turned, moved = _align(some, shape)
        shape = np.einsum("nji,nkj->nki", turned, some - moved[:, None]).mean(axis=0)
        shape -= shape.mean(axis=0)
    poses, residuals = np.full((len(points), 4, 4), np.nan), np.full(len(points), np.nan)
    patterns, which = np.unique(seen, axis=0, return_inverse=True)
    for number, pattern in enumerate(patterns):
        if pattern.sum() < 3 or not _spans(shape[pattern]):
            continue
        frames = np.flatnonzero(which.ravel() == number)
        here = points[frames][:, pattern]
        turned, moved = _align(here, shape[pattern])
        errors = here - moved[:, None] - np.einsum("nij,kj->nki", turned, shape[pattern])
        poses[frames, :3, :3], poses[frames, :3, 3], poses[frames, 3] = turned, moved, [0, 0, 0, 1]
        residuals[frames] = np.sqrt((errors**2).sum(axis=2).mean(axis=1))
    return poses, residuals


def _align(points: np.ndarray, shape: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (N, 3, 3) and positions (N, 3) that align a shape (M, 3) with points (N, M, 3)."""
    centres, centre = points.mean(axis=1), shape.mean(axis=0)
    turned = nearest_rotations(np.einsum("nki,kj->nij", points - centres[:, None], shape - centre))
    return turned, centres - np.einsum("nij,j->ni", turned, centre)


def _spans(shape: np.ndarray) -> bool:
    """Return whether points (M, 3) determine an orientation."""
    extents = np.linalg.svd(shape - shape.mean(axis=0), compute_uv=False)
    return bool(extents[1] > _THIN * extents[0])

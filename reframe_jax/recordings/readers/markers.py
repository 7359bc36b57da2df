"""Rigid bodies in files of marker positions: their markers and their poses."""

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from reframe_jax.geometry.numpy_rotations import nearest_rotations
from reframe_jax.recordings.readers.reader import Entry
from reframe_jax.recordings.readers.units import LENGTH_WORDS
from reframe_jax.recordings.recording import RecordingError, Rows, listed, shown
from reframe_jax.recordings.selection import Selection, flag, unit_of

_UNSEEN = "fewer than three markers of the body are seen, or all of them are on a line"
_LOOSE = 5e-3  # m RMS, above which markers are probably not on one body
_MOST = 60  # markers in a message
_REFERENCE = 1000  # largest number of frames in the mean shape of the body
_PASSES = 3
_THIN = 0.05  # second extent of the markers over the first, below which they are nearly on a line


def group_markers(labels: Iterable[str]) -> dict[str, list[str]]:
    """Group markers by prefixes that three or more markers share: ``rod`` of ``rod:a`` or ``rod1``."""
    found: dict[str, list[str]] = {}
    for label in labels:
        prefix = label.partition(":")[0] if ":" in label else re.sub(r"[\W_]*\d+$", "", label)
        found.setdefault(prefix, []).append(label)
    return {prefix: labels for prefix, labels in found.items() if prefix and len(labels) > 2}


def _choose_markers(path: Path, body: str | None, labels: list[str]) -> list[str]:
    """Return the markers of the body that the user named, or of the only body."""
    groups = group_markers(labels)
    if body is not None and "," in body:
        return [label.strip() for label in body.split(",")]
    if body in groups:
        return groups[str(body)]
    if body is None and len(groups) == 1:
        return next(iter(groups.values()))
    if body is None and not groups and len(labels) == 3:
        return labels
    why = f"has no body {shown(body, 60)!r}" if body else "does not state which markers are on a body"
    bodies = f"prefixes: {listed(groups)}; " if groups else ""
    raise RecordingError(
        f"{path}: {why}; name a prefix of markers, or three markers or more with commas between them, "
        f"{flag('body')}; {bodies}markers: {listed(labels, _MOST)}."
    )


def marker_entries(labels: list[str], detail: str) -> list[Entry]:
    """List the bodies of markers, and the remaining markers with ``detail``, for :func:`list_contents`."""
    groups = group_markers(labels)
    found = [Entry("body", name, f"{len(each)} markers: {', '.join(each)}") for name, each in groups.items()]
    grouped = {label for each in groups.values() for label in each}
    if rest := [label for label in labels if label not in grouped]:
        found.append(Entry("body", ",".join(rest), detail))
    return found


def unit_of_markers(path: Path, stated: str, wanted: Selection) -> float:
    """Return the unit in m that a file states in words, or the one that the user gave; refuse other units."""
    known = LENGTH_WORDS.get(stated.lower())
    if known is None and wanted.unit is None:
        found = f"states an unknown unit, {shown(stated, 20)!r}" if stated else "does not state its unit"
        raise RecordingError(f"{path}: {found}; give {flag('unit')}.")
    return unit_of(path, wanted, "unit", known)


def set_marker_poses(rows: Rows, points: np.ndarray, known: list[str], wanted: Selection, unit: str) -> None:
    """Set the values of rows to the poses of a body that is fitted to its markers, with a note about the fit.

    The points (N, M, 3), NaN where a marker is not seen, have the labels ``known`` and a unit in words.
    """
    path, metres = rows.path, unit_of_markers(rows.path, unit, wanted)
    labels = list(dict.fromkeys(_choose_markers(path, wanted.body, known)))
    if missing := [label for label in labels if label not in known]:
        raise RecordingError(f"{path}: has no marker {listed(missing)}; markers: {listed(known, _MOST)}.")
    if len(labels) < 3:
        raise RecordingError(f"{path}: expected three markers or more of a body, found {len(labels)}.")
    points = points[:, [known.index(label) for label in labels]]
    try:
        poses, residuals = fit_rigid_body(points)
    except ValueError as error:
        counts = np.isfinite(points).all(axis=2).sum(axis=0)
        seen = listed(f"{label} {count}" for label, count in zip(labels, counts, strict=True))
        raise RecordingError(
            f"{path}: no rigid body fits, because {error}; name other markers, {flag('body')}. Count of "
            f"frames, of {len(points)}, in which each marker is seen: {seen}."
        ) from error
    fitted = residuals[np.isfinite(residuals)] * metres
    if not len(fitted):
        raise RecordingError(f"{path}: no pose of the markers is finite; expected positions in metres or mm.")
    rms, worst = np.sqrt(np.mean(fitted**2)), fitted.max()
    note = f"{len(labels)} markers are {1e3 * rms:.2g} mm RMS from a rigid body, {1e3 * worst:.2g} mm at most"
    rows.notes.append(note + ("; check that all are on the same body." if rms > _LOOSE else "."))
    rows.values, rows.metres, rows.missing = poses.reshape(-1, 16), metres, _UNSEEN


def fit_rigid_body(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit a rigid body to its markers (N, M, 3) in each sample (Kabsch); NaN where a marker is not seen.

    The shape of the body is the mean over samples with all markers. The origin of the body is the centroid of
    the markers, and its axes are parallel to the ground in the first sample with all markers. The result is
    poses (N, 4, 4) in the unit of the points, and RMS distances (N,) of the seen markers from the body; NaN
    where fewer than three markers are seen, or where all are on a line. A ValueError is raised if no frame
    has all markers, or if they are on a line.
    """
    seen = np.isfinite(points).all(axis=2)
    if not len(whole := np.flatnonzero(seen.all(axis=1))):
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

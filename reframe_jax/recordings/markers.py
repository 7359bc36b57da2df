"""Rigid bodies in files of marker positions: their markers and their poses."""

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from reframe_jax.recordings.readers.reader import Entry
from reframe_jax.recordings.readers.units import LENGTH_WORDS
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rigid_body import fit_rigid_body
from reframe_jax.recordings.rows import Rows, listed, shown
from reframe_jax.recordings.selection import Selection, flag, unit_of

__all__ = ["group_markers", "marker_entries", "set_marker_poses", "unit_of_markers"]

_UNSEEN = "fewer than three markers of the body are seen, or all of them are on a line"
_LOOSE = 5e-3  # m RMS, above which markers are probably not on one body
_MOST = 60  # markers in a message


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
    """Return the unit in m that a file states in words, or the one that the user gave.

    Raises:
        RecordingError: if they differ, or if neither is known.
    """
    known = LENGTH_WORDS.get(stated.lower())
    if known is None and wanted.unit is None:
        found = f"states an unknown unit, {shown(stated, 20)!r}" if stated else "does not state its unit"
        raise RecordingError(f"{path}: {found}; give {flag('unit')}.")
    return unit_of(path, wanted, "unit", known)


def set_marker_poses(rows: Rows, points: np.ndarray, known: list[str], wanted: Selection, unit: str) -> None:
    """Set the values of rows to the poses of a body that is fitted to its markers, with a note about the fit.

    Args:
        rows: the rows.
        points: (N, M, 3), NaN where a marker is not seen.
        known: labels of all markers.
        wanted: the options, with the body and the unit.
        unit: unit of the points in words, as in the file. The note gives the distances in mm.

    Raises:
        RecordingError: if the body or the unit is unknown, or if no rigid body fits.
    """
    path, metres = rows.path, unit_of_markers(rows.path, unit, wanted)
    labels = _choose_markers(path, wanted.body, known)
    if missing := [label for label in labels if label not in known]:
        raise RecordingError(f"{path}: has no marker {listed(missing)}; markers: {listed(known, _MOST)}.")
    if len(set(labels)) < 3:
        raise RecordingError(f"{path}: expected three markers or more of a body, found {len(set(labels))}.")
    points = points[:, [known.index(label) for label in dict.fromkeys(labels)]]
    try:
        poses, residuals = fit_rigid_body(points)
    except ValueError as error:
        counts = np.isfinite(points).all(axis=2).sum(axis=0)
        seen = listed(f"{label} {count}" for label, count in zip(labels, counts, strict=False))
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

"""Helpers that tables, columns and JSON of an identification have in common."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.geometry.numpy_rotations import positive_axis
from reframe_jax.identification.results import Identification
from reframe_jax.recordings.recording import LeftOut, Recording

TYPES = {"angular": AngularType, "linear": LinearType}


@dataclass(frozen=True)
class Window:
    """The part of a recording that a window covers."""

    start: int  # first sample
    stop: int  # sample after the last one
    start_time: float  # s, time of the first sample
    stop_time: float  # s, time of the last sample


def split_windows(host: Identification) -> list[Identification]:
    """Split a batch, whose arrays are NumPy arrays, into its windows; one window gives a list of one."""
    return [host[index] for index in np.ndindex(np.shape(host.status_code))]


def directions(projector: np.ndarray) -> list[np.ndarray]:
    """Return unit vectors (3,) that span the range of a projector (3, 3), largest component positive."""
    values, vectors = np.linalg.eigh(projector)
    spanning = [vector for value, vector in zip(values, vectors.T, strict=True) if value > 0.5]
    return [positive_axis(vector) for vector in spanning]


def plain(value: Any) -> Any:
    """Convert arrays, also in nested dicts and lists, to JSON types, and NaN and infinities to None."""
    if isinstance(value, dict):
        return {name: plain(item) for name, item in value.items()}
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def format_probability(value: float | None) -> str:
    """Format a probability with two digits, never as 0 or 1; "-" for None or NaN."""
    if value is None or np.isnan(value):
        return "-"
    return "<0.01" if value < 0.01 else ">0.99" if value > 0.99 else f"{value:.2f}"


def align_columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Format rows of cells as lines with aligned columns."""
    widths = [max(map(len, cells)) for cells in zip(*rows, strict=True)]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]


def tied_names(group: str, frame: Any) -> list[str]:
    """Return the names of the frame types that fit equally well, including the reported type."""
    return [str(kind) for kind in TYPES[group] if frame.tied[kind]]


def outlier_samples(found: Identification, window: Window | None) -> list[int]:
    """Return the outliers of a window, as samples of the recording, or of the window without ``window``."""
    start = 0 if window is None else window.start
    return [start + int(index) for index in np.flatnonzero(~np.asarray(found.counted))]


def count_rows(recording: Recording, found: Sequence[Identification]) -> tuple[int, tuple[LeftOut, ...]]:
    """Return the number of used rows, and the rows that were left out.

    These are the rows that reading left out, and the outliers if one window covers the recording.
    """
    if len(found) != 1 or np.shape(found[0].counted) != recording.times.shape:
        return len(recording.times), recording.left_out
    return int(np.sum(found[0].counted)), recording.unused(found[0].counted)

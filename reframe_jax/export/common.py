"""What tables and JSON both need of an identification."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.geometry import rotations
from reframe_jax.identification.results import Identification
from reframe_jax.recordings.recording import LeftOut, Recording

__all__ = [
    "TYPES",
    "Window",
    "axes_of",
    "directions",
    "outlier_samples",
    "split_windows",
    "tied_names",
    "two_digits",
    "unused_rows",
]

TYPES = {"angular": AngularType, "linear": LinearType}


@dataclass(frozen=True)
class Window:
    """Which part of a recording a window is.

    Attributes:
        start, stop: samples, from start up to but not including stop.
        start_time, stop_time: s, times of the first and the last sample.
    """

    start: int
    stop: int
    start_time: float
    stop_time: float


def split_windows(host: Identification) -> list[Identification]:
    """All windows of a batch, or the one that is none."""
    return [host[index] for index in np.ndindex(np.shape(host.status_code))]


axes_of = jax.jit(rotations.rotation_exp)  # one compilation, where calling it op by op takes forty


def directions(projector: np.ndarray) -> list[np.ndarray]:
    """Unit vectors that span the range of a projector, their largest component positive."""
    values, vectors = np.linalg.eigh(projector)
    spanning = [vector for value, vector in zip(values, vectors.T, strict=True) if value > 0.5]
    return [vector * np.sign(vector[np.argmax(np.abs(vector))]) for vector in spanning]


def two_digits(value: float) -> str:
    """A number rounded to two digits, without an exponent where it is large: 320 and not 3.2e+02."""
    return f"{float(f'{value:.2g}'):g}"


def tied_names(group: str, frame: Any) -> list[str]:
    """Names of the types that fit equally well, the reported one included."""
    return [str(kind) for kind in TYPES[group] if frame.tied[kind]]


def outlier_samples(found: Identification, window: Window | None) -> list[int]:
    """Samples of the recording, or else of the window, that took no part in a window."""
    start = 0 if window is None else window.start
    return [start + int(index) for index in np.flatnonzero(~np.asarray(found.counted))]


def unused_rows(recording: Recording, found: Sequence[Identification]) -> tuple[LeftOut, ...]:
    """Rows of the file that were left out when it was read, and the outliers if it is one window."""
    whole = len(found) == 1 and np.shape(found[0].counted) == recording.times.shape
    return recording.unused(found[0].counted) if whole else recording.left_out

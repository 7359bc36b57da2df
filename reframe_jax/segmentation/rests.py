"""Parts of a recording in which the body rests."""

import numpy as np

from reframe_jax.segmentation.blocks import Scales
from reframe_jax.segmentation.chords import Chords, Tracks

__all__ = ["find_rests"]


def find_rests(tracks: Tracks, chords: Chords, scales: Scales) -> list[tuple[int, int]]:
    """Find where the body rests or pauses, as poses [start, stop) in order of time.

    Args:
        tracks: of the recording.
        chords: of the recording.
        scales: of the chords.
    """
    number = len(tracks.times)
    still = ~scales.moving[: number - chords.lag]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(np.int8), [0]])))
    rests = []
    for first, last in edges.reshape(-1, 2):
        # outliers do not count, but do not rest either
        counted = tracks.counted[first : last + chords.lag]
        if np.mean(counted) > 0.5:
            rests.append((int(first), int(last - 1 + chords.lag + (last == len(still)))))
    return rests

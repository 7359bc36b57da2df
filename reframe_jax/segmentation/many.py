"""Segmentation of several recordings, of any lengths."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import jax
from jax.typing import ArrayLike

from reframe_jax.segmentation.entry import segment
from reframe_jax.segmentation.results import Segmentation

__all__ = ["segment_many"]


def segment_many(
    recordings: Sequence[ArrayLike] | jax.Array,
    *,
    times: Sequence[ArrayLike] | jax.Array | None = None,
    dt: float | Sequence[ArrayLike] | jax.Array | None = None,
    reach: float = 1.0,
) -> list[Segmentation]:
    """Segment several recordings with :func:`segment`, on all processor cores.

    Args:
        recordings: poses of {b} in {g}, m: an array (R, N, 4, 4), or R arrays (N, 4, 4) of any lengths.
        times: R arrays (N,) of sample times, s. Give either ``times`` or ``dt``.
        dt: time between two poses, s: one number for all recordings, or R values.
        reach: as in :func:`segment`.

    Returns:
        The segmentations, in the same order.

    Raises:
        ValueError: if the number of ``times`` or ``dt`` differs from the number of recordings, or for the
            first recording that :func:`segment` refuses; the message names the recording.
    """
    number = len(recordings)
    each_dt = [dt] * number if dt is None or isinstance(dt, int | float) else list(dt)
    each_times = [None] * number if times is None else list(times)
    for name, values in (("times", each_times), ("dt", each_dt)):
        if len(values) != number:
            raise ValueError(f"There must be as many {name} as recordings, {number}, not {len(values)}.")

    def segment_one(index: int) -> Segmentation:
        try:
            return segment(recordings[index], times=each_times[index], dt=each_dt[index], reach=reach)
        except ValueError as error:
            raise ValueError(f"Recording {index}: {error}") from error

    first = [segment_one(index) for index in range(min(number, 1))]  # compile before the threads start
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return first + list(pool.map(segment_one, range(1, number)))

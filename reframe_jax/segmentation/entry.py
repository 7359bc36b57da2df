"""Entry to segmentation: from a recording to the sequence of its constraints."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import jax
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.compilation import traced
from reframe_jax.identification.entry import identify_unchecked, name_bad_rows
from reframe_jax.identification.inputs import take_steps
from reframe_jax.identification.options import Options
from reframe_jax.identification.results import Identification
from reframe_jax.motion.checks import Status, window_status
from reframe_jax.segmentation.bank import best_scores, fit_models, misfit
from reframe_jax.segmentation.cells import Cells, make_cells, path_features
from reframe_jax.segmentation.chance import with_chance
from reframe_jax.segmentation.pieces import Piece, find_pieces, join_pieces, label_pieces
from reframe_jax.segmentation.results import Boundary, Segment, Segmentation
from reframe_jax.segmentation.sampling import fill_gaps, find_left_out
from reframe_jax.tuning import SEGMENTS as C

_INTERVAL = 0.025, 0.975  # quantiles of the interval of a border
_FEWEST = 8  # fewest poses of a segment that can be identified


def segment(
    poses: "ArrayLike", *, times: "ArrayLike | None" = None, dt: "ArrayLike | None" = None
) -> Segmentation:
    """Find where the constraint of a recording changes, and identify each part.

    A constraint holds some coordinates of the motion, for example the height of the tip of a tool above a
    plane. Models of held coordinates are fitted to windows of many lengths. A model gains evidence wherever
    its coordinates move much less than the body, and pays a price for its parameters. The result is the
    sequence of models with the largest evidence, fitted again to its segments. Outliers have no effect. A
    change of speed or direction of a free motion does not end a segment. Neither does a pause within one
    constraint. A pause between different constraints, at the start or at the end is a separate segment, named
    "Still".

    Boundaries are integers, so the function is not differentiable. To differentiate a frame, identify the
    poses of its segment with :func:`reframe_jax.identify`.

    Args:
        poses: (N, 4, 4) poses of the moving body {b} in the ground {g}, m; N >= 16.
        times: (N,) sample times in s, increasing. Give either ``times`` or ``dt``.
        dt: time between two poses, s, a scalar or (N-1,).

    Returns:
        The segments, in order of time, and the boundaries between them.

    Raises:
        ValueError: under ``jit``, ``vmap`` or ``grad``; for another shape; for poses that are not
            rigid, not finite or all equal; or for times that do not increase.
    """
    if traced((poses, times, dt)):
        raise ValueError("segment needs poses, not tracers: call it outside jit, vmap and grad.")
    poses, times = _checked(poses, times, dt)
    parts, boundaries, motion_time = find_segments(poses, times)
    segments = tuple(
        Segment(a, b, label, None if label < 0 else _identify(poses[a:b], times[a:b]))
        for a, b, label in parts
    )
    return Segmentation(segments, boundaries, times, motion_time)


def segment_many(
    recordings: Sequence[ArrayLike] | jax.Array,
    *,
    times: Sequence[ArrayLike] | jax.Array | None = None,
    dt: float | Sequence[ArrayLike] | jax.Array | None = None,
) -> list[Segmentation]:
    """Segment several recordings with :func:`segment`, on all processor cores.

    Args:
        recordings: poses of {b} in {g}, m: an array (R, N, 4, 4), or R arrays (N, 4, 4) of any lengths.
        times: R arrays (N,) of sample times, s. Give either ``times`` or ``dt``.
        dt: time between two poses, s: one number for all recordings, or R values.

    Returns:
        The segmentations, in the same order.

    Raises:
        ValueError: if the number of ``times`` or ``dt`` differs from the number of recordings, or for the
            first recording that :func:`segment` refuses; the message names the recording.
    """
    number = len(recordings)
    each_dt = list(dt) if np.iterable(dt) else [dt] * number
    each_times = [None] * number if times is None else list(times)
    for name, values in (("times", each_times), ("dt", each_dt)):
        if len(values) != number:
            raise ValueError(f"There must be as many {name} as recordings, {number}, not {len(values)}.")

    def segment_one(index: int) -> Segmentation:
        try:
            return segment(recordings[index], times=each_times[index], dt=each_dt[index])
        except ValueError as error:
            raise ValueError(f"Recording {index}: {error}") from error

    first = [segment_one(index) for index in range(min(number, 1))]  # compile before the threads start
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return first + list(pool.map(segment_one, range(1, number)))


def find_segments(
    poses: np.ndarray, times: np.ndarray
) -> tuple[list[tuple[int, int, int]], tuple[Boundary, ...], float]:
    """Divide a recording of checked poses, without identification of the segments.

    The result is the segments as (first pose, pose after the last, label), the boundaries, and the motion
    time, s.
    """
    kept, number = np.flatnonzero(~find_left_out(poses, times)), len(poses)
    kept = kept if len(kept) >= 2 * _FEWEST else np.arange(number)
    step = float(np.mean(np.diff(times[kept])))
    cells = make_cells(poses[kept], step)
    filled, source = fill_gaps(poses[kept], times[kept], step, C.filled * cells.motion_time)
    if len(filled) > len(kept):
        cells, kept = make_cells(filled, step), kept[source]
    cells = with_chance(cells)
    pieces = join_pieces(cells, find_pieces(cells))
    places = [place_border(cells, *pair) for pair in pairwise(pieces)]
    boundaries = tuple(
        Boundary(
            int(kept[index]), float(times[kept[index]]), probability, int(kept[earliest]), int(kept[latest])
        )
        for (index, earliest, latest), probability in zip(places, _probabilities(cells, pieces), strict=True)
    )
    spans = pairwise([0, *(place[0] for place in places), len(kept)])
    inner = []
    for piece, (start, stop) in zip(pieces, spans, strict=True):  # whole cells, but at least one
        first = min(-(-start // cells.samples), piece.stop - 1)
        last = max(min(stop // cells.samples, piece.stop), first + 1)
        inner.append(piece._replace(start=first, stop=last))
    ends = pairwise([0, *(boundary.index for boundary in boundaries), number])  # with the poses left out
    parts = [(*span, label) for span, label in zip(ends, label_pieces(cells, inner), strict=True)]
    return parts, boundaries, cells.motion_time


def place_border(cells: Cells, before: Piece, after: Piece) -> tuple[int, int, int]:
    """Find the pose at which the second piece begins: its index, and the ends of its 95 % interval.

    Each pose goes to the piece whose model fits the pose better.
    """
    samples = cells.samples
    near = round(C.cells) + 1
    first = max(before.start, before.stop - 4 * near) * samples
    last = min(after.stop, after.start + 4 * near) * samples
    # a border moves by at most half of each piece, so that borders keep their order
    low = max((before.start + before.stop) * samples // 2, (before.stop - near) * samples) - first
    high = min((after.start + after.stop) * samples // 2, (after.start + near) * samples) - first
    border = before.stop * samples - first
    linear, angular = path_features(cells.rotation[first:last], cells.position[first:last])
    gain = [np.zeros(last - first), np.zeros(last - first)]
    for side, (piece, own) in enumerate(((before, slice(0, border)), (after, slice(border, None)))):
        if piece.model is not None:
            values = piece.model.coordinates(linear, angular, np.arange(last - first)[None])[0]
            # integrated paths have another start here, so the mean is computed again, away from the border
            inner = values[own]
            inner = inner[: -(len(inner) // 4) or None] if side == 0 else inner[len(inner) // 4 :]
            middle = np.median(inner, axis=0)[None]
            # a single pose has more noise than the mean pose of a cell
            spread = np.sqrt(np.mean((inner - middle) ** 2, axis=0))[None]
            model = piece.model._replace(middle=middle, size=np.maximum(piece.model.size, spread))
            # beyond the border, a free coordinate starts at its held value: small residuals are no evidence
            # against free motion
            held = 1 + np.sum(np.isfinite(model.size))
            gain[side] = (C.border * held - misfit(model, values[None])[0]) * cells.weight / samples
    evidence = np.concatenate([[0.0], np.cumsum(gain[0] - gain[1])])[low : high + 1]
    weight = np.exp(evidence - evidence.max())
    total = np.cumsum(weight) / weight.sum()
    earliest, latest = (int(np.searchsorted(total, part)) for part in _INTERVAL)
    return tuple(first + low + k for k in (int(evidence.argmax()), earliest, latest))  # type: ignore[return-value]


def _probabilities(cells: Cells, pieces: list[Piece]) -> list[float]:
    """Probability that a piece and the next piece have different constraints, for each boundary."""
    spans = [(piece.start, piece.stop) for piece in pieces]
    both = [(a, d) for (a, _), (_, d) in pairwise(spans)]
    evidence = best_scores(fit_models(cells, np.array(spans + both)))
    one, joint = ([max(evidence.get(span, 0.0), 0.0) for span in part] for part in (spans, both))
    gains = np.clip(np.add(one[:-1], one[1:]) - joint, -50, 50)
    return list((1 / (1 + np.exp(-gains))).tolist())


def _identify(poses: np.ndarray, times: np.ndarray) -> Identification | None:
    """Identify a segment; None if the segment is too short, has no motion, or has no result."""
    if len(poses) < _FEWEST:
        return None
    try:
        return identify_unchecked(poses, times, None, Options())
    except ValueError:
        return None


def _checked(poses: Any, times: Any, dt: Any) -> tuple[np.ndarray, np.ndarray]:
    """Check poses and times, and convert them to float64."""
    poses = np.asarray(poses, float)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or len(poses) < 2 * _FEWEST:
        raise ValueError(f"poses must have shape (N, 4, 4) with N >= {2 * _FEWEST}, not {poses.shape}.")
    steps = np.asarray(take_steps(poses, times, dt), float)
    status = Status(int(window_status(poses, steps)))
    if status.failed:
        raise ValueError(status.message + name_bad_rows(status, poses, steps))
    first = 0.0 if times is None else float(np.asarray(times, float)[0])
    return poses, first + np.concatenate([[0], np.cumsum(steps)])

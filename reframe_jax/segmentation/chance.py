"""Sizes of rows by chance: how small the best rows become in a motion without any held coordinate."""

import dataclasses

import numpy as np

from reframe_jax.geometry.numpy_rotations import nearest_rotations
from reframe_jax.segmentation.cells import Cells, path_features
from reframe_jax.segmentation.rows import fit_spans
from reframe_jax.tuning import EVIDENCE
from reframe_jax.tuning import SEGMENTS as C

_SPANS = 100  # spans per length
_WINDOWS = 2, 4, 8, 16  # cells, lengths of the windows in which motions are compared
_TURNED = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3, 3)))[0]


def with_chance(cells: Cells) -> Cells:
    """Return cells with the fields ``chance`` and ``progress``.

    The rows are fitted to a surrogate motion with the times, speeds and stops of the recording, in which no
    coordinate is held: positions are the sum of three rotated copies of the recording, at delays of 0,
    1/3 and 2/3 of its length, and rotations are a copy at a delay of 1/2.
    """
    number = cells.linear.shape[1]
    # positions and lever times rotations, (N, 6) m, and the distances between cells, (N - 1,)
    path = np.concatenate([cells.linear[1, :, ::4], EVIDENCE.lever * cells.angular[1]], axis=1)
    noise = 6 * float(np.sum(np.square(cells.floor * (1, EVIDENCE.lever))))
    speed = np.sqrt(np.maximum(np.sum(np.diff(path, axis=0) ** 2, axis=1) - noise, 0))
    stops = find_stops(speed)
    lengths = 2 ** np.arange(2, max(3, min(10, int(np.log2(number)) + 1)))
    chance = []
    for length in lengths:
        start = np.unique(np.linspace(0, number - length, _SPANS).astype(int))
        linear, angular = _mix(cells, path, stops, start, int(length))
        first = np.arange(len(start)) * length
        mixed = dataclasses.replace(cells, linear=linear, angular=angular)
        fits = fit_spans(mixed, np.stack([first, first + length], axis=1))
        logs = np.sum(np.log(np.where(np.isfinite(fits.size), fits.size, 1)), axis=-1).min(axis=-1)
        turns = np.cumsum(np.log(fits.turn), axis=-1).min(axis=1)
        logs, turns = (np.pad(each, ((0, 0), (1, 0))) for each in (logs, turns))
        chance.append(np.quantile(logs[:, :, None] + turns[:, None], C.chance, axis=0))
    known = np.log(lengths), np.stack(chance)
    return dataclasses.replace(cells, chance=known, progress=_progress(path, speed))


def find_stops(speed: np.ndarray) -> np.ndarray:
    """Times in cells at which the body almost stops, from distances (N - 1,) between consecutive cells."""
    near = round(C.cells)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(speed, near, mode="edge"), near + 1)
    fast = np.minimum(around[: len(speed)].max(axis=1), around[near:].max(axis=1))
    before, after = np.pad(speed, (1, 0), mode="edge")[:-1], np.pad(speed, (0, 1), mode="edge")[1:]
    at = np.flatnonzero((speed <= before) & (speed < after) & (speed < C.stop * fast))
    bend = np.maximum(before[at] - 2 * speed[at] + after[at], 1e-12)
    return np.asarray(at + 0.5 + np.clip((before[at] - after[at]) / bend / 2, -0.5, 0.5))


def _mix(
    cells: Cells, path: np.ndarray, stops: np.ndarray, start: np.ndarray, length: int
) -> tuple[np.ndarray, np.ndarray]:
    """Features of surrogate motions with the stops of the spans [start, start + length), in a row."""
    number = len(path)
    moved, turned = np.zeros((2, len(start) * length, 3))
    for k, turn in enumerate(_TURNED):
        place = _interpolate(path, _elsewhere(stops, start, length, number * k // 3, number))
        moved += place[:, :3] @ turn / np.sqrt(3)
        turned += (place[:, :3] @ turn + place[:, 3:] @ turn.T) / np.sqrt(3)
    rotation = cells.linear[1].reshape(-1, 3, 4)[:, :, 1:]
    mixed = _interpolate(rotation, _elsewhere(stops, start, length, number // 2, number))
    linear, _ = path_features(nearest_rotations(mixed), moved)
    return linear, np.stack([turned * cells.motion[1] / cells.motion[0]] * 2)


def _elsewhere(stops: np.ndarray, start: np.ndarray, length: int, delay: int, number: int) -> np.ndarray:
    """Times in cells (P * length,) of copies, about ``delay`` cells after the spans [start, start + length).

    The stops of a copy are at the stops of its span, if they have similar durations between them.
    After the end of the recording, copies continue at its start.
    """
    times = []
    span = np.arange(length)
    for a in start:
        at = (a + delay + span) % number
        inside = slice(max(np.searchsorted(stops, a) - 1, 0), np.searchsorted(stops, a + length) + 1)
        own = stops[inside] - a
        if len(own) > 1:
            first = min(int(np.abs(stops - (own[0] + at[0])).argmin()), len(stops) - len(own))
            other = stops[first : first + len(own)]
            ratio = np.diff(other) / np.diff(own)
            warped = np.interp(span, own, other)
            warped += np.minimum(span - own[0], 0) + np.maximum(span - own[-1], 0)
            close = abs(warped[0] - at[0]) < C.cells  # not the span itself, or another copy
            alike = max(ratio.max(), 1 / ratio.min()) < C.alike
            if close and alike and warped[0] >= 0 and warped[-1] < number:
                at = warped
        times.append(at)
    return np.concatenate(times)


def _interpolate(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Interpolate values (N, ...) at times in cells."""
    low = np.minimum(at.astype(int), len(values) - 2)
    part = (at - low).reshape(-1, *(1,) * (values.ndim - 1))
    return np.asarray(values[low] * (1 - part) + values[low + 1] * part)


def _progress(path: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Number of cells of usual motion that equals the motion before each cell, (N + 1,).

    In slower motion, rows stay small by chance for a longer time. The speed is the ratio of path length to
    amplitude in a window; the same ratio in shorter windows of the recording is the comparison.
    """
    path = path - path.mean(axis=0)
    gone = np.concatenate([[0], np.cumsum(speed)])
    sums = [np.concatenate([np.zeros((1, 6)), np.cumsum(each, axis=0)]) for each in (path, path**2)]

    def travel(length: int) -> np.ndarray:
        mean, square = ((total[length:] - total[:-length]) / length for total in sums)
        amplitude = np.sqrt(np.maximum(np.sum(square - mean**2, axis=1), 1e-12))
        return np.asarray((gone[length - 1 :] - gone[: len(path) - length + 1]) / amplitude)

    lengths = [length for length in _WINDOWS if length <= len(path)]
    usual = np.maximum.accumulate([np.median(travel(length)) for length in lengths])
    longest = lengths[-1]
    here = np.pad(travel(longest), (longest // 2, (longest - 1) // 2), mode="edge")
    return np.concatenate([[0], np.cumsum(np.interp(here, usual, np.array(lengths) / longest))])

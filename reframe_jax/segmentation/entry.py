"""The entry to segmentation: a recording in, the sequence of its constraints out."""

from typing import Any

import jax
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.compilation import traced
from reframe_jax.identification.entry import identify_piece
from reframe_jax.identification.inputs import take_steps
from reframe_jax.identification.results import Identification
from reframe_jax.motion.checks import Status
from reframe_jax.segmentation.blocks import Blocks, Scales, make_blocks, scale_chords
from reframe_jax.segmentation.chords import LONGEST_LAG, Chords, Tracks, cut_chords, track_poses
from reframe_jax.segmentation.labels import label_segments
from reframe_jax.segmentation.partition import boundary_price, partition
from reframe_jax.segmentation.refine import Place, Search, place_boundaries
from reframe_jax.segmentation.rests import find_rests
from reframe_jax.segmentation.results import Boundary, Segment, Segmentation
from reframe_jax.segmentation.spans import Fits, fit_spans

__all__ = ["segment"]

_FEWEST = 8  # poses that can be identified in a segment
_REST = 2  # motion times that a rest lasts at least; shorter ones are pauses
_CHORDS = 2  # chords in the time in which the motion becomes independent, at least
_SHORTER = 4  # times that a chord may be shorter for that than the noise requires
_GRID = 4  # blocks in the same time


def segment(
    poses: ArrayLike,
    *,
    times: ArrayLike | None = None,
    dt: ArrayLike | None = None,
    lag: int | None = None,
    reach: float = 1.0,
) -> Segmentation:
    """Find where the constraint of a recording changes, and identify each part.

    Every span of the recording has a cost: how improbable its motion is if one constraint holds throughout,
    the unknown frame included. It is the objective of :func:`reframe_jax.identify` as a likelihood, with one
    more term for each number that the frame needs. The partition into spans of the lowest total cost is the
    result. The number of segments follows from it, and nothing is to be tuned. A constraint that does not
    hold, free motion, is one of the possibilities. Rest says nothing about a constraint: a pause within a
    motion does not divide it. Rest between different constraints, at the start and at the end is a segment of
    its own.

    Computed in float64 on the processor. Boundaries are whole numbers, so the function is not differentiable;
    what is found between them is: identify the poses of a segment with :func:`reframe_jax.identify`.

    Args:
        poses: (N, 4, 4) poses of the moving body {b} in the ground {g}, m; N >= 16.
        times: (N,) sample times in s, increasing. Give either ``times`` or ``dt``.
        dt: sample time in s, a scalar or (N-1,).
        lag: samples between the two poses of a velocity. By default as many as the noise requires, or fewer,
            down to a quarter, where that is more than half the motion time.
        reach: m, half the width of the cube in which origins of frames are searched, about the body.

    Returns:
        The segments, in order of time, and the boundaries between them.

    Raises:
        ValueError: if shapes or options are not as above, or poses or times are unusable.
    """
    if traced((poses, times, dt)):
        raise ValueError("segment needs poses, not tracers: call it outside jit, vmap and grad.")
    poses, times = _checked(poses, times, dt)
    if not 0 < reach < np.inf:
        raise ValueError(f"reach must be a positive length in m, not {reach}.")
    with jax.enable_x64(True):
        return _segment(poses, times, lag, reach)


def _segment(poses: np.ndarray, times: np.ndarray, lag: int | None, reach: float) -> Segmentation:
    """Segment a recording that has been checked."""
    tracks = track_poses(poses, times)
    samples = tracks.lag if lag is None else lag
    if not 1 <= samples <= min(LONGEST_LAG, len(poses) // 2):
        raise ValueError(f"lag must be from 1 to {min(LONGEST_LAG, len(poses) // 2)} samples, not {lag}.")
    samples, chords, scales = _cut(tracks, samples, fixed=lag is not None)
    grid = max(samples, int(np.ceil(scales.time / _GRID / np.median(np.diff(times)))))
    starts = np.append(np.arange(0, max(len(poses) - grid, 1), grid), len(poses))
    blocks = make_blocks(tracks, chords, scales, starts)
    options = tracks.noise[1] / tracks.noise[0], reach
    spans = partition(blocks, *options)
    pauses = find_rests(tracks, chords, scales)
    motion = max(1, round(scales.time / float(np.median(np.diff(times)))))
    rests = [(a, b) for a, b in pauses if b - a >= _REST * max(motion, samples)]
    fits = fit_spans(blocks, [[(a, b)] for a, b in spans], *options)
    inner = fit_spans(blocks, _inner(spans), *options)
    cuts = _place_cuts(tracks, blocks, spans, inner, pauses, rests, grid, max(grid, motion))
    probability = _probabilities(blocks, spans, fits, options)
    pieces, boundaries = _assemble(times, cuts, probability, rests, samples)
    found = [None if which < 0 else _identify(poses[a:b], times[a:b], reach) for a, b, which in pieces]
    labels = label_segments(
        blocks, spans, fits, [f for f, p in zip(found, pieces, strict=True) if p[2] >= 0], options
    )
    segments = tuple(
        Segment(a, b, -1 if which < 0 else labels[which], one)
        for (a, b, which), one in zip(pieces, found, strict=True)
    )
    return Segmentation(segments, tuple(boundaries), times, samples, scales.time)


def _cut(tracks: Tracks, samples: int, *, fixed: bool) -> tuple[int, Chords, Scales]:
    """Length of chords, the chords, and their scales: no longer than the motion allows, unless fixed."""
    step = float(np.median(np.diff(tracks.times)))
    shortest = -(-samples // _SHORTER)
    while True:
        chords = cut_chords(tracks, samples)
        scales = scale_chords(tracks, chords)
        # long chords smooth the motion and make it seem slower: approached step by step
        longest = max(shortest, int(scales.time / _CHORDS / step))
        if fixed or samples <= longest:
            return samples, chords, scales
        samples = longest


def _checked(poses: Any, times: Any, dt: Any) -> tuple[np.ndarray, np.ndarray]:
    """Poses and times in float64."""
    poses = np.asarray(poses, float)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or len(poses) < 2 * _FEWEST:
        raise ValueError(f"poses must have shape (N, 4, 4) with N >= {2 * _FEWEST}, not {poses.shape}.")
    steps = np.asarray(take_steps(poses, times, dt), float)
    rotation = poses[:, :3, :3]
    skewed = np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(3)).max(initial=0)
    for wrong, status in (
        (not (np.isfinite(poses).all() and np.isfinite(steps).all()), Status.NOT_FINITE),
        (not skewed < 1e-3 or np.any(np.linalg.det(rotation) < 0), Status.NOT_A_POSE),
        (np.any(poses[:, 3] != [0, 0, 0, 1]), Status.NOT_A_POSE),
        (np.any(steps <= 0), Status.TIMES_NOT_INCREASING),
        (np.all(poses == poses[:1]), Status.NO_MOTION),
    ):
        if wrong:
            raise ValueError(status.message)
    first = 0.0 if times is None else float(np.asarray(times, float)[0])
    return poses, first + np.concatenate([[0], np.cumsum(steps)])


def _identify(poses: np.ndarray, times: np.ndarray, reach: float) -> Identification | None:
    """Identify a segment; None where it is too short or does not move."""
    if len(poses) < _FEWEST or np.all(poses == poses[:1]):
        return None
    return identify_piece(poses, times, reach)


def _inner(spans: np.ndarray) -> list[list[tuple[int, int]]]:
    """Spans without their first and last blocks, where that leaves enough: certainly within a segment."""
    long = np.diff(spans, axis=1)[:, 0] >= _GRID + 2
    return [[(int(a + cut), int(b - cut))] for (a, b), cut in zip(spans, long, strict=True)]


def _place_cuts(
    tracks: Tracks,
    blocks: Blocks,
    spans: np.ndarray,
    fits: Fits,
    pauses: list[tuple[int, int]],
    rests: list[tuple[int, int]],
    grid: int,
    near: int,
) -> list[Place | tuple[int, int]]:
    """Where each segment ends and the next begins: a place, or the rest between them."""
    cuts: list[Search | tuple[int, int]] = []
    for i in range(len(spans) - 1):
        (a, b), (c, d) = (blocks.start[spans[k]].tolist() for k in (i, i + 1))
        between = [rest for rest in rests if rest[0] < c + near and rest[1] > b - near]
        between = [rest for rest in between if rest[0] > a and rest[1] < d]
        if between:
            cuts.append((between[0][0], between[-1][1]))
            continue
        # in a short pause the boundary may be anywhere
        within = [pause for pause in pauses if pause[0] < c + grid and pause[1] > b - grid]
        low = min([b - 2 * grid, *(pause[0] - grid for pause in within)])
        high = max([c + 2 * grid, *(pause[1] + grid for pause in within)])
        cuts.append(Search(i, a, d, low, high, (a + b) // 2, (c + d + 1) // 2))
    searches = [cut for cut in cuts if isinstance(cut, Search)]
    places = iter(place_boundaries(tracks, fits, searches, grid))
    return [next(places) if isinstance(cut, Search) else cut for cut in cuts]


def _probabilities(blocks: Blocks, spans: np.ndarray, fits: Fits, options: tuple[float, float]) -> np.ndarray:
    """Probability that each segment and the next do not belong together, (S-1,)."""
    if len(spans) < 2:
        return np.zeros(0)
    pairs = [[(int(spans[i, 0]), int(spans[i + 1, 1]))] for i in range(len(spans) - 1)]
    together = fit_spans(blocks, pairs, *options).cost
    gain = together - fits.cost[:-1] - fits.cost[1:] - boundary_price(blocks)
    return 1 / (1 + np.exp(-np.clip(gain, -50, 50)))


def _assemble(
    times: np.ndarray,
    cuts: list[Place | tuple[int, int]],
    probability: np.ndarray,
    rests: list[tuple[int, int]],
    lag: int,
) -> tuple[list[tuple[int, int, int]], list[Boundary]]:
    """Pieces (start, stop, number of the segment or -1 for rest), and the boundaries between them."""
    number = len(times)

    def at(index: int, share: float, earliest: int, latest: int) -> Boundary:
        return Boundary(index, float(times[index]), share, max(earliest, 0), min(latest, number - 1))

    pieces, boundaries, start = [], [], 0
    if rests and rests[0][0] == 0 and rests[0][1] < number:
        start = rests[0][1]
        pieces.append((0, start, -1))
        boundaries.append(at(start, 1.0, start - lag, start + lag))
    for which, cut in enumerate(cuts):
        share = float(probability[which])
        if isinstance(cut, Place):
            pieces.append((start, cut.index, which))
            boundaries.append(at(cut.index, share, cut.earliest, cut.latest))
            start = cut.index
            continue
        pieces += [(start, cut[0], which), (*cut, -1)]
        boundaries += [at(edge, share, edge - lag, edge + lag) for edge in cut]
        start = cut[1]
    if rests and rests[-1][1] == number and rests[-1][0] > start:
        stop = rests[-1][0]
        pieces += [(start, stop, len(cuts)), (stop, number, -1)]
        boundaries.append(at(stop, 1.0, stop - lag, stop + lag))
    else:
        pieces.append((start, number, len(cuts)))
    return pieces, boundaries

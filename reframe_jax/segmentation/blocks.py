"""Blocks of a recording: what spans are put together from.

Moments are additive. Each block keeps those of the chords that end within it, and of those that end in the
next: a span adds up both, but for the chords that cross its end. Nothing is subtracted, so nothing cancels.
"""

from dataclasses import dataclass

import numpy as np

from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.geometry.symmetric import INDEX_PAIRS
from reframe_jax.motion.independence import independent_after
from reframe_jax.objectives.moments import MONOMIALS
from reframe_jax.segmentation.chords import Chords, Tracks

__all__ = ["Blocks", "Scales", "make_blocks", "merge_blocks", "scale_chords"]

_LEAST = 1e-12  # variance along a constrained axis over that along a free one: below it, all is rounding
_STILL = 0.01  # share of the peak speed below which the body rests
_PAUSE = 0.1  # share of the peak speeds before and after below which the body pauses
_NEAR, _FAR = 4, 8  # motion times within which these peaks lie, for some instant of a pause and for all of it
_REST = 4.0  # noises that motion along an axis must be large
_PEAK = 0.99  # quantile of speeds that is their peak
_LEVER = (
    0.1,
    1.0,
)  # m: a motion that only turns is as large as at the first, one that only slides as at the second


@dataclass(frozen=True)
class Scales:
    """What makes velocities comparable.

    Attributes:
        size: (K,) speed of each chord over that of the recording; both groups together, smoothed.
        turning: rad/s of the recording, and ``sliding``: m/s.
        time: s, in which the motion as a whole becomes independent of what it was before.
        independent: samples after which the motion says something new: between ``time`` and that of its axes.
        moving: (K,) bool, chords that count: longer than noise, and no pause.
    """

    size: np.ndarray
    moving: np.ndarray
    turning: float
    sliding: float
    time: float
    independent: float


@dataclass(frozen=True)
class Blocks:
    """Sums over the chords of each block, in units of the free motion of the recording.

    Attributes:
        start: (M+1,) index of the first pose of each block, and of the end of the last.
        angular: (2, 6, 2, M) second moments of angular velocity: chords within the block, and across its
            end; by component and frame type.
        linear: (2, 6, 10, 4, M) those of the maps, see :mod:`reframe_jax.objectives.moments`.
        sums: (2, 9, M) of the chords' number, of noise variances (angular, then linear), of the logarithms
            of the smallest variances that can be told in spite of the noise, of the positions of {b} (m) and
            of the square of their distance from the centre.
        moving: (M,) independent motions.
    """

    start: np.ndarray
    angular: np.ndarray
    linear: np.ndarray
    sums: np.ndarray
    moving: np.ndarray


def scale_chords(tracks: Tracks, chords: Chords) -> Scales:
    """Scale chords by the speed of the recording about them, so that slow motion counts like fast motion."""
    body = chords.maps[:, LinearType.BB]
    turn = np.stack([body[:, 2, 2], body[:, 0, 3], body[:, 1, 1]], axis=1)
    slide = body[:, :, 0]
    use = chords.moving
    rms = [float(np.sqrt(np.mean(np.sum(x[use] ** 2, axis=1)))) if use.any() else 1.0 for x in (turn, slide)]
    turning, sliding = np.hypot(rms[0], rms[1] / _LEVER[1]), np.hypot(rms[1], rms[0] * _LEVER[0])
    twist = np.concatenate([turn / turning, slide / sliding], axis=1)
    step = float(np.median(np.diff(tracks.times)))
    samples = independent_after(twist * use[:, None])
    half = max(1, round(samples / 2))
    use = use & ~_resting(np.linalg.norm(twist, axis=1), use, samples)
    twist = twist * use[:, None]
    squares, number = (_box(x, half) for x in (np.sum(twist**2, axis=1), use.astype(float)))
    size = np.sqrt(squares / np.maximum(number, 1))
    lowest = np.sqrt(2) * np.hypot(tracks.noise[0] / sliding, tracks.noise[1] / turning)
    size = np.maximum(size, lowest / np.where(chords.span > 0, chords.span, 1))
    rate = np.mean(1 / chords.span[use] ** 2) if use.any() else 1.0
    white = [2 * rate * (tracks.noise[1] / turning) ** 2, 2 * rate * (tracks.noise[0] / sliding) ** 2]
    axes = independent_after(_standardized(twist, np.repeat(white, 3), int(np.sum(use))))
    # small axes are quicker than the motion as a whole; what is fitted depends on both
    independent = (samples + axes) / 2
    return Scales(np.where(use, size, 1), use, float(turning), float(sliding), samples * step, independent)


def _standardized(twist: np.ndarray, white: np.ndarray, count: int) -> np.ndarray:
    """Twist (K, 6) along its principal axes, all of one size: each tells as much of the motion as the others.

    Axes that do not stand out of the noise, of variances (6,), are left out: noise is not motion.
    """
    values, axes = np.linalg.eigh(twist.T @ twist / max(count, 1))
    noise = white @ axes**2
    share = np.clip(1 - _REST**2 * noise / np.maximum(values, np.finfo(float).tiny), 0, 1)
    if not np.any(share > 0):
        return twist
    return twist @ axes * np.sqrt(share / np.maximum(values, np.finfo(float).tiny))


def _resting(speed: np.ndarray, use: np.ndarray, samples: float) -> np.ndarray:
    """Where the body rests or pauses, (K,) bool: slow against all of the motion, or that before and after.

    Slow motion that lasts is motion.
    """
    if not use.any():
        return ~use
    half = round(samples / 8)
    recent = _box(speed, half) / _box(np.ones(len(speed)), half)
    # where a recording begins or ends within reach, the other side alone decides
    near = recent < _PAUSE * _peaks_about(recent, round(_NEAR * samples), np.inf)
    far = near | (recent < _PAUSE * _peaks_about(recent, round(_FAR * samples), 0))
    edges = np.flatnonzero(np.diff(np.concatenate([[0], far.astype(np.int8), [0]])))
    pauses = np.zeros(len(speed), bool)
    for start, stop in edges.reshape(-1, 2):
        pauses[start:stop] = np.any(near[start:stop])
    return pauses | (recent < _STILL * np.quantile(speed[use], _PEAK))


def _peaks_about(x: np.ndarray, reach: int, beyond: float) -> np.ndarray:
    """The smaller of the maxima before and after each element, within a reach."""
    width = max(1, reach)
    before = _rolling_maximum(x, width, beyond)
    return np.minimum(before, _rolling_maximum(x[::-1], width, beyond)[::-1])


def _rolling_maximum(x: np.ndarray, width: int, beyond: float) -> np.ndarray:
    """Maximum of each element and those before it, so many in all; ``beyond`` where there are fewer."""
    blocks = -(-len(x) // width)
    padded = np.append(x, np.full(blocks * width - len(x), -np.inf)).reshape(blocks, width)
    forward = np.maximum.accumulate(padded, axis=1).ravel()[: len(x)]
    backward = np.maximum.accumulate(padded[:, ::-1], axis=1)[:, ::-1].ravel()[: len(x)]
    first = np.arange(len(x)) - width + 1
    return np.where(first < 0, beyond, np.maximum(forward, backward[np.maximum(first, 0)]))


def _box(x: np.ndarray, half: int) -> np.ndarray:
    total = np.concatenate([[0], np.cumsum(x)])
    low, high = np.maximum(np.arange(len(x)) - half, 0), np.minimum(np.arange(len(x)) + half + 1, len(x))
    return total[high] - total[low]


def make_blocks(tracks: Tracks, chords: Chords, scales: Scales, start: np.ndarray) -> Blocks:
    """Sum up chords by blocks.

    Args:
        tracks: of the recording.
        chords: of the recording.
        scales: of the chords.
        start: (M+1,) where the blocks begin, and the end of the last.
    """
    lag = chords.lag
    number = len(start) - 1
    index = np.arange(len(chords.moving))
    block = np.clip(np.searchsorted(start, index, side="right") - 1, 0, number - 1)
    inside = index + lag < start[block + 1]
    weight = scales.moving / scales.size**2
    noise = [
        2 * (sigma / np.where(chords.span > 0, chords.span, 1) / scales.size) ** 2 for sigma in tracks.noise
    ]
    floors = np.stack([noise[1] / scales.turning**2, noise[0] / scales.sliding**2]) + _LEAST
    # a straight line through all poses of an independent motion is as much surer than one chord
    surer = min(6 * lag**2 / scales.independent**3, 1.0)
    x = tracks.positions
    ends = np.minimum(index + lag, len(index) - 1)
    middle = (x + x[ends]) / 2
    each = np.concatenate(
        [np.ones((1, len(index))), floors, np.log(surer * floors), middle.T, np.sum(middle**2, axis=1)[None]]
    )
    each = each * scales.moving
    maps = chords.maps * np.sqrt(weight)[:, None, None, None]
    rates = np.stack([maps[..., 2, 2], maps[..., 0, 3], maps[..., 1, 1]], axis=-1)
    rates = np.stack([rates[:, LinearType.GG], rates[:, LinearType.BB]], axis=1)
    assert (AngularType.G, AngularType.B) == (0, 1)
    entries = maps.reshape(len(maps), 4, 12)
    linear, angular, sums = [], [], []
    edges = start[:-1]
    for group in (inside, ~inside):
        keep = group[:, None]
        packed = []
        for i, j in INDEX_PAIRS:
            row = []
            for a, b in MONOMIALS:
                product = entries[:, :, 4 * i + a] * entries[:, :, 4 * j + b]
                if a != b:
                    product = product + entries[:, :, 4 * i + b] * entries[:, :, 4 * j + a]
                row.append(np.add.reduceat(product * keep, edges, axis=0).T)
            packed.append(np.stack(row))
        linear.append(np.stack(packed) / scales.sliding**2)
        turns = [
            np.add.reduceat(rates[..., i] * rates[..., j] * keep, edges, axis=0).T for i, j in INDEX_PAIRS
        ]
        angular.append(np.stack(turns) / scales.turning**2)
        sums.append(np.add.reduceat(each * group, edges, axis=1))
    moving = np.add.reduceat(scales.moving.astype(float), edges) / scales.independent
    return Blocks(start, np.stack(angular), np.stack(linear), np.stack(sums), moving)


def merge_blocks(blocks: Blocks, first: np.ndarray) -> Blocks:
    """Merge blocks into longer ones, given the number of the first block of each, the leading 0 included."""
    last = np.append(first[1:], len(blocks.moving)) - 1

    def merge(x: np.ndarray) -> np.ndarray:
        total = np.add.reduceat(x[0] + x[1], first, axis=-1)
        return np.stack([total - x[1][..., last], x[1][..., last]])

    return Blocks(
        start=np.append(blocks.start[first], blocks.start[-1]),
        angular=merge(blocks.angular),
        linear=merge(blocks.linear),
        sums=merge(blocks.sums),
        moving=np.add.reduceat(blocks.moving, first),
    )

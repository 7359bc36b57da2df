"""Boundaries to the sample: until when one constraint predicts the motion, and from when on the next does."""

from dataclasses import dataclass

import numpy as np

from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.segmentation.chords import Tracks, local_paths
from reframe_jax.segmentation.spans import Fits

__all__ = ["Place", "place_boundary"]

_SCATTER = 2.0  # standard deviations by which noise is taken to scatter
_EXPLAINED = 0.02  # share of the evidence of a pose's range that counts: neighbouring poses tell the same
_LIKELY = 0.95  # probability of the interval in which a boundary lies


@dataclass(frozen=True)
class Place:
    """Where a boundary lies.

    Attributes:
        index: of the pose, the median of its distribution.
        earliest, latest: indices between which it lies with a probability of 95 %.
    """

    index: int
    earliest: int
    latest: int


def place_boundary(
    tracks: Tracks, fits: Fits, before: tuple[int, int, int], after: tuple[int, int, int]
) -> Place:
    """Place a boundary between two segments.

    Along every axis of a frame the path of its origin is compared with what it does within the segment: how
    far it goes from its mean over the last poses known to be in the segment, as a function of the time since.
    Along a constrained axis that is noise, and each pose counts; along a free one it is smooth motion, of
    which neighbouring poses tell the same.

    Args:
        tracks: of the recording.
        fits: of the segments.
        before: number of the segment's fit, and the poses [start, stop) known to be in it.
        after: the same of the next segment; the boundary lies between the two.
    """
    low, high = before[2], after[1]
    if high <= low:
        return Place(low, low, low)
    forward = _surprise(tracks, fits, before, high, backward=False)
    backward = _surprise(tracks, fits, after, low, backward=True)
    # cost of the boundary at low, low + 1, ..., high
    total = np.concatenate([[0], np.cumsum(forward)]) + np.concatenate([np.cumsum(backward[::-1])[::-1], [0]])
    share = np.cumsum(np.exp(total.min() - total))
    share /= share[-1]
    found = np.searchsorted(share, [0.5, (1 - _LIKELY) / 2, (1 + _LIKELY) / 2])
    middle, first, last = (int(index) for index in low + np.minimum(found, high - low))
    return Place(middle, first, last)


def _surprise(
    tracks: Tracks, fits: Fits, segment: tuple[int, int, int], end: int, *, backward: bool
) -> np.ndarray:
    """Cost of each pose between a segment and the other end, (M,), in order of time, if it belongs to it."""
    which, start, stop = segment
    count = abs(end - (start if backward else stop))
    inside = min(stop - start, 4 * count + 4)
    anchor = max(1, min(tracks.lag, inside // 4))
    if backward:
        path = _along_axes(tracks, fits, which, end, start + inside)[::-1]
    else:
        path = _along_axes(tracks, fits, which, stop - inside, end)
    ahead, known = path[inside:], path[:inside]
    floor = 1e-9 + tracks.noise[1], 1e-9 + tracks.noise[0]
    least = np.repeat(np.asarray(floor), 3)
    # how far the path goes from its mean over an anchor, as a function of the poses since
    lead = np.minimum(np.arange(count), inside - anchor - 1)
    totals = np.cumsum(np.concatenate([np.zeros((1, 6)), known]), axis=0)
    means = (totals[anchor:] - totals[:-anchor]) / anchor
    expected = np.empty((count, 6))
    for step in range(count):
        there = anchor + lead[step]
        gone = known[there:] - means[: len(known) - there]
        expected[step] = np.mean(gone**2, axis=0) if len(gone) else np.inf
    expected = np.maximum.accumulate(np.maximum(expected, least**2), axis=0)
    # no cost within the scatter of noise, so that chance does not decide where both constraints predict a
    # pose; then it belongs rather to the one that leaves it the smaller range
    weight = expected[0] / expected[-1]
    surprise = np.sum(weight * (ahead - means[-1]) ** 2 / expected, axis=1)
    usual = np.sum(weight) + _SCATTER * np.sqrt(2 * np.sum(weight**2))
    cost = np.maximum(surprise - usual, 0) / 2 + _EXPLAINED * np.sum(np.log(expected[-1])) / 2
    return cost[::-1] if backward else cost


def _along_axes(tracks: Tracks, fits: Fits, which: int, start: int, stop: int) -> np.ndarray:
    """Path along the axes of a fitted frame, (M, 6): rad of the angular axes, then m of the linear ones."""
    kind = LinearType(int(fits.linear_type[which]))
    paths = local_paths(tracks, start, stop)
    x = paths[:, kind, :, 0] + paths[:, kind, :, 1:] @ fits.position[which]
    turned = paths[:, LinearType.GG if fits.angular_type[which] == AngularType.G else LinearType.BB]
    turns = np.stack([turned[:, 2, 2], turned[:, 0, 3], turned[:, 1, 1]], axis=-1)
    return np.concatenate([turns @ fits.angular_axes[which], x @ fits.linear_axes[which]], axis=1)

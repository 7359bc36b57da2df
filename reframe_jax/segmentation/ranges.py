"""Which segment each pose belongs to, where neither constraint holds to the noise: by ranges of motion.

A soft contact or a tracker with slow errors leaves every axis some motion. What tells it from free motion is
how far the path goes from its recent mean.
"""

import numpy as np

from reframe_jax.segmentation.chords import Tracks
from reframe_jax.segmentation.sides import Side, path_along_axes, paths_at
from reframe_jax.segmentation.spans import Fits

__all__ = ["range_costs"]

_SCATTER = 2.0  # standard deviations by which noise is taken to scatter
_EXPLAINED = 0.02  # share of the evidence of a pose's range that counts: neighbouring poses tell the same


def range_costs(tracks: Tracks, fits: Fits, before: Side, after: Side) -> np.ndarray:
    """Compute what every place of a boundary costs, (n + 1,) nats: behind none of the n open poses, ...

    Along every axis of a frame the path of its origin is compared with what it does within the segment: how
    far it goes from its mean over the last poses known to be in the segment, as a function of the time since.
    Along a constrained axis that is noise, and each pose counts; along a free one it is smooth motion, of
    which neighbouring poses tell the same.

    Args:
        tracks: of the recording.
        fits: of the segments.
        before: the side before the boundary.
        after: the side behind it, with the same open poses.
    """
    forward, backward = (_surprise(tracks, fits, side) for side in (before, after))
    return np.concatenate([[0], np.cumsum(forward)]) + np.concatenate([np.cumsum(backward[::-1])[::-1], [0]])


def _surprise(tracks: Tracks, fits: Fits, side: Side) -> np.ndarray:
    """Cost of each open pose, (n,) in order of time, if it belongs to the segment of this side."""
    count = side.open
    inside = min(side.stop - side.start, 4 * count + 4)
    anchor = max(1, min(tracks.lag, inside // 4))
    path = path_along_axes(paths_at(tracks, side.poses(inside)), fits, side.which)
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
    return cost[::-1] if side.backward else cost

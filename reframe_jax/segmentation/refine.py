"""Boundaries to the sample: until when one constraint predicts the motion, and from when on the next does."""

from dataclasses import dataclass

import numpy as np

from reframe_jax.segmentation.chords import Tracks
from reframe_jax.segmentation.likelihood import place_costs
from reframe_jax.segmentation.ranges import range_costs
from reframe_jax.segmentation.sides import Side
from reframe_jax.segmentation.spans import Fits

__all__ = ["Place", "Search", "place_boundaries"]

_LIKELY = 0.95  # probability of the interval in which a boundary lies
_TOGETHER = 64  # boundaries placed at once


@dataclass(frozen=True)
class Place:
    """Where a boundary lies.

    Attributes:
        index: of the first pose behind it, the median of its distribution.
        earliest, latest: indices of the poses between which it lies with a probability of 95 %.
    """

    index: int
    earliest: int
    latest: int


@dataclass(frozen=True)
class Search:
    """Where to look for a boundary.

    Attributes:
        which: number of the fit before it; the next one is that behind it.
        start, stop: indices of the first pose of the segment before it, and behind the last of that after.
        low, high: indices between which to look first.
        lowest, highest: and as far as it takes.
    """

    which: int
    start: int
    stop: int
    low: int
    high: int
    lowest: int
    highest: int


def place_boundaries(tracks: Tracks, fits: Fits, searches: list[Search], step: int) -> list[Place]:
    """Place boundaries between two poses each.

    Args:
        tracks: of the recording.
        fits: of the segments.
        searches: where to look, one for each boundary.
        step: poses by which to look farther where a boundary may lie beyond.
    """
    places: list[Place] = []
    for first in range(0, len(searches), _TOGETHER):
        places += _place_together(tracks, fits, searches[first : first + _TOGETHER], step)
    return places


def _place_together(tracks: Tracks, fits: Fits, searches: list[Search], step: int) -> list[Place]:
    ends = [(max(s.low, s.lowest), min(s.high, s.highest)) for s in searches]
    places = [Place(low, low, low) for low, _ in ends]
    left = [i for i, (low, high) in enumerate(ends) if low < high]
    while left:
        pairs = [_sides(searches[i], *ends[i]) for i in left]
        beyond = []
        for i, pair, costs in zip(left, pairs, place_costs(tracks, fits, pairs), strict=True):
            s, (low, high) = searches[i], ends[i]
            found = _read(range_costs(tracks, fits, *pair) if costs is None else costs)
            places[i] = Place(low + found[0], max(low + found[1] - 1, 0), low + found[2] + 1)
            before, after = (
                low > s.lowest and found[1] < step,
                high < s.highest and low + found[2] > high - step,
            )
            if before or after:
                ends[i] = max(low - before * step, s.lowest), min(high + after * step, s.highest)
                beyond.append(i)
        left = beyond
    return places


def _sides(search: Search, low: int, high: int) -> tuple[Side, Side]:
    return (
        Side(search.which, search.start, low, high, backward=False),
        Side(search.which + 1, high, search.stop, low, backward=True),
    )


def _read(costs: np.ndarray) -> list[int]:
    """Median of the distribution over places that these costs mean, and the ends of its likely part."""
    share = np.cumsum(np.exp(costs.min() - costs))
    places = np.searchsorted(share / share[-1], [0.5, (1 - _LIKELY) / 2, (1 + _LIKELY) / 2])
    return [int(place) for place in np.minimum(places, len(costs) - 1)]

"""The best partition of a recording into spans, given what every span costs."""

import numpy as np

from reframe_jax.segmentation.blocks import Blocks, merge_blocks
from reframe_jax.segmentation.spans import LONGEST, span_costs

__all__ = ["boundary_price", "partition"]

_SHORT = 1e6  # nats that a span of less than one motion costs more: chosen only where nothing else is left


def boundary_price(blocks: Blocks) -> float:
    """Cost of a boundary in nats: it may lie at any of the recording's independent motions."""
    return float(np.log(max(np.sum(blocks.moving), 2)))


def partition(blocks: Blocks, noise_ratio: float, reach: float) -> np.ndarray:
    """Find the partition of the lowest cost.

    Spans longer than the longest computed are put together from shorter ones, until nothing is gained.
    Where the constraint changes, one block may belong to neither segment.

    Returns:
        (S, 2) first block of every segment, and the first behind it.
    """
    edges = np.arange(len(blocks.moving) + 1)
    single = np.ones(len(blocks.moving), bool)
    price = boundary_price(blocks)
    while True:
        merged = merge_blocks(blocks, edges[:-1])
        costs = span_costs(merged, noise_ratio, reach) + _SHORT * _too_short(merged.moving)
        chosen = _cheapest(costs, merged.moving, price, single)
        kept = np.unique(np.concatenate([[0, len(edges) - 1], chosen.ravel()]))
        if len(kept) == len(edges):
            return _join_motionless(edges[chosen], blocks.moving)
        edges = edges[kept]
        single = np.diff(edges) == 1


def _too_short(moving: np.ndarray) -> np.ndarray:
    """Whether each span moves, but by less than one independent motion, (M, LONGEST) bool."""
    total = np.concatenate([[0], np.cumsum(moving)])
    first = np.arange(len(moving))[:, None]
    motions = total[np.minimum(first + np.arange(1, LONGEST + 1), len(moving))] - total[first]
    return (motions > 0) & (motions < min(1.0, total[-1]))


def _join_motionless(spans: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """Spans (S, 2), those without motion joined to the one before them, or at the start to the one behind."""
    moves = np.array([bool(np.any(moving[a:b])) for a, b in spans])
    kept = spans[moves].copy()
    if not len(kept):
        return np.array([[0, len(moving)]])
    for a, b in spans[~moves]:
        own = max(int(np.searchsorted(kept[:, 0], a, side="right")) - 1, 0)
        kept[own] = min(kept[own, 0], a), max(kept[own, 1], b)
    return kept


def _cheapest(costs: np.ndarray, moving: np.ndarray, price: float, single: np.ndarray) -> np.ndarray:
    """Spans that cost least together, (S, 2)."""
    number, longest = costs.shape
    least, before = np.full(number + 1, np.inf), np.zeros(number + 1, int)
    # at the end of a segment, and at the start of the next: one block may lie between them, but not beside
    # a span without motion, which costs nothing
    ready, skipped = np.full(number + 1, np.inf), np.zeros(number + 1, bool)
    least[0] = ready[0] = -price
    motion = np.concatenate([[0], np.cumsum(moving > 0)])
    for end in range(1, number + 1):
        starts = np.arange(max(0, end - longest), end)
        moves = motion[starts] < motion[end]
        total = np.where(moves, ready[starts], least[starts]) + costs[starts, end - 1 - starts] + price
        choice = int(np.argmin(total))
        least[end], before[end] = total[choice], starts[choice]
        may_skip = end > 1 and single[end - 1] and motion[before[end - 1]] < motion[end - 1]
        skipped[end] = may_skip and least[end - 1] < least[end]
        ready[end] = least[end - 1] if skipped[end] else least[end]
    spans, end = [], number
    while end > 0:
        start = int(before[end])
        spans.append((start, end))
        end = start - 1 if skipped[start] and motion[start] < motion[end] else start
    return np.asarray(spans[::-1])

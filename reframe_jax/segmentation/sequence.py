"""Find the most probable sequence of models by Viterbi's algorithm.

Each model is evaluated near its span only, so the cost is linear in the length of the recording.
"""

from bisect import bisect_right
from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np

from reframe_jax.segmentation.bank import Bank, gains
from reframe_jax.segmentation.cells import Cells

FREE = -1
_BATCH = 50_000  # values per batch


class Coverage(NamedTuple):
    """Log evidence of each model in the cells near its span. Models without common cells share a column."""

    gain: np.ndarray  # (N, W) in each cell, of the model that occupies a column there; -inf if none does
    column: np.ndarray  # (H,) column of each model
    first: np.ndarray  # (H,) first cell in the range of each model

    def join(self, other: "Coverage") -> "Coverage":
        """Append the models of another coverage."""
        gain = np.concatenate([self.gain, other.gain], axis=1)
        column = np.concatenate([self.column, other.column + self.gain.shape[1]])
        return Coverage(gain, column, np.concatenate([self.first, other.first]))


def cover(cells: Cells, bank: Bank) -> Coverage:
    """Evaluate models in their spans, and one span length on either side."""
    number = cells.linear.shape[1]
    start, stop = bank.span.T
    low, high = np.maximum(2 * start - stop, 0), np.minimum(2 * stop - start, number)
    column = columns_of(low, high)
    gain = np.full((number, column.max() + 1), -np.inf)
    for extent in np.unique(high - low):
        own = np.flatnonzero(high - low == extent)
        for part in np.array_split(own, -(-len(own) * extent // _BATCH)):
            at, some = low[part, None] + np.arange(extent), bank.take(part)
            values = some.coordinates(cells.linear, cells.angular, at)
            gain[at, column[part, None]] = cells.weight * gains(some, values)
    return Coverage(gain, column, low)


def columns_of(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Assign intervals [low, high) of cells, (H,), to the fewest columns (H,), without overlaps in any."""
    column = np.zeros(len(low), int)
    ends: list[tuple[int, int]] = []
    for k in np.argsort(low, kind="stable"):
        column[k] = heappop(ends)[1] if ends and ends[0][0] <= low[k] else len(ends)
        heappush(ends, (int(high[k]), int(column[k])))
    return column


def likeliest(coverage: Coverage, price: float) -> np.ndarray:
    """Find the sequence of models with the largest log evidence, of which each use of a model costs a price.

    The result is the index of the model of each cell, (N,), -1 for free motion, which has the evidence 0.
    """
    gain, column, first = coverage
    number, width = gain.shape
    order = np.lexsort((column, first))
    begins = np.searchsorted(first[order], np.arange(number + 1))
    value = np.full(width, -np.inf)
    best, best_column = 0.0, np.full(number, FREE)
    stayed = np.empty((number, width), bool)
    for k in range(number):
        if begins[k] < begins[k + 1]:
            value[column[order[begins[k] : begins[k + 1]]]] = -np.inf
        enter = best - price
        np.greater_equal(value, enter, out=stayed[k])
        np.maximum(value, enter, out=value)
        value += gain[k]
        top = int(value.argmax())
        if value[top] > best:
            best, best_column[k] = float(value[top]), top
    path = np.full(number, FREE)
    order = np.lexsort((first, column))
    edges = np.searchsorted(column[order], np.arange(width + 1))
    here = FREE
    for k in range(number - 1, -1, -1):
        if here == FREE:
            here = best_column[k]
        if here != FREE:
            own = order[edges[here] : edges[here + 1]]
            path[k] = own[bisect_right(first[own], k) - 1]
            if not stayed[k, here]:
                here = FREE
    return path

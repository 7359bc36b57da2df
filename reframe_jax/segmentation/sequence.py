"""Find the most likely sequence of models by Viterbi's algorithm; each model has a limited range of cells."""

from typing import NamedTuple

import numpy as np

from reframe_jax.segmentation.bank import Bank, gains
from reframe_jax.segmentation.cells import Cells

__all__ = ["Coverage", "evaluate_models", "most_likely_sequence"]

FREE = -1
_BATCH = 400_000  # values per batch


class Coverage(NamedTuple):
    """Log evidence of models in the cells of their range.

    Attributes:
        model: (E,) number of the model.
        cell: (E,) number of the cell.
        gain: (E,) log evidence of the model in the cell.
    """

    model: np.ndarray
    cell: np.ndarray
    gain: np.ndarray


def evaluate_models(cells: Cells, z: np.ndarray, bank: Bank, first: int, widen: float) -> Coverage:
    """Evaluate models in their spans, and up to one span length beyond on either side.

    Args:
        cells: cells of the recording.
        z: (N, 54) features of all types.
        bank: the models.
        first: number of the first model.
        widen: factor on the residuals of the models.
    """
    start, stop = bank.span.T
    length = stop - start
    low, high = np.maximum(start - length, 0), np.minimum(stop + length, len(z))
    parts: list[Coverage] = []
    for extent in np.unique(high - low):
        own = np.flatnonzero(high - low == extent)
        for part in np.array_split(own, -(-len(own) * extent // _BATCH)):
            cell = low[part, None] + np.arange(extent)
            some = bank.take(part)
            values = z[cell] @ np.swapaxes(some.rows, 1, 2)
            gain = cells.weight * gains(some, values, cells.reference, widen)
            model = np.broadcast_to(first + part[:, None], cell.shape)
            parts.append(Coverage(model.ravel(), cell.ravel(), gain.ravel()))
    return Coverage(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def most_likely_sequence(coverage: Coverage, price: np.ndarray, number: int) -> tuple[np.ndarray, float]:
    """Find the sequence of models with the largest log evidence.

    Args:
        coverage: log evidence of all models.
        price: (H,) log evidence that is subtracted for each use of a model.
        number: number of cells.

    Returns:
        (N,) number of the model in every cell, -1 for free motion, and the log evidence of the sequence.
    """
    models = len(price)
    # the last model is free motion, with zero evidence and zero price
    price = np.append(price, 0.0)
    order = np.argsort(coverage.cell * (models + 1) + coverage.model, kind="stable")
    model, gain = coverage.model[order], coverage.gain[order]
    edges = np.searchsorted(coverage.cell[order], np.arange(number + 1))
    value = np.full(models + 1, -np.inf)
    best, best_value = models, 0.0
    before, stayed = np.full(number, models), []
    for k in range(number):
        own = np.append(model[edges[k] : edges[k + 1]], models)
        switch = best_value - price[own]
        stay = value[own] >= switch
        stayed.append(stay)
        before[k] = best
        now = np.where(stay, value[own], switch)
        now[:-1] += gain[edges[k] : edges[k + 1]]
        value = np.full(models + 1, -np.inf)
        value[own] = now
        best = int(own[now.argmax()])
        best_value = float(now.max())
    path = np.empty(number, int)
    here = best
    for k in range(number - 1, -1, -1):
        path[k] = here
        place = (
            len(stayed[k]) - 1 if here == models else np.searchsorted(model[edges[k] : edges[k + 1]], here)
        )
        if not stayed[k][place]:
            here = int(before[k])
    return np.where(path == models, FREE, path), best_value

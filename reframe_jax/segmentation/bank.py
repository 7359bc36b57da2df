"""A bank of models of constraints, fitted to spans of a recording, and the evidence for each model.

A model is a set of held coordinates: scalars, such as the height of a tip above a plane, that hardly change
in the span. A span is a range of cells; for rows, see :mod:`reframe_jax.segmentation.rows`.
"""

from typing import NamedTuple

import numpy as np

from reframe_jax.segmentation.cells import Cells
from reframe_jax.segmentation.rows import Fits, fit_spans
from reframe_jax.tuning import SEGMENTS as C

_KEPT = 4  # models of a span
_BATCH = 400  # spans per batch: their moments fit the cache of a processor
_ANGULAR_PARAMETERS = np.array([0, 2, 2, 0])  # directions of 0 to 3 held rotations, which cost evidence


class Bank(NamedTuple):
    """H models, each with up to three held translations and up to three held rotations.

    ``shifts`` and ``turns`` have one row for each held translation or rotation; unused rows are 0.
    """

    span: np.ndarray  # (H, 2) first cell, and the cell after the last, to which a model was fitted
    held: np.ndarray  # (H, 2) numbers of held translations and held rotations
    kind: np.ndarray  # (H, 2) codes of the linear and the angular type
    shifts: np.ndarray  # (H, 3, 12) weights of the features of the linear type
    turns: np.ndarray  # (H, 3, 3) weights of the features of the angular type
    middle: np.ndarray  # (H, 6) m and rad, mean values of the held coordinates, translations first
    size: np.ndarray  # (H, 6) m and rad, RMS deviations from ``middle``; infinite for unused rows
    score: np.ndarray  # (H,) log evidence for the model in its own span, minus the price of a segment
    reference: np.ndarray  # (H,) sum of the logarithms of the amplitudes of the coordinates if they are free

    def take(self, index: np.ndarray | list[int]) -> "Bank":
        """Select models by index."""
        return Bank(*(leaf[np.asarray(index, int)] for leaf in self))

    def join(self, *others: "Bank") -> "Bank":
        """Append other banks."""
        return Bank(*(np.concatenate(leaves) for leaves in zip(self, *others, strict=True)))

    def coordinates(self, linear: np.ndarray, angular: np.ndarray, at: np.ndarray) -> np.ndarray:
        """Evaluate the coordinates (H, E, 6), in m and rad, of the models in chosen cells.

        The features are those of all cells; ``at`` (H, E) are indices of cells. Unused rows give 0.
        """
        shifts = linear[self.kind[:, :1], at] @ np.swapaxes(self.shifts, 1, 2)
        turns = angular[self.kind[:, 1:], at] @ np.swapaxes(self.turns, 1, 2)
        return np.concatenate([shifts, turns], axis=2)


def fit_models(cells: Cells, spans: np.ndarray) -> Bank:
    """Fit models to spans (P, 2), in parts of bounded memory, and keep the best models of each span."""
    parts = np.array_split(spans, -(-len(spans) // _BATCH))
    first, *others = (choose_models(cells, part, fit_spans(cells, part)) for part in parts)
    return first.join(*others)


def best_scores(bank: Bank) -> dict[tuple[int, ...], float]:
    """Largest score of a model of each span that has a model."""
    order = np.argsort(bank.score, kind="stable")
    return dict(zip(map(tuple, bank.span[order].tolist()), bank.score[order].tolist(), strict=True))


def choose_models(cells: Cells, spans: np.ndarray, fits: Fits) -> Bank:
    """Choose the best models, at most four, of each span.

    A model needs evidence above the price of a segment; a model that lacks less than this price is also kept,
    because a longer span may supply the missing evidence.
    """
    count = (spans[:, 1] - spans[:, 0]) * cells.weight
    most, most_turn = cells.bound(C.held)
    references = cells.references(spans)
    # once one row is held, further rows are by chance as small as a single row
    further = np.minimum(most, np.maximum(3 * cells.floor[0], C.reference * np.exp(references[:, 1, :1])))
    limits = np.stack([np.full_like(further, most), further, further], axis=1)
    linear, linear_type = _log_sizes(fits.size, limits)
    every = np.where(np.arange(3) < np.arange(1, 4)[:, None, None], fits.turn[:, None], np.inf)
    angular, angular_type = _log_sizes(every, most_turn)
    both = np.maximum(references - (linear[:, :, None] + angular[:, None]), 0)
    both = np.where(np.isfinite(linear[:, :, None] + angular[:, None]), both, -np.inf)
    # stillness: no coordinate moves, for a longer time than at a turning point
    both[:, 3, 3] = np.where(count >= 1, 0, -np.inf)
    for size, reference, bound in zip((fits.size, every), cells.reference, cells.bound(C.still), strict=True):
        both[:, 3, 3] += 3 * np.log(reference) - _log_sizes(size, bound)[0][:, 3]
    turned = np.where(np.isfinite(angular), np.maximum(references[:, 0] - angular, 0), 0)
    each = turned / np.maximum(np.arange(4), 1)
    score = count[:, None, None] * both - cells.price - (_ANGULAR_PARAMETERS * each)[:, None]
    score[:, 0, 0] = -np.inf
    score = score.reshape(-1, 16)
    order = np.argsort(-score, axis=1)[:, :_KEPT]
    span, rank = np.nonzero(np.take_along_axis(score, order, axis=1) > -cells.price)
    chosen = order[span, rank]
    held = np.stack([chosen // 4, chosen % 4], axis=1)
    kind = np.stack([linear_type[span, held[:, 0]], angular_type[span, held[:, 1]]], axis=1)
    number, linear_kind, angular_kind = np.maximum(held[:, 0] - 1, 0), *kind.T
    which, which_turn = (span, number, linear_kind), (span, angular_kind)
    mean = fits.linear_mean[span, linear_kind], fits.angular_mean[which_turn]
    shifts, shift, rms = _held_rows(fits.weights[which], fits.size[which], mean[0], held[:, 0])
    turns, turn, rms_turn = _held_rows(fits.axes[which_turn], fits.turn[which_turn], mean[1], held[:, 1])
    return Bank(
        span=spans[span],
        held=held,
        kind=kind,
        shifts=shifts,
        turns=turns,
        middle=np.concatenate([shift, turn], axis=1),
        size=np.concatenate([rms, rms_turn], axis=1),
        score=score[span, chosen],
        reference=np.where(chosen == 15, 3 * np.log(cells.reference).sum(), references[span, *held.T]),
    )


def _log_sizes(size: np.ndarray, most: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum log(size) over 0 to 3 held coordinates, (P, 4), for the best type, and find this type, (P, 4).

    ``size`` (P, 3, T, 3) is the RMS of 1, 2 and 3 held coordinates in T types, infinite for unused ones;
    ``most`` the largest RMS of a held coordinate, (P, 3, 1) if it depends on the number of coordinates.
    """
    counted = np.isfinite(size)
    held = np.all((size < np.asarray(most)[..., None]) | ~counted, axis=-1)
    value = np.where(held, np.sum(np.log(np.where(counted, size, 1)), axis=-1), np.inf)
    total, kind = (np.pad(each, ((0, 0), (1, 0))) for each in (value.min(axis=-1), value.argmin(axis=-1)))
    return total, kind


def _held_rows(
    weights: np.ndarray, rms: np.ndarray, mean: np.ndarray, count: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Keep ``count`` (H,) rows (H, 3, F); return them with their values at mean features (H, F), and RMS."""
    used = np.arange(3) < count[:, None]
    weights = np.where(used[:, :, None], weights, 0)
    return weights, np.einsum("hrf,hf->hr", weights, mean), np.where(used, rms, np.inf)


def gains(bank: Bank, values: np.ndarray) -> np.ndarray:
    """Log evidence (H, N) that coordinates (H, N, 6) are held by models."""
    used = np.isfinite(bank.size)
    sizes = np.sum(np.log(np.where(used, bank.size, 1)), axis=1)
    return np.maximum(bank.reference - sizes, 0)[:, None] - misfit(bank, values)


def misfit(bank: Bank, values: np.ndarray) -> np.ndarray:
    """Negative log likelihood (H, N) of coordinates (H, N, 6) under models.

    The value is about 0 in a cell where the model holds, and grows with the residuals.
    """
    residual = (values - bank.middle[:, None]) / bank.size[:, None]
    each = np.prod(1 + residual**2 / C.tail, axis=-1)  # 1 for a coordinate that is not held
    return (C.tail + 1) / 2 * np.log(each) - np.sum(bank.held, axis=1)[:, None] / 2

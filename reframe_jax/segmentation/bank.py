"""A bank of constraint models, fitted to spans of a recording, and their likelihood in every cell.

A model states which coordinates of the motion are constrained; the names in this package call them held.
"""

from typing import NamedTuple

import numpy as np

from reframe_jax.segmentation.cells import Cells
from reframe_jax.segmentation.constants import SEGMENTS as C
from reframe_jax.segmentation.rows import Fits

__all__ = ["Bank", "choose_models", "gains", "join_features", "misfit"]

_KEPT = 4  # most models per span
_PARAMETERS = np.array([[0, 0, 0, 0], [5, 5, 3, 2], [5, 5, 4, 2], [3, 3, 2, 0]])
"""Number of parameters (directions and origins) for 0 to 3 held translations and 0 to 3 held rotations."""
_ANGULAR_PARAMETERS = np.array([0, 2, 2, 0])


class Bank(NamedTuple):
    """A set of H constraint models.

    Attributes:
        span: (H, 2) first cell and end cell of the span to which each model was fitted.
        held: (H, 2) number of held translations and of held rotations.
        rows: (H, 6, 54) weights that give each held coordinate as a sum of the features.
        middle: (H, 6) m or rad, mean value of each held coordinate.
        size: (H, 6) m or rad, RMS deviation from the mean; inf for coordinates that are not held.
        price: (H,) log evidence that is subtracted for each use of the model.
        score: (H,) log evidence of the model in its own span, minus the price.
        motion: (H,) m, largest motion in the span.
    """

    span: np.ndarray
    held: np.ndarray
    rows: np.ndarray
    middle: np.ndarray
    size: np.ndarray
    price: np.ndarray
    score: np.ndarray
    motion: np.ndarray

    def take(self, index: np.ndarray | list[int]) -> "Bank":
        """Select models by index."""
        return Bank(*(leaf[index] for leaf in self))

    def join(self, *others: "Bank") -> "Bank":
        """Concatenate these models with other models."""
        return Bank(*(np.concatenate(leaves) for leaves in zip(self, *others, strict=True)))


def join_features(linear: np.ndarray, angular: np.ndarray) -> np.ndarray:
    """Concatenate the features of all frame types, (N, 54)."""
    return np.concatenate([*linear, *angular], axis=1)


def choose_models(cells: Cells, spans: np.ndarray, fits: Fits) -> Bank:
    """Choose the best models of each span (P, 2) whose evidence exceeds, or almost exceeds, their price.

    A model may lack ``slack`` log evidence, because its segment may be longer than the span.
    """
    count = (spans[:, 1] - spans[:, 0]) * cells.weight
    own = fits.motion[:, None] / C.gap
    most = [
        np.minimum(bound, np.maximum(3 * floor, own / lever))
        for bound, floor, lever in zip(cells.bound, cells.floor, (1, C.lever), strict=True)
    ]
    linear, linear_type = _log_ratios(fits.size, cells.reference[0], most[0])
    every = np.where(np.arange(3) < np.arange(1, 4)[:, None, None], fits.turn[:, None], np.inf)
    angular, angular_type = _log_ratios(every, cells.reference[1], most[1])
    both = linear[:, :, None] + angular[:, None]
    # a still body moves along no coordinate, for longer than at a turning point of a motion
    both[:, 3, 3] = np.where(count >= C.still_time, 0, -np.inf)
    for size, reference, bound in zip((fits.size, every), cells.reference, cells.still_bound, strict=True):
        both[:, 3, 3] += _log_ratios(size, reference, np.full_like(own, bound))[0][:, 3]
    linear, angular = (
        np.where(np.isfinite(each), each, 0) / np.maximum(np.arange(4), 1) for each in (linear, angular)
    )
    price = C.price + _PARAMETERS * linear[:, :, None] + (_ANGULAR_PARAMETERS * angular)[:, None]
    price[:, 3, 3] = C.price
    score = count[:, None, None] * both - price
    score[:, 0, 0] = -np.inf
    score = score.reshape(-1, 16)
    order = np.argsort(-score, axis=1)[:, :_KEPT]
    span, rank = np.nonzero(np.take_along_axis(score, order, axis=1) > -C.slack)
    chosen = order[span, rank]
    held = np.stack([chosen // 4, chosen % 4], axis=1)
    kinds = linear_type[span, held[:, 0]], angular_type[span, held[:, 1]]
    rows, middle, size = _held_rows(fits, span, held, kinds)
    return Bank(
        spans[span],
        held,
        rows,
        middle,
        size,
        price.reshape(-1, 16)[span, chosen],
        score[span, chosen],
        fits.motion[span],
    )


def _log_ratios(size: np.ndarray, reference: float, most: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum of log(reference / size) over 0 to 3 held coordinates, (P, 4), and the best frame type.

    Args:
        size: (P, 3, T, 3) RMS deviation of 1, 2 and 3 held coordinates; inf for coordinates that are not
            held.
        reference: amplitude of a free coordinate.
        most: (P, 1) largest RMS deviation of a held coordinate.
    """
    counted = np.isfinite(size)
    held = np.all((size < most[:, None, None]) | ~counted, axis=-1)
    value = np.sum(np.where(counted, np.log(np.maximum(reference / size, 1)), 0), axis=-1)
    value = np.where(held, value, -np.inf)
    best = value.argmax(axis=-1)
    value = value.max(axis=-1)
    none = np.zeros((len(size), 1))
    return np.concatenate([none, value], axis=1), np.concatenate([none.astype(int), best], axis=1)


def _held_rows(
    fits: Fits, span: np.ndarray, held: np.ndarray, kinds: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights (H, 6, 54), mean values (H, 6) and RMS deviations (H, 6) of the held coordinates of models."""
    number = len(span)
    h, three = np.arange(number)[:, None, None], np.arange(3)
    rows, size = np.zeros((number, 6, 54)), np.full((number, 6), np.inf)
    middle = np.zeros((number, 6))
    for group, (width, first) in enumerate(((12, 0), (3, 48))):
        kind, count = kinds[group], held[:, group]
        used = three < count[:, None]
        if group == 0:
            which = np.maximum(count - 1, 0)
            weights, rms = fits.weights[span, which, kind], fits.size[span, which, kind]
            mean = fits.linear_mean[span, kind]
        else:
            weights, rms = fits.axes[span, kind], fits.turn[span, kind]
            mean = fits.angular_mean[span, kind]
        own = slice(3 * group, 3 * group + 3)
        columns = first + width * kind[:, None, None] + np.arange(width)
        rows[h, own.start + three[None, :, None], columns] = np.where(used[:, :, None], weights, 0)
        size[:, own] = np.where(used, rms, np.inf)
        middle[:, own] = np.where(used, np.einsum("hrf,hf->hr", weights, mean), 0)
    return rows, middle, size


def gains(bank: Bank, values: np.ndarray, reference: tuple[float, float], widen: float = 1.0) -> np.ndarray:
    """Log evidence (H, N) that the coordinates with values (H, N, 6) are held rather than free."""
    ratio = np.log(np.maximum(np.repeat(reference, 3) / (widen * bank.size), 1))
    return np.sum(ratio, axis=1)[:, None] - misfit(bank, values, widen)


def misfit(bank: Bank, values: np.ndarray, widen: float = 1.0) -> np.ndarray:
    """Negative log likelihood (H, N) of values (H, N, 6); about 0 in cells where the model is valid."""
    residual = (values - bank.middle[:, None]) / (widen * bank.size[:, None])
    each = (C.tail + 1) / 2 * np.log1p(residual**2 / C.tail) - 0.5
    return np.sum(np.where(np.isfinite(bank.size)[:, None], each, 0), axis=-1)

"""Linear least squares of touches, some of which may be outliers: NumPy only.

Every touch gives a few rows. Fits to three touches each find the majority (least median of squares). From
there, a touch is left out where it is farther from the fit to the others than their scatter explains.
"""

from dataclasses import dataclass
from itertools import combinations
from math import comb
from statistics import NormalDist
from typing import Any

import numpy as np

__all__ = ["NORMAL_FACTOR", "Fit", "fit_touches", "student_factor"]

NORMAL_FACTOR = 1.96
"""Standard deviations that hold 95 %, of a normal distribution."""

_SUBSET, _SUBSETS, _JUDGED = 3, 600, 300  # touches in a first fit, first fits, touches that judge them
_FEWEST = 5  # touches, one of which can be named an outlier: four determine the rest twice
_CHANCE = 0.01  # that a recording without outliers loses a touch
_ROUNDS = 30
_RIDGE = 1e-9  # part of the mean of the diagonal, so that touches that agree have a fit
_ROUNDING = 1e-12  # of the largest number: the least scatter


@dataclass(frozen=True)
class Fit:
    """A linear fit to touches.

    Attributes:
        solution: (m,) unknowns.
        covariance: (m, m) of the unknowns: the variance of a row times the inverse normal matrix.
        residuals: (N, k) of every touch, outliers included.
        used: (N,) bool, touches that are no outliers.
        scatter: standard deviation of a row.
        freedom: rows beyond the unknowns, of the touches that are used.
    """

    solution: np.ndarray
    covariance: np.ndarray
    residuals: np.ndarray
    used: np.ndarray
    scatter: float
    freedom: int


def fit_touches(design: np.ndarray, target: np.ndarray) -> Fit:
    """Fit ``design @ unknowns = target`` to the touches that are no outliers.

    The order of the touches makes a difference only if there are more than 600 ways to choose three.

    Args:
        design: (N, k, m), of full rank.
        target: (N, k).

    Returns:
        The fit.
    """
    count = len(design)
    floor = _ROUNDING * max(1.0, float(np.abs(target).max()))
    used = _majority(design, target) if count >= _FEWEST else np.ones(count, bool)
    fit = _fit(design, target, used, floor)
    for _ in range(_ROUNDS if count >= _FEWEST else 0):
        kept = ~_strays(design, fit)
        if (kept == fit.used).all() or kept.sum() < max(_FEWEST - 1, (count + 1) // 2):
            break
        fit = _fit(design, target, kept, floor)
    return fit


def student_factor(freedom: Any) -> Any:
    """Standard deviations that hold 95 %, of Student's distribution (Cornish and Fisher); also of arrays."""
    z = NORMAL_FACTOR
    wider = (z**3 + z) / 4 / freedom + (5 * z**5 + 16 * z**3 + 3 * z) / 96 / freedom**2
    return z + wider + (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384 / freedom**3


def _fit(design: np.ndarray, target: np.ndarray, used: np.ndarray, floor: float) -> Fit:
    rows, unknowns = design.shape[1:]
    chosen = design[used].reshape(-1, unknowns)
    solution = np.linalg.lstsq(chosen, target[used].ravel(), rcond=None)[0]
    residuals = target - design @ solution
    freedom = int(used.sum()) * rows - unknowns
    scatter = max(float(np.sqrt(np.sum(residuals[used] ** 2) / freedom)), floor)
    covariance = scatter**2 * np.linalg.inv(chosen.T @ chosen)
    return Fit(solution, covariance, residuals, used, scatter, freedom)


def _majority(design: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The half of the touches that one of many fits to three describes best, (N,) bool."""
    count, _, unknowns = design.shape
    if comb(count, _SUBSET) <= _SUBSETS:
        subsets = np.array(list(combinations(range(count), _SUBSET)))
    else:
        draw = np.random.default_rng(0).integers(count, size=(_SUBSETS, _SUBSET))
        draw = np.sort(draw, axis=1)
        subsets = draw[(np.diff(draw, axis=1) > 0).all(axis=1)]
    judges = np.unique(np.linspace(0, count - 1, min(count, _JUDGED)).astype(int))
    some = design[subsets].reshape(len(subsets), -1, unknowns)
    normal = some.swapaxes(1, 2) @ some
    normal += _RIDGE * np.trace(normal, axis1=1, axis2=2)[:, None, None] / unknowns * np.eye(unknowns)
    right = np.einsum("sri,sr->si", some, target[subsets].reshape(len(subsets), -1))
    solutions = np.linalg.solve(normal, right[..., None])[..., 0]
    half = (len(judges) + _SUBSET + 1) // 2
    apart = target[judges] - np.einsum("jru,su->sjr", design[judges], solutions)
    spread = np.partition(np.sum(apart**2, axis=2), half - 1, axis=1)[:, half - 1]
    best = solutions[np.argmin(spread)]
    distance = np.sum((target - design @ best) ** 2, axis=1)
    size = max(_FEWEST - 1, (count + _SUBSET + 1) // 2)
    used = np.zeros(count, bool)
    used[np.argsort(distance, kind="stable")[:size]] = True
    return used


def _strays(design: np.ndarray, fit: Fit) -> np.ndarray:
    """Touches (N,) that are farther from the fit to the others than its scatter explains: F tests.

    A touch that is used is compared with the fit without that touch.
    """
    count, rows = fit.residuals.shape
    shape = design @ (fit.covariance / fit.scatter**2) @ design.swapaxes(1, 2)
    unit = np.eye(rows)
    sign = np.where(fit.used, -1.0, 1.0)[:, None, None]
    whole = unit + sign * shape
    whole += 1e-9 * unit  # of a touch without which nothing is determined
    square = np.einsum("ni,ni->n", fit.residuals, np.linalg.solve(whole, fit.residuals[..., None])[..., 0])
    total = fit.freedom * fit.scatter**2
    freedom = np.where(fit.used, fit.freedom - rows, fit.freedom)
    rest = np.where(fit.used, np.maximum(total - square, 1e-9 * total), total) / np.maximum(freedom, 1)
    ratio = square / rows / rest
    strays: np.ndarray = (_normal_score(ratio, rows, freedom) > -NormalDist().inv_cdf(_CHANCE / count)) & (
        freedom > 0
    )
    return strays


def _normal_score(ratio: np.ndarray, rows: int, freedom: np.ndarray) -> np.ndarray:
    """A normal number that is as improbable as a ratio of variances (Paulson)."""
    a, b = 2 / (9 * rows), 2 / (9 * np.maximum(freedom, 1))
    root = np.cbrt(ratio)
    score: np.ndarray = ((1 - b) * root - (1 - a)) / np.sqrt(b * root**2 + a)
    return score

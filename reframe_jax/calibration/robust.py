"""Linear least squares of touches with outliers, with NumPy only.

Each touch gives a few equations. First, many fits to three touches select the half of the touches that one
fit describes best (least median of squares). Starting from this half, each touch is compared with the fit to
the other touches, and left out if its residual is larger than their scatter explains.
"""

from dataclasses import dataclass
from itertools import combinations
from math import comb
from statistics import NormalDist
from typing import Any

import numpy as np

NORMAL_FACTOR = 1.96
"""Half width of the 95 % interval of a normal distribution, in standard deviations."""

_SUBSET, _SUBSETS, _JUDGED = 3, 600, 300  # touches in a first fit, first fits, touches that judge a first fit
_FEWEST = 5  # touches for which outliers are sought: four touches determine the fit with redundancy
_CHANCE = 0.01  # probability that a recording without outliers loses a touch
_ROUNDS = 30
_RIDGE = 1e-9  # fraction of the mean diagonal, so that equal touches have a fit
_ROUNDING = 1e-12  # least scatter, as a fraction of the largest number


@dataclass(frozen=True)
class Fit:
    """A linear fit to touches."""

    solution: np.ndarray  # (m,) unknowns
    covariance: np.ndarray  # (m, m) of the unknowns
    residuals: np.ndarray  # (N, k) of all touches, with outliers
    used: np.ndarray  # (N,) bool, False for outliers
    scatter: float  # standard deviation of a residual, in the unit of the target
    freedom: int  # degrees of freedom: equations of the used touches, minus the unknowns


def fit_touches(design: np.ndarray, target: np.ndarray) -> Fit:
    """Fit ``design @ unknowns = target`` to all touches except outliers.

    The design (N, k, m) has full rank, with k equations per touch; the target is (N, k). The order of the
    touches has an effect only if there are more than 600 ways to choose three touches.
    """
    count = len(design)
    fit = _fit(design, target, _majority(design, target) if count >= _FEWEST else np.ones(count, bool))
    for _ in range(_ROUNDS if count >= _FEWEST else 0):
        kept = ~_outliers(design, fit)
        if (kept == fit.used).all() or kept.sum() < max(_FEWEST - 1, (count + 1) // 2):
            break
        fit = _fit(design, target, kept)
    return fit


def student_factor(freedom: Any) -> Any:
    """Half width of the 95 % interval of Student's distribution, from its degrees of freedom, elementwise."""
    z = NORMAL_FACTOR
    wider = (z**3 + z) / 4 / freedom + (5 * z**5 + 16 * z**3 + 3 * z) / 96 / freedom**2
    return z + wider + (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384 / freedom**3


def _fit(design: np.ndarray, target: np.ndarray, used: np.ndarray) -> Fit:
    rows, unknowns = design.shape[1:]
    chosen = design[used].reshape(-1, unknowns)
    solution = np.linalg.lstsq(chosen, target[used].ravel(), rcond=None)[0]
    residuals = target - design @ solution
    freedom = int(used.sum()) * rows - unknowns
    least = _ROUNDING * max(1.0, float(np.abs(target).max()))
    scatter = max(float(np.sqrt(np.sum(residuals[used] ** 2) / freedom)), least)
    return Fit(solution, scatter**2 * np.linalg.inv(chosen.T @ chosen), residuals, used, scatter, freedom)


def _majority(design: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Mask (N,) of the half of the touches that one of many fits to three touches describes best."""
    count, _, unknowns = design.shape
    if comb(count, _SUBSET) <= _SUBSETS:
        subsets = np.array(list(combinations(range(count), _SUBSET)))
    else:
        draw = np.sort(np.random.default_rng(0).integers(count, size=(_SUBSETS, _SUBSET)), axis=1)
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
    distance = np.sum((target - design @ solutions[np.argmin(spread)]) ** 2, axis=1)
    used = np.zeros(count, bool)
    used[np.argsort(distance, kind="stable")[: max(_FEWEST - 1, (count + _SUBSET + 1) // 2)]] = True
    return used


def _outliers(design: np.ndarray, fit: Fit) -> np.ndarray:
    """Mask (N,) of touches whose distance from the fit to the others exceeds its scatter: an F test."""
    count, rows = fit.residuals.shape
    shape = design @ (fit.covariance / fit.scatter**2) @ design.swapaxes(1, 2)
    sign = np.where(fit.used, -1.0, 1.0)[:, None, None]
    whole = (1 + 1e-9) * np.eye(rows) + sign * shape  # singular if the fit needs the touch
    square = np.einsum("ni,ni->n", fit.residuals, np.linalg.solve(whole, fit.residuals[..., None])[..., 0])
    total = fit.freedom * fit.scatter**2
    freedom = np.where(fit.used, fit.freedom - rows, fit.freedom)
    rest = np.where(fit.used, np.maximum(total - square, 1e-9 * total), total) / np.maximum(freedom, 1)
    # a normal score with the probability of this ratio of variances (Paulson)
    root, a, b = np.cbrt(square / rows / rest), 2 / (9 * rows), 2 / (9 * np.maximum(freedom, 1))
    score = ((1 - b) * root - (1 - a)) / np.sqrt(b * root**2 + a)
    return (score > -NormalDist().inv_cdf(_CHANCE / count)) & (freedom > 0)

"""Fit rows to spans: find the directions, and the origin, along which the body moves least.

A row w contains the weights that turn the features z of a cell into one coordinate w'z.
"""

from typing import NamedTuple

import numpy as np

from reframe_jax.segmentation.cells import GROUND_TYPES, Cells
from reframe_jax.segmentation.constants import SEGMENTS as C

__all__ = ["Fits", "fit_spans"]

_STEPS = 3, 3, 4  # steps of the fits of 3, 2 and 1 held translations; each fit starts at the previous one
_HAT = np.cross(np.eye(3)[:, None], np.eye(3))  # (_HAT @ v)[:, c] = e_c x v


class Fits(NamedTuple):
    """The rows with the least motion in each of P spans, for the four linear and the two angular types.

    Attributes:
        weights: (P, 3, 4, 3, 12) rows for 1, 2 and 3 held translations, for each linear type.
        size: (P, 3, 4, 3) m, RMS of each coordinate about its mean; infinite for unused rows.
        axes: (P, 2, 3, 3) unit axes as rows, for each angular type, in ascending order of rotation.
        turn: (P, 2, 3) rad, RMS of the rotation about each of these axes.
        linear_mean, angular_mean: (P, 4, 12) and (P, 2, 3) mean features.
        motion: (P,) m, largest motion of the span.
    """

    weights: np.ndarray
    size: np.ndarray
    axes: np.ndarray
    turn: np.ndarray
    linear_mean: np.ndarray
    angular_mean: np.ndarray
    motion: np.ndarray


def fit_spans(cells: Cells, spans: np.ndarray, reach: float) -> Fits:
    """Fit rows to spans.

    Args:
        cells: cells of the recording.
        spans: (P, 2) first cell, and the cell after the last, of each span.
        reach: half the width of the cube in which origins are searched, m.
    """
    number = len(spans)
    linear_mean, linear = _moments(cells.linear, spans)
    angular_mean, angular = _moments(cells.angular, spans)
    position = np.einsum("pii->p", linear[:, 1, ::4, ::4])
    floor, floor_turn = cells.floor
    linear[..., [0, 4, 8], [0, 4, 8]] += floor**2
    variance, axes = np.linalg.eigh(angular + floor_turn**2 * np.eye(3))
    turn = np.sqrt(variance)
    middle = np.zeros((number, 4, 3))
    middle[:, GROUND_TYPES] = linear_mean[:, 1, None, ::4]
    form = np.ascontiguousarray(linear.reshape(-1, 144).T).reshape(3, 4, 3, 4, -1)
    weights, size = _least_motion_rows(form, middle.reshape(-1, 3).T, reach)
    largest = np.sqrt(np.maximum(turn[:, :, 2] ** 2 - floor_turn**2, 0)).min(axis=1)
    return Fits(
        weights=weights.reshape(3, 3, 12, number, 4).transpose(3, 0, 4, 1, 2),
        size=size.reshape(3, 3, number, 4).transpose(2, 0, 3, 1),
        axes=np.swapaxes(axes, -1, -2),
        turn=turn,
        linear_mean=linear_mean,
        angular_mean=angular_mean,
        motion=np.maximum(np.sqrt(position), C.lever * largest),
    )


def _moments(features: np.ndarray, spans: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means (P, T, F) and covariances (P, T, F, F) of features (T, N, F) over spans."""
    types, _, width = features.shape
    mean, covariance = np.empty((len(spans), types, width)), np.empty((len(spans), types, width, width))
    lengths = spans[:, 1] - spans[:, 0]
    for length in np.unique(lengths):
        own = np.flatnonzero(lengths == length)
        # parts of bounded memory
        for part in np.array_split(own, -(-len(own) * length // 50_000)):
            z = features[:, spans[part, :1] + np.arange(length)]
            middle = z.mean(axis=2)
            z = z - middle[:, :, None]
            mean[part] = np.swapaxes(middle, 0, 1)
            covariance[part] = np.swapaxes(np.swapaxes(z, 2, 3) @ z, 0, 1) / length
    return mean, covariance


def _least_motion_rows(form: np.ndarray, middle: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Fit rows (3, 3, 12, P) for 1, 2 and 3 held translations, with RMS (3, 3, P).

    Args:
        form: (3, 4, 3, 4, P) moments; the problems come last, so that every operation runs along them.
        middle: (3, P) m, centre of the cube of origins.
        reach: half the width of the cube, m.
    """
    total = np.einsum("iaibp->abp", form)
    ridge = 1e-9 + 1e-4 * np.einsum("aap->p", total[1:, 1:]) / 3
    away = total[1:, 0] + np.einsum("abp,bp->ap", total[1:, 1:], middle)
    least = middle - _solve(total[1:, 1:] + ridge * np.eye(3)[:, :, None], away)
    least = np.clip(least, middle - reach, middle + reach)

    x, axes = least, _axes(_covariance(form, least)[1])
    found = []
    for held, steps in zip((3, 2, 1), _STEPS, strict=True):
        x, axes, squares = _descend(form, x, axes, held, steps, middle, reach)
        found.append((x, axes, squares))
    weights, size = [], []
    for held, (x, axes, squares) in enumerate(reversed(found), 1):
        rows = np.swapaxes(axes, 0, 1)[:, :, None] * _with_one(x)
        weights.append(rows.reshape(3, 12, -1))
        size.append(np.where(np.arange(3)[:, None] < held, np.sqrt(squares), np.inf))
    return np.stack(weights), np.stack(size)


def _with_one(x: np.ndarray) -> np.ndarray:
    """Prepend a row of ones to vectors x (3, P)."""
    return np.concatenate([np.ones_like(x[:1]), x])


def _covariance(form: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Moments multiplied by (1, x), (3, 4, 3, P), and the covariance of the path of x, (3, 3, P)."""
    z = _with_one(x)
    half = np.einsum("iajbp,bp->iajp", form, z)
    return half, np.einsum("iajp,ap->ijp", half, z)


def _axes(covariance: np.ndarray) -> np.ndarray:
    """Eigenvectors (3, 3, P) of covariances as columns, in ascending order of variance."""
    return np.moveaxis(np.linalg.eigh(np.moveaxis(covariance, -1, 0))[1], 0, -1)


def _squares(covariance: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Mean squares (3, P) of the path along axes."""
    along = np.einsum("ijp,jkp->ikp", covariance, axes)
    return np.maximum(np.einsum("ikp,ikp->kp", along, axes), 1e-30)


def _solve(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Solve systems (n, n, P) for vectors (n, P)."""
    return np.asarray(np.linalg.solve(np.moveaxis(matrix, -1, 0), vector.T[..., None])[..., 0].T)


def _descend(
    form: np.ndarray,
    x: np.ndarray,
    axes: np.ndarray,
    held: int,
    steps: int,
    middle: np.ndarray,
    reach: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Minimize sum_{i < held} log w_i' G w_i with w_i = v_i (1, x), by Levenberg's steps.

    Args:
        form: (3, 4, 3, 4, P) moments G.
        x: (3, P) m, initial origins.
        axes: (3, 3, P), initial directions v as columns.
        held: number of rows.
        steps: number of steps.
        middle: (3, P) m, centre of the cube of origins.
        reach: half the width of the cube, m.

    Returns:
        Origins, axes, and w' G w of all rows, (3, P).
    """
    damping = np.full(x.shape[1], 1e-3)
    half, covariance = _covariance(form, x)
    square = _squares(covariance, axes)
    value = np.log(square[:held]).sum(axis=0)
    for _ in range(steps):
        step = _levenberg(form, half, covariance, axes, square, held, damping)
        there = np.clip(x - step[3:], middle - reach, middle + reach)
        turn = -0.5 * step[:3, None]
        turn /= np.maximum(np.linalg.norm(turn, axis=0) / 0.25, 1)
        across = np.cross(turn, axes, axis=0)
        turned = axes + 2 * (across + np.cross(turn, across, axis=0)) / (1 + np.sum(turn**2, axis=0))
        new_half, new_covariance = _covariance(form, there)
        new_square = _squares(new_covariance, turned)
        lower = np.log(new_square[:held]).sum(axis=0)
        good = lower < value
        old = x, axes, half, covariance, square, value
        new = there, turned, new_half, new_covariance, new_square, lower
        x, axes, half, covariance, square, value = (
            np.where(good, b, a) for a, b in zip(old, new, strict=True)
        )
        damping = np.clip(np.where(good, damping / 10, damping * 30), 1e-8, 1e3)
    return x, axes, square


def _levenberg(
    form: np.ndarray,
    half: np.ndarray,
    covariance: np.ndarray,
    axes: np.ndarray,
    square: np.ndarray,
    held: int,
    damping: np.ndarray,
) -> np.ndarray:
    """Levenberg's step (6, P) of the rotation of the axes and of x, for the tangent of the logarithms."""
    number = axes.shape[-1]
    hessian, slope = np.zeros((6, 6, number)), np.zeros((6, number))
    for i in range(held):
        v = axes[:, i]
        turned = _HAT @ v  # (3, 3, P), column c is e_c x v
        part = np.einsum("iajp,ip->ajp", half[:, 1:], v)
        inner = np.einsum("iajbp,ip->ajbp", form[:, 1:, :, 1:], v)
        along = np.einsum("ijp,jp->ip", covariance, v)
        across = np.einsum("ijp,jcp->icp", covariance, turned)
        block = np.empty_like(hessian)
        block[:3, :3] = np.einsum("icp,idp->cdp", turned, across)
        block[3:, :3] = np.einsum("ajp,jcp->acp", part, turned)
        block[:3, 3:] = np.swapaxes(block[3:, :3], 0, 1)
        block[3:, 3:] = np.einsum("ajbp,jp->abp", inner, v)
        hessian += block / square[i]
        slope[:3] += np.cross(v, along, axis=0) / square[i]
        slope[3:] += np.einsum("ajp,jp->ap", part, v) / square[i]
    diagonal = np.einsum("iip->ip", hessian)  # a view
    diagonal += damping * diagonal + 1e-10 * diagonal.max(axis=0) + 1e-30
    return _solve(hessian, slope)

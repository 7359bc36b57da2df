"""Fit rows to spans: find the directions, and the origin, along which the body moves least.

A row w contains the weights that turn the features z of a cell into one coordinate w'z.
"""

from typing import NamedTuple

import numpy as np

from reframe_jax.segmentation.cells import Cells

_STEPS = 3, 3, 4  # steps of the fits of 3, 2 and 1 held translations; each fit starts at the previous one
_HAT = np.cross(np.eye(3)[:, None], np.eye(3))  # (_HAT @ v)[:, c] = e_c x v


class Fits(NamedTuple):
    """The rows with the least motion in each of P spans, for the four linear and the two angular types."""

    weights: np.ndarray  # (P, 3, 4, 3, 12) rows for 1, 2 and 3 held translations, for each linear type
    size: np.ndarray  # (P, 3, 4, 3) m, RMS of each coordinate about its mean; infinite for unused rows
    axes: np.ndarray  # (P, 2, 3, 3) unit axes as rows, for each angular type, in ascending order of rotation
    turn: np.ndarray  # (P, 2, 3) rad, RMS of the rotation about each of these axes
    linear_mean: np.ndarray  # (P, 4, 12) mean features
    angular_mean: np.ndarray  # (P, 2, 3) mean features


def fit_spans(cells: Cells, spans: np.ndarray) -> Fits:
    """Fit rows to spans (P, 2): the first cell, and the cell after the last, of each."""
    number = len(spans)
    linear_mean, linear = _moments(cells.linear, spans)
    angular_mean, angular = _moments(cells.angular, spans)
    floor, floor_turn = cells.floor
    linear[..., [0, 4, 8], [0, 4, 8]] += floor**2
    variance, axes = np.linalg.eigh(angular + floor_turn**2 * np.eye(3))
    form = np.ascontiguousarray(linear.reshape(-1, 144).T).reshape(3, 4, 3, 4, -1)
    weights, size = _least_motion_rows(form, cells.reach)
    return Fits(
        weights=weights.reshape(3, 3, 12, number, 4).transpose(3, 0, 4, 1, 2),
        size=size.reshape(3, 3, number, 4).transpose(2, 0, 3, 1),
        axes=np.swapaxes(axes, -1, -2),
        turn=np.sqrt(variance),
        linear_mean=linear_mean,
        angular_mean=angular_mean,
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


def _least_motion_rows(form: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Fit rows (3, 3, 12, P) for 1, 2 and 3 held translations, with RMS (3, 3, P).

    The moments ``form`` are (3, 4, 3, 4, P): the problems come last, so that every operation runs along them.
    Origins are at most ``reach``, m, from that of their body along each axis.
    """
    total = np.einsum("iaibp->abp", form)
    ridge = 1e-9 + 1e-4 * np.einsum("aap->p", total[1:, 1:]) / 3
    x = np.clip(-_solve(total[1:, 1:] + ridge * np.eye(3)[:, :, None], total[1:, 0]), -reach, reach)
    covariance = np.moveaxis(_covariance(form, x)[1], -1, 0)
    axes = np.moveaxis(np.linalg.eigh(covariance)[1], 0, -1)  # columns, in ascending order of variance
    found = []
    for held, steps in zip((3, 2, 1), _STEPS, strict=True):
        x, axes, squares = _descend(form, x, axes, held, steps, reach)
        found.append((x, axes, squares))
    weights, size = [], []
    for held, (x, axes, squares) in enumerate(reversed(found), 1):
        weights.append((np.swapaxes(axes, 0, 1)[:, :, None] * _with_one(x)).reshape(3, 12, -1))
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


def _solve(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Solve systems (n, n, P) for vectors (n, P)."""
    return np.asarray(np.linalg.solve(np.moveaxis(matrix, -1, 0), vector.T[..., None])[..., 0].T)


def _descend(
    form: np.ndarray, x: np.ndarray, axes: np.ndarray, held: int, steps: int, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Minimize sum_{i < held} log w_i' G w_i with w_i = v_i (1, x), by Levenberg's steps.

    G is the form. The steps start at origins x (3, P), m, and at directions v, the columns of axes (3, 3, P).
    They keep the origins within ``reach``, m. The result is the origins, the axes, and w' G w of
    all rows, (3, P).
    """

    def evaluate(x: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, ...]:
        half, covariance = _covariance(form, x)
        along = np.einsum("ijp,jkp->ikp", covariance, axes)
        square = np.maximum(np.einsum("ikp,ikp->kp", along, axes), 1e-30)
        return x, axes, half, covariance, square, np.log(square[:held]).sum(axis=0)

    here, damping = evaluate(x, axes), np.full(x.shape[1], 1e-3)
    for _ in range(steps):
        x, axes, *_, value = here
        step = _levenberg(form, here, held, damping)
        turn = -0.5 * step[:3, None]
        turn /= np.maximum(np.linalg.norm(turn, axis=0) / 0.25, 1)
        across = np.cross(turn, axes, axis=0)
        turned = axes + 2 * (across + np.cross(turn, across, axis=0)) / (1 + np.sum(turn**2, axis=0))
        there = evaluate(np.clip(x - step[3:], -reach, reach), turned)
        lower = there[-1] < value
        here = tuple(np.where(lower, b, a) for a, b in zip(here, there, strict=True))
        damping = np.clip(np.where(lower, damping / 10, damping * 30), 1e-8, 1e3)
    return here[0], here[1], here[4]


def _levenberg(form: np.ndarray, here: tuple[np.ndarray, ...], held: int, damping: np.ndarray) -> np.ndarray:
    """Levenberg's step (6, P) of the rotation of the axes and of x, for the tangent of the logarithms."""
    _, axes, half, covariance, square, _ = here
    number = axes.shape[-1]
    hessian, slope = np.zeros((6, 6, number)), np.zeros((6, number))
    for i in range(held):
        v = axes[:, i]
        turned = _HAT @ v  # (3, 3, P), column c is e_c x v
        part = np.einsum("iajp,ip->ajp", half[:, 1:], v)
        block = np.empty_like(hessian)
        block[:3, :3] = np.einsum("icp,idp->cdp", turned, np.einsum("ijp,jcp->icp", covariance, turned))
        block[3:, :3] = np.einsum("ajp,jcp->acp", part, turned)
        block[:3, 3:] = np.swapaxes(block[3:, :3], 0, 1)
        block[3:, 3:] = np.einsum("ajbp,jp->abp", np.einsum("iajbp,ip->ajbp", form[:, 1:, :, 1:], v), v)
        hessian += block / square[i]
        slope[:3] += np.cross(v, np.einsum("ijp,jp->ip", covariance, v), axis=0) / square[i]
        slope[3:] += np.einsum("ajp,jp->ap", part, v) / square[i]
    diagonal = np.einsum("iip->ip", hessian)  # a view
    diagonal += damping * diagonal + 1e-10 * diagonal.max(axis=0) + 1e-30
    return _solve(hessian, slope)

"""Fit held coordinates to spans: the directions and origins along which a span of a recording moves least.

A row is a vector of weights. Its product with the features of a pose is one coordinate of the motion.
"""

from typing import NamedTuple

import numpy as np

from reframe_jax.geometry.numpy_rotations import rotation_matrices
from reframe_jax.segmentation.cells import GROUND_TYPES, Cells
from reframe_jax.segmentation.constants import SEGMENTS as C

__all__ = ["Fits", "fit_spans"]

_LEVI = np.stack([-np.cross(e, np.eye(3)) for e in np.eye(3)])  # e_c x v = _LEVI[c] @ v
_RANDOM = np.random.default_rng(0).uniform(-0.4, 0.4, (2, 3))  # m, initial origins of the search
_BATCH = 1000  # spans per batch of the fit

_Minimum = tuple[np.ndarray, np.ndarray, np.ndarray]


class Fits(NamedTuple):
    """The coordinates with the least motion in P spans, for the four linear and two angular types.

    Attributes:
        weights: (P, 3, 4, 3, 12) rows w for 1, 2 and 3 held translations, of every linear type.
        size: (P, 3, 4, 3) m, RMS of w'z about its mean; inf for translations that are not held.
        axes: (P, 2, 3, 3) rotation axes as rows, of every angular type, in order of increasing amplitude.
        turn: (P, 2, 3) rad, RMS rotation about these axes.
        linear_mean: (P, 4, 12) mean of the linear features.
        angular_mean: (P, 2, 3) mean of the angular features.
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
    """Fit held coordinates to spans (P, 2) of cells [start, stop)."""
    parts = [_fit_batch(cells, spans[i : i + _BATCH], reach) for i in range(0, len(spans), _BATCH)]
    return Fits(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def _fit_batch(cells: Cells, spans: np.ndarray, reach: float) -> Fits:
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
    weights, size = _least_motion_rows(linear.reshape(-1, 12, 12), middle.reshape(-1, 3), reach)
    largest = np.sqrt(np.maximum(turn[:, :, 2] ** 2 - floor_turn**2, 0)).min(axis=1)
    return Fits(
        weights=np.swapaxes(weights.reshape(3, number, 4, 3, 12), 0, 1),
        size=np.swapaxes(size.reshape(3, number, 4, 3), 0, 1),
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
        # chunks limit the memory
        for part in np.array_split(own, -(-len(own) * length // 50_000)):
            z = features[:, spans[part, :1] + np.arange(length)]
            middle = z.mean(axis=2)
            z = z - middle[:, :, None]
            mean[part] = np.swapaxes(middle, 0, 1)
            covariance[part] = np.swapaxes(np.swapaxes(z, 2, 3) @ z, 0, 1) / length
    return mean, covariance


def _least_motion_rows(
    moments: np.ndarray, middle: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (3, P, 3, 12) for 1, 2 and 3 held translations, and their RMS (3, P, 3)."""
    form = moments.reshape(-1, 3, 4, 3, 4)
    total = np.einsum("piaib->pab", form)
    ridge = 1e-9 + 1e-4 * np.einsum("pii->p", total[:, 1:, 1:])[:, None, None] / 3
    away = total[:, 1:, :1] + total[:, 1:, 1:] @ middle[..., None]
    least = middle - np.linalg.solve(total[:, 1:, 1:] + ridge * np.eye(3), away)[..., 0]
    least = np.clip(least, middle - reach, middle + reach)

    def with_axes(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        z = np.concatenate([np.ones((len(x), 1)), x], axis=1)
        return x, np.linalg.eigh(np.einsum("pa,piajb,pb->pij", z, form, z, optimize=True))[1]

    def lowest(starts: list[tuple[np.ndarray, np.ndarray]], held: int, steps: int) -> _Minimum:
        found = [_minimize_rows(moments, *start, held, steps, middle, reach) for start in starts]
        best = np.argmin([np.log(each[2][:, :held]).sum(axis=1) for each in found], axis=0)
        row = np.arange(len(best))
        x, axes, square = (np.stack([each[k] for each in found])[best, row] for k in range(3))
        return x, axes, square

    random = [with_axes(middle + shift) for shift in _RANDOM]
    three = lowest([with_axes(least), random[0]], 3, 6)
    two = lowest([three[:2], random[1]], 2, 8)
    one = lowest([two[:2], three[:2]], 1, 8)
    weights, size = [], []
    for held, (x, axes, square) in enumerate((one, two, three), 1):
        z = np.concatenate([np.ones((len(x), 1)), x], axis=1)
        weights.append((np.swapaxes(axes, 1, 2)[..., None] * z[:, None, None]).reshape(-1, 3, 12))
        size.append(np.where(np.arange(3) < held, np.sqrt(square), np.inf))
    return np.stack(weights), np.stack(size)


def _squares(moments: np.ndarray, x: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Mean squares w'Gw of the three rows, (P, 3)."""
    z = np.concatenate([np.ones((len(x), 1)), x], axis=1)
    rows = (np.swapaxes(axes, 1, 2)[..., None] * z[:, None, None]).reshape(-1, 3, 12)
    return np.maximum(np.sum((rows @ moments) * rows, axis=-1), 1e-30)


def _minimize_rows(
    moments: np.ndarray,
    x: np.ndarray,
    axes: np.ndarray,
    held: int,
    steps: int,
    middle: np.ndarray,
    reach: float,
) -> _Minimum:
    """Minimize sum_{i < held} log w_i' G w_i with w_i = v_i (1, x), by Levenberg's method.

    Args:
        moments: (P, 12, 12), second moments G of the features.
        x: (P, 3) m, initial origins.
        axes: (P, 3, 3), initial directions v as columns.
        held: number of held translations.
        steps: number of steps.
        middle: (P, 3) m, centre of the cube that bounds x.
        reach: m, half the width of the cube.

    Returns:
        x, axes, and the mean squares w' G w of all rows, (P, 3).
    """
    number = len(x)
    damping = np.full(number, 1e-3)
    square = _squares(moments, x, axes)
    value = np.log(square[:, :held]).sum(axis=1)
    shift = np.concatenate([np.zeros((3, 1)), np.eye(3)], axis=1)
    for _ in range(steps):
        z = np.concatenate([np.ones((number, 1)), x], axis=1)
        hessian, slope = np.zeros((number, 6, 6)), np.zeros((number, 6))
        for i in range(held):
            v = axes[:, :, i]
            turned = v @ np.swapaxes(_LEVI, 1, 2)  # (3, P, 3)
            parts = np.empty((number, 7, 3, 4))
            parts[:, :3] = np.swapaxes(turned, 0, 1)[..., None] * z[:, None, None]
            parts[:, 3:6] = v[:, None, :, None] * shift[None, :, None]
            parts[:, 6] = v[:, :, None] * z[:, None]
            row = parts.reshape(number, 7, 12)
            form = row @ moments @ np.swapaxes(row, 1, 2)
            form /= form[:, 6:, 6:]
            hessian += form[:, :6, :6]
            slope += form[:, :6, 6]
        scale = np.einsum("pii->pi", hessian)
        ridge = damping[:, None] * scale + 1e-10 * scale.max(axis=1, keepdims=True) + 1e-30
        step = -np.linalg.solve(hessian + ridge[:, None] * np.eye(6), slope[..., None])[..., 0]
        better = np.zeros(number, bool)
        from_x, from_axes = x, axes
        for length in (1.0, 1.9):
            there = np.clip(from_x + length * step[:, 3:], middle - reach, middle + reach)
            turn = length * step[:, :3]
            turn /= np.maximum(np.linalg.norm(turn, axis=1, keepdims=True) / 0.5, 1)
            turned_axes = rotation_matrices(turn) @ from_axes
            squares = _squares(moments, there, turned_axes)
            lower = np.log(squares[:, :held]).sum(axis=1)
            good = lower < value
            better |= good
            x = np.where(good[:, None], there, x)
            axes = np.where(good[:, None, None], turned_axes, axes)
            square = np.where(good[:, None], squares, square)
            value = np.where(good, lower, value)
        damping = np.clip(np.where(better, damping / 10, damping * 30), 1e-8, 1e3)
    return x, axes, square

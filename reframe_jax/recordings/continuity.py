"""Continuity of poses: a motion is smooth in its own order, and not in a random order.

Consecutive touches of a point, and shuffled rows, have the same distances as poses in a random order. The
measures are the length and the curvature of the path, of the positions and of the orientations. They are
means of square roots, in which outliers and long rests have little effect. NumPy only.
"""

from functools import lru_cache

import numpy as np

_FEWEST = 5  # poses; fewer look unordered by chance
_ORDERS = 39  # random orders; separate touches are smoother than all of them in 1 of 40 cases
_SMOOTH = 0.6  # mean measure of steps, over that of distant poses, at which a path needs no comparison
_SMOOTHER = 0.7  # largest measure of a motion over the mean measure of random orders
_SAME = 1e-6  # relative difference of the measures of an order and of its reverse, by rounding
_MOVED = 0.02, 0.1  # m and rad, median distances above the noise of a body at rest
_FARTHEST = 1e9  # m; poses beyond are ignored
_WINDOWS, _LENGTH = 10, 20  # number and poses of the parts of a long recording that are compared


def is_unordered(poses: np.ndarray) -> bool:
    """Return whether the order of poses (K+1, 4, 4), m, is as good as random, in position and in orientation.

    Poses that are not finite, or more than 1e9 m away, are ignored.
    """
    poses = poses[np.all(np.abs(poses) < _FARTHEST, axis=(1, 2))]
    if len(poses) < _FEWEST:
        return False
    whole = len(poses) <= _WINDOWS * _LENGTH
    if not whole:
        starts = np.linspace(0, len(poses) - _LENGTH, _WINDOWS).astype(int)
        poses = poses[(starts[:, None] + np.arange(_LENGTH)).ravel()]
    count = len(poses)
    # the distance between two rotation matrices is about sqrt(2) times the angle
    both = poses[:, :3, 3], poses[:, :3, :3].reshape(count, 9) / np.sqrt(2)
    part = count if whole else _LENGTH
    for numbers in both if count >= _LENGTH else ():
        steps = np.diff(numbers.reshape(-1, part, numbers.shape[1]), axis=1)
        across = np.concatenate([numbers[lag:] - numbers[:-lag] for lag in (count // 3, count // 2)])
        steps, across = (np.sqrt(np.sqrt(np.square(rows).sum(axis=-1))) for rows in (steps, across))
        if steps.mean() < _SMOOTH * across.mean():
            return False
    before, here, after = _orders(count, part)
    found = []
    for numbers in both:
        squares = np.zeros(count**2)
        for columns in np.ascontiguousarray(numbers.T).reshape(-1, 3, count):
            apart = columns[:, :, None] - columns[:, None]
            squares += np.square(apart, out=apart).sum(axis=0).ravel()
        found.append(squares)
    pairs = before * count + here, here * count + after, before * count + after
    steps, onward, across = (np.stack(found).take(each, axis=1) for each in pairs)
    bends = np.maximum(2 * (steps + onward) - across, 0)
    roots = np.concatenate([np.sqrt(np.sqrt(changes)).mean(axis=2) for changes in (steps, bends)])
    usual = roots[:, 1:].mean(axis=1, keepdims=True)
    measures = np.divide(roots, usual, out=np.ones_like(roots), where=usual > 0).min(axis=0)
    if measures[0] <= min(_SMOOTHER, (1 + _SAME) * measures[1:].min()):
        return False
    return bool((np.median(steps[:, 1:], axis=(1, 2)) > np.square(_MOVED)).any())


@lru_cache(4)
def _orders(count: int, part: int) -> np.ndarray:
    """Three consecutive rows of every part, (3, 40, M), in their own order and in 39 random orders."""
    orders = np.tile(np.arange(count), (1 + _ORDERS, 1))
    orders[1:] = np.random.default_rng(0).permuted(orders[1:], axis=1)
    parts = np.arange(count).reshape(-1, part)
    triples = np.lib.stride_tricks.sliding_window_view(parts, 3, axis=1).reshape(-1, 3)
    return np.moveaxis(orders[:, triples], 2, 0)

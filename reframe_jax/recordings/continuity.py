"""Continuity of poses: a motion is smooth in its own order, and not in a random order.

Consecutive touches of a point, and shuffled rows, have the same distances as poses in a random order. The
measures are the length and the curvature of the path, of the positions and of the orientations. They are
means of square roots, in which outliers and long rests have little effect. NumPy only.
"""

import numpy as np

__all__ = ["is_unordered"]

_FEWEST = 5  # poses; fewer look unordered by chance
_ORDERS = 39  # random orders; separate touches are smoother than all of them in 1 of 40 cases
_SMOOTHER = 0.7  # largest measure of a motion over the mean measure of random orders
_SAME = 1e-6  # relative difference of the measures of an order and of its reverse, by rounding
_MOVED = 0.02, 0.1  # m and rad, median distances above the noise of a body at rest
_FARTHEST = 1e9  # m; poses beyond are ignored
_WINDOWS, _LENGTH = 10, 20  # number and poses of the parts of a long recording that are compared


def is_unordered(poses: np.ndarray) -> bool:
    """Return whether the order of poses is as good as random, in position and in orientation.

    Args:
        poses: (K+1, 4, 4), m; poses that are not finite, or more than 1e9 m away, are ignored.
    """
    poses = poses[np.all(np.abs(poses) < _FARTHEST, axis=(1, 2))]
    if len(poses) < _FEWEST:
        return False
    parts = np.arange(len(poses))[None]
    if len(poses) > _WINDOWS * _LENGTH:
        starts = np.linspace(0, len(poses) - _LENGTH, _WINDOWS).astype(int)
        parts = starts[:, None] + np.arange(_LENGTH)
    poses = poses[parts.ravel()]
    count = len(poses)
    triples = np.lib.stride_tricks.sliding_window_view(np.arange(count).reshape(parts.shape), 3, axis=1)
    orders = np.tile(np.arange(count), (1 + _ORDERS, 1))
    orders[1:] = np.random.default_rng(0).permuted(orders[1:], axis=1)
    before, here, after = np.moveaxis(orders[:, triples.reshape(-1, 3)], 2, 0)
    moved, measures = False, []
    # the distance between two rotation matrices is about sqrt(2) times the angle
    columns = poses[:, :3, 3], poses[:, :3, :3].reshape(count, 9) / np.sqrt(2)
    for numbers, least in zip(columns, _MOVED, strict=True):
        squares = sum(np.square(column[:, None] - column) for column in numbers.T)
        steps, bends = squares[before, here], 2 * squares[here, after] - squares[before, after]
        moved |= bool(np.median(steps[1:]) > least**2)
        for changes in (steps, np.maximum(2 * steps + bends, 0)):  # of the step, and of its change
            roots = np.sqrt(np.sqrt(changes)).mean(axis=1)
            usual = roots[1:].mean()
            measures.append(roots / usual if usual > 0 else np.ones(len(roots)))
    own, *others = np.min(measures, axis=0)
    return moved and bool(own > min(_SMOOTHER, (1 + _SAME) * min(others)))

"""Continuity of poses: in a motion, consecutive poses are closer than random pairs of poses.

Consecutive touches of a point, and rows in a random order, are as distant as random pairs. The measures are
von Neumann's ratio of mean square differences, and ratios of medians, in which outliers and long rests have
little effect. NumPy only.
"""

import numpy as np

__all__ = ["is_unordered"]

_FEWEST = 5  # poses; fewer look unordered by chance
_CLOSER = 0.75  # fraction of steps below the median distance: about 1 in a motion, 1/2 without order
_STEP = 0.5  # median step over the median distance: 1 without order
_SQUARES = 0.6  # mean square of the steps over the mean square of the distances: 1 without order
_MOVED = 0.02, 0.1  # m and rad, median distances above the noise of a body at rest
_FARTHEST = 1e9  # m; poses beyond are ignored
_PAIRS = 2000  # largest number of distances


def is_unordered(poses: np.ndarray) -> bool:
    """Return whether consecutive poses are as distant as random pairs, in position and in orientation.

    Args:
        poses: (K+1, 4, 4), m; poses that are not finite, or more than 1e9 m away, are ignored.
    """
    poses = poses[np.all(np.abs(poses) < _FARTHEST, axis=(1, 2))]
    count = len(poses)
    if count < _FEWEST:
        return False
    draw = np.random.default_rng(0)
    if count * (count - 1) // 2 <= _PAIRS:
        one, other = np.triu_indices(count, 1)
    else:
        one = draw.integers(count, size=_PAIRS)
        other = (one + draw.integers(1, count, size=_PAIRS)) % count
    before = np.arange(count - 1) if count <= _PAIRS else draw.integers(count - 1, size=_PAIRS)
    moved = []
    # the distance between two rotation matrices is about sqrt(2) times the angle
    for numbers in (poses[:, :3, 3], poses[:, :3, :3].reshape(count, 9) / np.sqrt(2)):
        steps = np.linalg.norm(numbers[before + 1] - numbers[before], axis=1)
        distances = np.linalg.norm(numbers[one] - numbers[other], axis=1)
        usual = float(np.median(distances))
        moved.append(usual)
        if usual > 0 and (
            np.mean(steps < usual) >= _CLOSER
            or np.median(steps) <= _STEP * usual
            or np.mean(steps**2) <= _SQUARES * np.mean(distances**2)
        ):
            return False
    return any(size > least for size, least in zip(moved, _MOVED, strict=True))

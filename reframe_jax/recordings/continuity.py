"""Whether poses follow each other as those of a motion do: NumPy only.

In a motion, neighbours are closer to each other than poses at random. Separate touches, and rows in a random
order, are as far apart as any two of them (von Neumann's ratio of mean square differences; here with medians
too, so that neither outliers nor a body that rests for long decide).
"""

import numpy as np

__all__ = ["is_unordered"]

_FEWEST = 10  # poses; fewer may look like this by chance
_CLOSER = 0.75  # part of the steps below the median distance: about 1 in a motion, 1/2 without order
_STEP = 0.5  # median step over the median distance: 1 without order
_SQUARES = 0.6  # mean square of the steps over that of the distances: 1 without order
_MOVED = 0.02, 0.1  # m and rad, median distance of poses that is more than the noise of a body at rest
_FARTHEST = 1e9  # m, of poses that are compared
_PAIRS = 2000  # distances that count


def is_unordered(poses: np.ndarray) -> bool:
    """Whether neither positions nor orientations are closer to those of the row before than to any other.

    Args:
        poses: (K+1, 4, 4), m; those that are not finite, or farther away than 1e9 m, play no part.
    """
    poses = poses[np.all(np.abs(poses) < _FARTHEST, axis=(1, 2))]
    count = len(poses)
    if count < _FEWEST:
        return False
    draw = np.random.default_rng(0)
    if count * (count - 1) // 2 <= _PAIRS:
        one, other = np.triu_indices(count, 1)
        before = np.arange(count - 1)
    else:
        one = draw.integers(count, size=_PAIRS)
        other = (one + draw.integers(1, count, size=_PAIRS)) % count
        before = np.arange(count - 1) if count <= _PAIRS else draw.integers(count - 1, size=_PAIRS)
    moved = []
    # the distance of two rotation matrices is about sqrt(2) times their angle
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

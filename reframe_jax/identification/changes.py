"""When the constraint of a stream changes: the frame that held no longer predicts the motion."""

from dataclasses import dataclass

import numpy as np

from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.geometry.numpy_rotations import rotation_matrices, rotation_vectors
from reframe_jax.identification.results import Identification
from reframe_jax.motion.checks import Status
from reframe_jax.motion.independence import independent_after

__all__ = ["Change", "ChangeWatch"]

_LARGER = 100.0  # times the variance along a constrained axis that a change is taken to bring
_SURE = 1e-4  # probability with which noise alone would reach the evidence for a change
_SHARE = 0.5  # of that evidence that one chord can give: no single pose decides
_CERTAIN = 0.99  # probability that an axis is constrained, or that a class is right, for it to count
_MOTIONS = 8  # independent motions that a frame must have explained for its failure to count as a change
_LASTING = 4  # part of a window for which they must last

_TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True)
class Change:
    """A change of the constraint in a stream.

    Attributes:
        index: of the first pose that no longer obeys the constraint, counted from 0 since the stream began.
        time: s, of that pose.
        delay: s after which the change was noticed.
    """

    index: int
    time: float
    delay: float


class ChangeWatch:
    """Compare each new pose with the frame of an earlier window.

    Along every constrained axis, the squared displacement over a chord is compared with its mean in the
    window that the frame comes from. The evidence that it has grown is summed up from the time at which it
    last was nil (Page's cumulative sums). A frame from too little motion fails although the constraint is
    the same; so a frame must first explain several independent motions, and one that fails earlier is taken
    anew. A constraint that only takes over from freer motion violates nothing: the identification itself then
    shows fewer degrees of freedom.

    Args:
        length: poses in a window.
    """

    def __init__(self, length: int) -> None:
        self._length = length
        self._limit = -float(np.log(_SURE))
        self.reset(0)

    def reset(self, since: int) -> None:
        """Forget the constraint: the next begins at a pose of this index."""
        self._since, self._fewer = since, 0
        self._reference: _Reference | None = None
        self._evidence = np.zeros(0)
        self._began = np.zeros(0, int)

    def push(self, poses: np.ndarray, last: int, found: Identification) -> int | None:
        """Take the current window, and say whether the constraint has changed.

        Args:
            poses: (K+1, 4, 4), m.
            last: index of the last pose in the stream.
            found: identification of the window.

        Returns:
            Index of the first pose of the new constraint; None if nothing changed.
        """
        if int(found.status_code) != Status.OK or last - self._since < self._length - 1:
            return None
        reference = self._reference
        if reference is None:
            self._refer(poses, last, found)
            return None
        changed = None
        if (last - reference.made) % reference.lag == 0:
            changed = self._compare(poses[-1 - reference.lag :: reference.lag], last)
        if last < reference.trusted:
            if changed is not None:  # the window held too little motion to determine its constraint
                self._refer(poses, last, found)
            return None
        changed = self._count_fewer(found, last) if changed is None else changed
        if changed is not None:
            self.reset(changed)
        return changed

    def _refer(self, poses: np.ndarray, last: int, found: Identification) -> None:
        self._reference = _Reference(poses, last, found)
        self._evidence = np.zeros(6)
        self._began = np.full(6, last)
        self._fewer = 0

    def _compare(self, ends: np.ndarray, last: int) -> int | None:
        """Add the evidence of the last chord; the index of the change if that is enough."""
        assert self._reference is not None
        reference = self._reference
        ratio = reference.displacements(ends[:1], ends[1:])[0] ** 2 / reference.variance
        gain = (ratio * (1 - 1 / _LARGER) - np.log(_LARGER)) / 2
        gain = np.minimum(gain, _SHARE * self._limit) * reference.constrained
        self._evidence = np.maximum(self._evidence + gain, 0)
        self._began = np.where(self._evidence > 0, self._began, last)
        worst = int(np.argmax(self._evidence))
        return int(self._began[worst]) + 1 if self._evidence[worst] > self._limit else None

    def _count_fewer(self, found: Identification, last: int) -> int | None:
        """Index of the change if axes that were free have been constrained for long enough."""
        assert self._reference is not None
        fewer = _freedom(found) < self._reference.freedom and float(found.probability) > _CERTAIN
        self._fewer = self._fewer + 1 if fewer else 0
        return last - self._length + 1 if self._fewer > self._length // _LASTING else None


class _Reference:
    """The frame of a window, and how far the body goes along its axes in a chord.

    Args:
        poses: (K+1, 4, 4) of the window, m.
        made: index of the window's last pose in the stream.
        found: identification of the window.
    """

    def __init__(self, poses: np.ndarray, made: int, found: Identification) -> None:
        linear = LinearType(int(found.linear.type_code))
        self._turning = rotation_matrices(np.asarray(found.angular.rotvec, float))
        self._turns_on_body = int(found.angular.type_code) == AngularType.B
        self._sliding = rotation_matrices(np.asarray(found.linear.rotvec, float))
        self._slides_on_body = linear.orientation_body == AngularType.B
        self._position = np.asarray(found.linear.position, float)
        self._on_body = linear.position_body == AngularType.B
        self.made = made
        self.freedom = _freedom(found)
        self.lag = min(int(found.lag), len(poses) // 4)
        free = np.concatenate([found.angular.free_probability, found.linear.free_probability])
        self.constrained = (free < 1 - _CERTAIN).astype(float)
        shifts = self.displacements(poses[: -self.lag], poses[self.lag :])
        squares = shifts**2
        size = np.sqrt(np.repeat(np.mean(squares.reshape(len(squares), 2, 3), axis=(0, 2)), 3)) + _TINY
        needed = round(_MOTIONS * independent_after(shifts / size)) - len(poses)
        self.trusted = made + max(needed, len(poses) // 2)
        noise = np.repeat([float(found.noise.rotation), float(found.noise.position)], 3)
        self.variance = np.maximum(np.mean(squares, axis=0), 2 * noise**2) + _TINY

    def displacements(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Displacements along the axes between poses, (M, 6): rad for the angular ones, then m."""
        here, there = first[:, :3, :3], second[:, :3, :3]
        turn = rotation_vectors(np.swapaxes(here, 1, 2) @ there)
        if not self._turns_on_body:
            turn = np.einsum("kij,kj->ki", here, turn)
        if self._on_body:
            shift = second[:, :3, 3] - first[:, :3, 3] + (there - here) @ self._position
        else:
            # the body moves past a point of the ground: turned into the ground's axes half way
            path = [
                np.einsum("kji,kj->ki", p[:, :3, :3], self._position - p[:, :3, 3]) for p in (first, second)
            ]
            shift = np.einsum("kij,kj->ki", here + there, path[0] - path[1]) / 2
        if self._slides_on_body:
            shift = np.einsum("kji,kj->ki", here + there, shift) / 2
        return np.concatenate([turn @ self._turning, shift @ self._sliding], axis=1)


def _freedom(found: Identification) -> int:
    return int(np.asarray(found.angular.dof).sum() + np.asarray(found.linear.dof).sum())

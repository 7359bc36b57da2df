"""Identification while the robot moves: push a pose, get the current frame."""

from operator import index
from typing import Any

import jax
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.identification.classify import Thresholds
from reframe_jax.identification.entry import identify_unchecked
from reframe_jax.identification.inputs import read_number, read_numbers
from reframe_jax.identification.options import Scales, check_bounds, check_options, take_assumed, take_scales
from reframe_jax.identification.results import Identification
from reframe_jax.motion.checks import MIN_VELOCITIES, ROTATION_TOLERANCE, Status, check_step
from reframe_jax.motion.kinematics import Discretization
from reframe_jax.objectives.norms import check_exponent
from reframe_jax.solvers import Solver

__all__ = ["OnlineIdentifier"]

_PATIENCE = 3  # times in a row that come too early, after which the window begins anew


class OnlineIdentifier:
    """The constraint frame of the last poses of a stream.

    Every push identifies the whole window anew (``python -m benchmarks.identification`` prints the time).
    Updating moments instead would drift: the moments along constrained axes are 1e-6 to 1e-10 of the largest
    ones, and every update leaves a rounding of these behind.

    Args:
        length: poses in the window, K + 1; at least 5.
        dt: sample time in s, for streams without times.
        scales: this and the next ones are options of :func:`reframe_jax.identify`.
        assume: name of a constraint.
        norm: exponent of the power mean.
        discretization: how velocity is taken from two poses.
        thresholds: RMS velocities above which an axis is free.
        bounds: half the width of the cube in which origins are searched, m.
        solver: another search for the origin.
        key: of the solver's random numbers.

    Raises:
        ValueError: if the window is too short, the sample time not positive, or another option invalid.
    """

    def __init__(
        self,
        length: int,
        *,
        dt: float | None = None,
        scales: Scales = "auto",
        assume: str | None = None,
        norm: float = 0.0,
        discretization: Discretization = "chord",
        thresholds: Thresholds | None = None,
        bounds: ArrayLike | None = None,
        solver: Solver | None = None,
        key: jax.Array | None = None,
    ) -> None:
        try:
            length = index(length)
        except TypeError as error:
            raise ValueError(f"length must be a whole number of poses, not {length!r}.") from error
        if length < MIN_VELOCITIES + 1:
            raise ValueError(f"A window needs at least {MIN_VELOCITIES + 1} poses, not {length}.")
        if dt is not None and not 0 < (dt := read_number("dt", dt)) < np.inf:
            raise ValueError(f"dt must be a positive number of seconds, not {dt}.")
        if dt is not None:
            check_step(dt)
        check_options(thresholds, solver, discretization, key)
        check_bounds(bounds)
        take_scales(scales, length)
        take_assumed(assume)
        self._dt = dt
        self._options: dict[str, Any] = {
            "scales": scales,
            "assume": assume,
            "norm": check_exponent(norm),
            "discretization": discretization,
            "thresholds": thresholds,
            "bounds": bounds,
            "solver": solver,
            "key": key,
        }
        # poses are written twice, so that the window is always one slice
        self._poses = np.zeros((2 * length, 4, 4))
        self._times = np.zeros(2 * length)
        self._length, self._count = length, 0
        self._early: list[float] = []  # times refused one after the other

    def push(self, pose: ArrayLike, time: float | None = None) -> Identification | None:
        """Add a pose.

        Args:
            pose: (4, 4), of {b} in {g}; m.
            time: s; needed unless ``dt`` was given.

        Returns:
            The identification of the last ``length`` poses; None until there are as many.

        Raises:
            ValueError: if the pose or time is missing, of a wrong shape, or unusable: it is not added.
                Also if the window as a whole has no motion; the pose is then kept. Of three times in a row
                that increase among themselves and come too early, the third begins a new window: the time
                before them was wrong, or the clock was set back.
        """
        pose = np.asarray(read_numbers("pose", pose), dtype=float)
        if pose.shape != (4, 4) or not np.all(np.isfinite(pose)):
            raise ValueError(f"A pose must be a finite (4, 4) matrix, not {pose.shape}: {pose.tolist()}.")
        if (time is None) == (self._dt is None):
            raise ValueError("Give a time with every pose, or the sample time dt once, in seconds.")
        _check_rigid(pose)
        time = None if time is None else read_number("time", time)
        if time is not None and not np.isfinite(time):
            raise ValueError(f"A time must be a finite number of seconds, not {time}.")
        last = self._times[(self._count - 1) % self._length]
        if time is not None and self._count and not time > last:
            self._refuse(time, last)
        slot = self._count % self._length
        for row in (slot, slot + self._length):
            self._poses[row], self._times[row] = pose, 0.0 if time is None else time
        self._count += 1
        self._early = []
        if self._count < self._length:
            return None
        window = slice(slot + 1, slot + 1 + self._length)
        times = None if time is None else self._times[window]
        return identify_unchecked(self._poses[window], times=times, dt=self._dt, **self._options)

    def reset(self) -> None:
        """Empty the window: the next pose is the first."""
        self._count, self._early = 0, []

    def _refuse(self, time: float, last: float) -> None:
        """Refuse a time that is too early, unless many times were: then the last accepted time was wrong.

        Otherwise a single time stamp far in the future would block the stream for ever.
        """
        self._early = [*self._early, time] if not self._early or time > self._early[-1] else [time]
        if len(self._early) < _PATIENCE:
            raise ValueError(f"Times must increase: {time} s came after {last} s.")
        self.reset()

    def __len__(self) -> int:
        """Poses in the window so far."""
        return min(self._count, self._length)


def _check_rigid(pose: np.ndarray) -> None:
    """Refuse a pose that would make every window that contains it unusable."""
    rotation = pose[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        skewed = not np.abs(rotation.T @ rotation - np.eye(3)).max() < ROTATION_TOLERANCE
    if skewed or np.linalg.det(rotation) < 0 or np.abs(pose[3] - [0, 0, 0, 1]).max() >= 1e-6:
        raise ValueError(Status.NOT_A_POSE.message)

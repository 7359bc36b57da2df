"""Identify the constraint of a stream of poses while the robot moves."""

from operator import index
from typing import Unpack

import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.identification.entry import identify_unchecked
from reframe_jax.identification.inputs import read_number, read_numbers
from reframe_jax.identification.options import IdentifyOptions, Options, check_options
from reframe_jax.identification.results import Identification
from reframe_jax.motion.checks import MIN_VELOCITIES, Status, check_step, is_rigid
from reframe_jax.objectives.norms import check_exponent

_PATIENCE = 3  # number of consecutive times before the last accepted time, after which a new window begins


class OnlineIdentifier:
    """Identify the last poses of a stream after every new pose.

    Every :meth:`push` identifies the whole window again (``python -m benchmarks.identification`` prints the
    time). An update of the moments would accumulate rounding errors: the moments along constrained axes are
    1e-6 to 1e-10 of the largest moments.

    Args:
        length: number of poses in the window, K + 1; at least 5.
        dt: time between two poses, s, for streams without times.
        options: options of :func:`reframe_jax.identify`.

    Raises:
        ValueError: if the window is too short, if ``dt`` is not positive, or for another invalid option.
    """

    def __init__(self, length: int, *, dt: float | None = None, **options: Unpack[IdentifyOptions]) -> None:
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
        if unknown := sorted(options.keys() - Options._fields):
            known = ", ".join(Options._fields)
            raise TypeError(f"OnlineIdentifier has no option {', '.join(unknown)}; choose from {known}.")
        given = Options(**options)
        check_options(given, length)
        self._dt = dt
        self._options = given._replace(norm=check_exponent(given.norm))
        # poses are written twice, so that the window is always one slice
        self._poses = np.zeros((2 * length, 4, 4))
        self._times = np.zeros(2 * length)
        self._length, self._count = length, 0
        self._early: list[float] = []  # consecutive times that were refused

    def push(self, pose: "ArrayLike", time: float | None = None) -> Identification | None:
        """Add a pose to the window, and identify the window if it is full.

        A time must be later than the time before it. However, the third of three consecutive, increasing
        times that are too early begins a new window: the last accepted time was wrong, or the clock was set
        back.

        Args:
            pose: (4, 4) pose of {b} in {g}, m.
            time: sample time, s; required unless ``dt`` was given.

        Returns:
            The identification of the last ``length`` poses; None while the window has fewer poses.

        Raises:
            ValueError: for a missing, invalid or too early pose or time, which is not added. Also if the full
                window has no motion; its last pose remains in the window.
        """
        pose = np.asarray(read_numbers("pose", pose), dtype=float)
        if pose.shape != (4, 4) or not np.all(np.isfinite(pose)):
            raise ValueError(f"A pose must be a finite (4, 4) matrix, not {pose.shape}: {pose.tolist()}.")
        if (time is None) == (self._dt is None):
            raise ValueError("Give a time with every pose, or the sample time dt once, in seconds.")
        if not is_rigid(pose):
            raise ValueError(Status.NOT_A_POSE.message)
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
        return identify_unchecked(self._poses[window], times, self._dt, self._options)

    def reset(self) -> None:
        """Remove all poses from the window."""
        self._count, self._early = 0, []

    def _refuse(self, time: float, last: float) -> None:
        """Refuse a time that is too early; empty the window at the third such time.

        Otherwise, a single wrong time stamp far in the future would block the stream forever.
        """
        self._early = [*self._early, time] if not self._early or time > self._early[-1] else [time]
        if len(self._early) < _PATIENCE:
            raise ValueError(f"Times must increase: {time} s came after {last} s.")
        self.reset()

    def __len__(self) -> int:
        """Number of poses in the window."""
        return min(self._count, self._length)

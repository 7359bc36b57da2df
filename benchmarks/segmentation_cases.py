"""Simulated sequences of constraints with known changes, in plain NumPy.

A body moves under one constraint after the other. Each constraint lies in a random place, within 0.15 m of
the body. The free coordinates follow one of three motions (:data:`MOTIONS`), with 0.35 to 0.6 rad and 50 to
100 mm RMS:

- "sines": sums of three sines of 0.2 to 0.9 Hz;
- "splines": cubic splines through random values, 0.7 to 3 s apart;
- "jerks": minimum-jerk movements of 0.6 to 1.2 s between random values, with all coordinates at rest at each
  value.

In half of the sequences, every motion starts and ends at rest within 0.25 s; in the other half, the velocity
jumps. White noise of sigma m has sigma / 0.3 m rad of orientation noise; slow errors are sines of 0.1 to
1.2 Hz, with 5 rad/m.
"""

from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

__all__ = [
    "ERRORS",
    "MOTIONS",
    "NAMES",
    "SPOILED",
    "Sequence",
    "move_through",
    "simulate_sequences",
    "simulate_single",
    "spoil",
]

_FREE_ROTATION = {"free": "xyz", "pin": "xyz", "contour": "xyz", "ball": "xyz", "hinge": "z", "plane": "z"}
_FREE_TRANSLATION = {"free": "xyz", "pin": "xy", "contour": "x", "slide": "x", "plane": "xy"}

NAMES = {
    "free": ("Unconstrained",),
    "pin": ("Pin-plane contact",),
    "contour": ("3 rotations, 1 translation",),
    "ball": ("Spherical joint",),
    "hinge": ("Revolute joint",),
    "slide": ("Prismatic joint",),
    "plane": ("Plane-plane contact",),
    "lock": ("Still", "Fixed"),
}
"""Right names, or what a right name contains."""

MOTIONS = "sines", "splines", "jerks"
SPOILED = {
    "frame": "with the body frame 0.6 m away",
    "outliers": "in which 5 % of the poses are outliers of 50 mm",
    "repeats": "in which every second pose repeats the pose before it",
    "hidden": "in which a fifth of the poses are missing, in gaps of 0.25 s",
}
"""Ways to spoil a sequence, with a description."""

_MOVEMENT = 0.6, 1.2  # s, shortest and longest minimum-jerk movement

ERRORS = (
    {"white": 1e-5},
    {"white": 1e-4},
    {"white": 1e-3},
    {"white": 1e-6, "soft": 3e-4},
    {"white": 1e-6, "soft": 1e-3},
)
"""Sizes in m: white noise of 10 um to 1 mm, and soft contacts."""


class Sequence(NamedTuple):
    """A simulated recording: its constraints, the first pose of each constraint, and the poses."""

    labels: tuple[str, ...]
    starts: np.ndarray  # (S,) index of the first pose of each constraint
    poses: np.ndarray  # (N, 4, 4) m
    times: np.ndarray  # (N,) s
    errors: dict[str, float]

    @property
    def changes(self) -> np.ndarray:
        """Times of the changes, s."""
        return np.asarray(self.times[self.starts[1:]])


def simulate_sequences(
    count: int, seed: int = 0, motion: str = "sines", lasting: tuple[float, float] = (4, 8)
) -> list[Sequence]:
    """Simulate sequences of three or four constraints, with no constraint twice in a row.

    Args:
        count: number of sequences.
        seed: seed of all random numbers.
        motion: one of :data:`MOTIONS`.
        lasting: shortest and longest duration of a constraint, s.
    """
    made = []
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        labels: list[str] = []
        while len(labels) < 3 + number % 2:
            # a tool is often free between two constraints
            free = rng.random() < 0.5 and labels[-1:] not in ([], ["free"])
            label = "free" if free else str(rng.choice(list(NAMES)))
            if labels[-1:] != [label]:
                labels.append(label)
        durations = rng.uniform(*lasting, len(labels))
        apart = _MOVEMENT if motion == "jerks" else (0.7, 1.8) if number % 2 else (1.5, 3.0)
        made.append(
            move_through(labels, durations, ERRORS[number % len(ERRORS)], rng, motion=motion, apart=apart)
        )
    return made


def spoil(made: Sequence, how: str) -> Sequence:
    """Return a sequence with errors of a tracker, or in another body frame; see :data:`SPOILED`."""
    poses, rng = made.poses.copy(), np.random.default_rng(len(made.poses))
    if how == "hidden":
        seen, length = np.ones(len(poses), bool), round(0.25 / made.times[1])
        while seen.mean() > 0.8:
            start = rng.integers(0, len(poses) - length)
            seen[start : start + length] = False
        starts = np.array([seen[:start].sum() for start in made.starts])
        return made._replace(poses=poses[seen], times=made.times[seen] - made.times[seen][0], starts=starts)
    if how == "frame":
        poses[:, :3, 3] += poses[:, :3, :3] @ np.array([0.3, -0.3, 0.4])
    elif how == "outliers":
        wrong = rng.random(len(poses)) < 0.05
        poses[wrong, :3, 3] += rng.normal(0, 0.05, (wrong.sum(), 3))
    else:
        poses = np.repeat(poses[::2], 2, axis=0)[: len(poses)]
    return made._replace(poses=poses)


def simulate_single(label: str, number: int, seed: int = 0, motion: str = "sines") -> Sequence:
    """Simulate a recording of one constraint, 8 to 20 s long."""
    rng = np.random.default_rng([seed, 1000 + number, list(NAMES).index(label)])
    return move_through([label], rng.uniform(8, 20, 1), ERRORS[number % len(ERRORS)], rng, motion=motion)


def move_through(
    labels: list[str],
    durations: np.ndarray,
    errors: dict[str, float],
    rng: np.random.Generator,
    rate: int | None = None,
    motion: str = "sines",
    apart: tuple[float, float] = (0.7, 1.8),
) -> Sequence:
    """Simulate constraints one after the other.

    Args:
        labels: constraints, keys of :data:`NAMES`.
        durations: duration of each constraint, s.
        errors: sizes of the errors "white" and "soft", m.
        rng: generator of places, motions and errors.
        rate: sampling rate, Hz; by default 20, 50 or 100.
        motion: one of :data:`MOTIONS`.
        apart: shortest and longest time between the values of splines and minimum-jerk movements, s.
    """
    drawn, ease = int(rng.choice([20, 50, 100])), float(rng.choice([0.0, 0.25]))
    rate = rate or drawn
    rotation = [Rotation.random(random_state=rng).as_matrix()[None]]
    position = [rng.uniform(-0.5, 0.5, (1, 3))]
    starts = [0]
    for label, duration in zip(labels, durations, strict=True):
        steps = round(duration * rate)
        turned, moved = _move(
            label, steps, rate, ease, rotation[-1][-1], position[-1][-1], rng, motion, apart
        )
        rotation.append(turned)
        position.append(moved)
        starts.append(starts[-1] + steps)
    r, p = np.concatenate(rotation), np.concatenate(position)
    times = np.arange(len(p)) / rate
    white, soft = errors["white"], errors.get("soft", 0.0)
    turns = rng.normal(0, white / 0.3, (len(p), 3))
    on_body = np.einsum("kij,kj->ki", r, _slow(times, soft, rng))
    p = p + rng.normal(0, white, p.shape) + _slow(times, soft, rng) + on_body
    off = Rotation.from_rotvec(_slow(times, 5 * soft, rng))
    r = (off * Rotation.from_matrix(r) * Rotation.from_rotvec(turns)).as_matrix()
    poses = np.tile(np.eye(4), (len(p), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = r, p
    return Sequence(tuple(labels), np.array(starts[:-1]), poses, times, errors)


def _slow(times: np.ndarray, size: float, rng: np.random.Generator) -> np.ndarray:
    """(N, 3) sums of three sines whose components have this rms, over the square root of two."""
    rate, phase = 2 * np.pi * rng.uniform(0.1, 1.2, (3, 3)), rng.uniform(0, 2 * np.pi, (3, 3))
    return np.asarray(size / np.sqrt(3) * np.sin(times[:, None, None] * rate + phase).sum(-1))


def _move(
    label: str,
    steps: int,
    rate: int,
    ease: float,
    start: np.ndarray,
    origin: np.ndarray,
    rng: np.random.Generator,
    motion: str,
    apart: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """Compute rotations (steps, 3, 3) and positions (steps, 3) m after the pose at the start."""
    fine = 8 if label == "contour" else 1
    times = np.arange(steps * fine + 1) / (rate * fine)
    if ease:
        ramp = np.minimum(1, np.minimum(times, times[-1] - times) / ease)
        ramp = ramp**2 * (3 - 2 * ramp)
        times = np.concatenate([[0], np.cumsum((ramp[1:] + ramp[:-1]) / 2 * np.diff(times))])

    stops = np.cumsum(rng.uniform(*apart, size=int(times[-1] / apart[0]) + 4)) if motion == "jerks" else None

    def drive(size: float, free: str) -> np.ndarray:
        if stops is not None:
            knot = np.searchsorted(stops, times, side="right")
            before, after = np.append(0, stops)[knot], stops[knot]
            part = ((times - before) / (after - before))[:, None]
            values = rng.normal(0, size, (len(stops) + 1, 3))
            progress = part**3 * (10 - 15 * part + 6 * part**2)
            path = values[knot] + progress * (values[knot + 1] - values[knot])
            return np.asarray((path - path[0]) * [axis in free for axis in "xyz"])
        if motion == "splines":
            knots = np.cumsum(rng.uniform(*apart, size=int(times[-1] / apart[0]) + 4)) - apart[1]
            path = CubicSpline(knots, rng.normal(0, size, (len(knots), 3)))(times)
            return np.asarray((path - path[0]) * [axis in free for axis in "xyz"])
        amplitude, f, phase = (rng.uniform(a, b, (3, 3)) for a, b in ((0.5, 1), (0.2, 0.9), (0, 2 * np.pi)))
        amplitude *= size * np.sqrt(2 / np.sum(amplitude**2, axis=1, keepdims=True))
        path = np.sum(amplitude * np.sin(2 * np.pi * f * times[:, None, None] + phase), axis=-1)
        return np.asarray((path - path[0]) * [axis in free for axis in "xyz"])

    turn = drive(rng.uniform(0.35, 0.6), _FREE_ROTATION.get(label, ""))
    shift = drive(rng.uniform(0.05, 0.1), _FREE_TRANSLATION.get(label, ""))
    frame, on_body = Rotation.random(random_state=rng), rng.uniform(-0.15, 0.15, 3)  # of the contact
    if label == "contour":  # a point of the body moves along an axis of the body
        moved = Rotation.from_rotvec(turn)
        turned = frame * moved * frame.inv() * Rotation.from_matrix(start)
        axis = Rotation.random(random_state=rng).as_matrix()[0]
        along = np.diff(shift[:, 0])[:, None] * (turned[:-1].apply(axis) + turned[1:].apply(axis)) / 2
        point = origin + start @ on_body + np.concatenate([np.zeros((1, 3)), np.cumsum(along, axis=0)])
    else:
        turned = frame * Rotation.from_rotvec(turn) * frame.inv() * Rotation.from_matrix(start)
        point = origin + start @ on_body + frame.apply(shift)
    position = point - turned.apply(on_body)
    return turned.as_matrix()[fine::fine], position[fine::fine]

"""Simulated sequences of constraints with known changes, in plain NumPy.

A body moves under one constraint after the other. Each constraint lies in a random place, within 0.15 m of
the body. Sums of three sines of 0.2 to 0.9 Hz drive the free coordinates, or splines through random values
0.7 to 3 s apart: 0.35 to 0.6 rad and 50 to 100 mm rms. In half of the sequences every motion sets out from
rest and comes to rest within 0.25 s; in the other half the velocity jumps. White noise of sigma m comes with
sigma / 0.3 m rad; slow errors are sines of 0.1 to 1.2 Hz, with 5 rad/m.
"""

from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

__all__ = ["ERRORS", "NAMES", "Sequence", "move_through", "simulate_sequences", "simulate_single"]

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

ERRORS = (
    {"white": 1e-5},
    {"white": 1e-4},
    {"white": 1e-3},
    {"white": 1e-6, "soft": 3e-4},
    {"white": 1e-6, "soft": 1e-3},
)
"""Sizes in m: white noise of 10 um to 1 mm, and soft contacts."""


class Sequence(NamedTuple):
    """A simulated recording: what held, from which pose on, and the poses."""

    labels: tuple[str, ...]
    starts: np.ndarray  # (S,) index of the first pose of each constraint
    poses: np.ndarray  # (N, 4, 4) m
    times: np.ndarray  # (N,) s
    errors: dict[str, float]

    @property
    def changes(self) -> np.ndarray:
        """Times of the changes, s."""
        return np.asarray(self.times[self.starts[1:]])


def simulate_sequences(count: int, seed: int = 0, splines: bool = False) -> list[Sequence]:
    """Sequences of three or four constraints, 4 to 8 s each, no constraint twice in a row.

    Args:
        count: of sequences.
        seed: of everything.
        splines: whether the motion is drawn through random places, and slower; else it is a sum of sines.
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
        durations = rng.uniform(4, 8, len(labels))
        apart = (0.7, 1.8) if number % 2 else (1.5, 3.0)
        made.append(
            move_through(
                labels, durations, ERRORS[number % len(ERRORS)], rng, apart=apart if splines else None
            )
        )
    return made


def simulate_single(label: str, number: int, seed: int = 0) -> Sequence:
    """A recording of one constraint, 8 to 20 s long."""
    rng = np.random.default_rng([seed, 1000 + number, list(NAMES).index(label)])
    return move_through([label], rng.uniform(8, 20, 1), ERRORS[number % len(ERRORS)], rng)


def move_through(
    labels: list[str],
    durations: np.ndarray,
    errors: dict[str, float],
    rng: np.random.Generator,
    rate: int | None = None,
    apart: tuple[float, float] | None = None,
) -> Sequence:
    """Simulate constraints one after the other.

    Args:
        labels: of the constraints, keys of :data:`NAMES`.
        durations: of each, s.
        errors: "white" and "soft", m.
        rng: of places, motions and errors.
        rate: Hz; by default 20, 50 or 100.
        apart: s, of the places of splines; None for sines.
    """
    drawn, ease = int(rng.choice([20, 50, 100])), float(rng.choice([0.0, 0.25]))
    rate = rate or drawn
    rotation = [Rotation.random(random_state=rng).as_matrix()[None]]
    position = [rng.uniform(-0.5, 0.5, (1, 3))]
    starts = [0]
    for label, duration in zip(labels, durations, strict=True):
        steps = round(duration * rate)
        turned, moved = _move(label, steps, rate, ease, rotation[-1][-1], position[-1][-1], rng, apart)
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
    apart: tuple[float, float] | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (steps, 3, 3) and positions (steps, 3) after those at the start."""
    fine = 8 if label == "contour" else 1
    times = np.arange(steps * fine + 1) / (rate * fine)
    if ease:
        ramp = np.minimum(1, np.minimum(times, times[-1] - times) / ease)
        ramp = ramp**2 * (3 - 2 * ramp)
        times = np.concatenate([[0], np.cumsum((ramp[1:] + ramp[:-1]) / 2 * np.diff(times))])

    def drive(size: float, free: str) -> np.ndarray:
        if apart is not None:
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

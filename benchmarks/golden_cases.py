"""Simulated recordings with known truth for :mod:`benchmarks.golden`.

Simulated recordings last 5 s. A body moves under one of seventeen constraints of random geometry, whose
origin lies within 0.3 m of the body's origin along each axis. Sums of sines drive the free axes:

- ``exciting``: three incommensurate sines an axis, 0.7 rad/s and 0.18 m/s rms;
- ``slow``: one sine of 0.2 to 0.6 rad/s an axis, amplitude 0.35 to 0.85 rad/s and a quarter of that in m/s;
- ``paper``: the velocities of the paper's section 5.1;
- ``measured``: three sines of 0.1 to 0.8 Hz an axis, rms 0.5 rad and 50 to 100 mm;
- ``long``, ``long turns``: the same sines five times as fast, as in 25 s, and with twice the rotation;
- ``stops``: the path of ``measured`` in three moves, with rests of 0.83 s between them;
- ``small``, ``small turns``, ``small shifts``: a tenth of all, of the rotations, or of the translations.

In the group ``faults``, recordings of the motion ``measured`` with white noise have a fault: four poses that
jump, of which the first or the last is one; two runs of two to seven poses that jump; a missing second; four
times 0.3 s of missing poses; 30 % missing poses; poses that are recorded twice, by a recorder faster than the
tracker; or the times at which poses arrive, in bursts of five.

White noise has a standard deviation of sigma in m for positions and sigma / 0.3 m in rad for orientations.
Slow errors are sums of three sines of 0.1 to 1.2 Hz in random directions, half of their variance in the axes
of the ground and half in the axes of the body; their size is the rms of each component, and encoder noise of
1 um and 3 urad comes on top. Repeatable errors depend on the pose only, like those of an arm whose links are
not as long as its model says: random quadratic functions of the displacement, with the same sizes.
Correlated errors are white noise after a filter with a time constant of 60 ms, or vibrations of 7 to 11 Hz.
In the group ``frames``, errors act about the origin of the body before its frame moves 1 m away, or before
the poses are inverted, with the origin of the ground 1 m away from its place in other groups. In the group
``planar``, a tracker of planar motion measures two coordinates and one angle; the others are zero. In the
group ``stages``, one or two axes of rotation move along two or three translations, as on a gantry.
"""

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

__all__ = ["CONSTRAINTS", "PLANS", "Case", "Spec", "Truth", "arm_cases", "simulate", "unique_type"]

GROUND, BODY = 0, 1
LEVER = 0.3  # m


class Entry(NamedTuple):
    """A constraint: degrees of freedom, and what is unique."""

    name: str
    angular: str  # 1 where an axis is free
    linear: str
    kind: str | None  # the only linear type
    axes: tuple[int | None, int | None]  # the unique angular and linear axis of the frame
    origin: tuple[int, ...]  # axes along which the origin is unique


CONSTRAINTS = {
    "A": Entry("Revolute joint", "010", "000", None, (1, None), (0, 2)),
    "B": Entry("Prismatic joint", "000", "100", None, (None, 0), ()),
    "C": Entry("Cylinder joint", "100", "100", None, (0, 0), (1, 2)),
    "D": Entry("Plane-plane contact", "001", "110", None, (2, 2), ()),
    "E": Entry("Planar contour following", "010", "100", "BB", (1, 0), (0,)),
    "F": Entry("Planar contour rolling", "010", "100", "GG", (1, 0), (0,)),
    "G": Entry("Cart on a curved surface", "111", "110", "BB", (None, 2), (0, 1)),
    "H": Entry("Contour rolling", "111", "100", "GG", (None, 0), (0, 1, 2)),
    "I": Entry("Planar pin-plane contact", "010", "100", "GB", (1, 0), (0, 2)),
    "J": Entry("Planar plane-pin contact", "010", "100", "BG", (1, 0), (0, 2)),
    "K": Entry("Pin-plane contact", "111", "110", "GB", (None, 2), (0, 1, 2)),
    "L": Entry("Plane-pin contact", "111", "110", "BG", (None, 2), (0, 1, 2)),
    "spherical": Entry("Spherical joint", "111", "000", None, (None, None), (0, 1, 2)),
    "universal": Entry("Universal joint", "110", "000", None, (None, None), (0, 1, 2)),
    "screw": Entry("Screw joint", "100", "100", None, (0, 0), (1, 2)),
    "fixed": Entry("Fixed", "000", "000", None, (None, None), ()),
    "unconstrained": Entry("Unconstrained", "111", "111", None, (None, None), ()),
}
TWELVE = tuple("ABCDEFGHIJKL")
STAGES = {
    entry.name: entry
    for entry in (
        Entry("1 rotation, 2 translations in GB", "010", "110", "GB", (1, 2), (0, 2)),
        Entry("1 rotation, 2 translations in BG", "010", "110", "BG", (1, 2), (0, 2)),
        Entry("1 rotation, 3 translations", "001", "111", None, (2, None), ()),
        Entry("2 rotations, 3 translations", "110", "111", None, (None, None), ()),
    )
}
_ALL = CONSTRAINTS | STAGES

# The paper's velocities also obey a second constraint. Its name or class counts as right, without a score
# of the geometry.
AMBIGUOUS = {
    "E": (CONSTRAINTS["A"].name,),
    "F": (CONSTRAINTS["A"].name,),
    "G": ("3 rotations, 1 translation in BB",),
    "H": (),
    "I": (CONSTRAINTS["F"].name,),
    "J": (CONSTRAINTS["E"].name,),
}


def unique_type(name: str) -> str | None:
    """The single linear type of a named constraint, such as "BB"; None for other names."""
    return next((entry.kind for entry in CONSTRAINTS.values() if entry.name == name), None)


@dataclass(frozen=True)
class Truth:
    """Geometry of a constraint in {g} (index 0) and in {b} (index 1); NaN if it is not fixed in the body."""

    angular: np.ndarray  # (2, 3) unit vectors, determined axis of the angular frame
    linear: np.ndarray  # (2, 3) unit vectors, determined axis of the linear frame
    point: np.ndarray  # (2, 3) m, the origin
    directions: np.ndarray  # (2, 3, 3) projectors onto the directions in which the origin is determined
    line: bool = False  # whether any point on the line along the angular axis is correct


def no_truth() -> Truth:
    """An unknown geometry."""
    nothing = np.full((2, 3), np.nan)
    return Truth(nothing, nothing, nothing, np.full((2, 3, 3), np.nan))


@dataclass(frozen=True)
class Case:
    """A recording, and its expected identification."""

    key: str  # unique; starts with the group
    group: str
    label: str  # a key of CONSTRAINTS, or the moved object
    poses: np.ndarray  # (K, 4, 4) m
    times: np.ndarray  # (K,) s
    expected: tuple[str, ...]  # right names or classes; empty if the recording is not scored
    truth: Truth
    strong: bool = True  # whether the free motion is large enough to require a right name
    paper_settings: bool = False  # whether to identify with the paper's scale and thresholds


class Spec(NamedTuple):
    """A simulated case: ``rate`` in Hz, ``white`` and ``slow`` errors in m, ``slow_turn`` in rad."""

    group: str
    label: str
    motion: str
    rate: int
    white: float
    slow: float = 0.0
    slow_turn: float = 0.0
    seed: int = 0
    fault: str = ""

    @property
    def recording(self) -> str:
        """Name of the recording, equal in all groups that use the recording."""
        errors = f"{self.slow:g} m {self.slow_turn:g} rad slow" if self.slow else f"{self.white:g} m"
        fault = self.fault and f" {self.fault}"
        return f"{self.label}/{self.motion}/{self.rate} Hz/{errors}{fault}/{self.seed}"


SIGMAS = (1e-6, 1e-5, 1e-4, 1e-3, 3e-3)  # m
SLOW = ((1e-4, 5e-4), (3e-4, 1.5e-3), (1e-3, 5e-3), (3e-3, 1e-2))  # m, rad
ENCODER = 1e-6, 3e-6  # m, rad: white noise in addition to slow errors
GIVE = 2e-4, 5e-4  # m, rad: compliance of an arm; ten times these values count as motion


def white_specs() -> Iterator[Spec]:
    for seed, motion, rate, sigma in product(range(2), ("exciting", "slow", "paper"), (10, 100), SIGMAS):
        for label in CONSTRAINTS:
            # rest is a single motion; an unconstrained body with the paper's velocities obeys G
            if (label, motion) not in {("fixed", "slow"), ("fixed", "paper"), ("unconstrained", "paper")}:
                yield Spec("white", label, motion, rate, sigma, seed=seed)


def soft_specs() -> Iterator[Spec]:
    for seed, (slow, turn), label in product(range(4), SLOW, CONSTRAINTS):
        yield Spec("soft", label, "measured", 20, ENCODER[0], slow, turn, seed)


def repeatable_specs() -> Iterator[Spec]:
    for seed, (slow, turn), label in product((20, 21), SLOW, CONSTRAINTS):
        if label != "fixed":  # errors that depend on the pose need motion
            yield Spec("repeatable", label, "measured", 20, ENCODER[0], slow, turn, seed)


def nothing_specs() -> Iterator[Spec]:
    for seed, motion, rate, sigma in product((10, 11), ("exciting", "measured"), (10, 100), SIGMAS):
        yield Spec("nothing", "unconstrained", motion, rate, sigma, seed=seed)
    for seed, motion, (slow, turn) in product(range(10, 15), ("exciting", "measured"), SLOW):
        yield Spec("nothing", "unconstrained", motion, 20, ENCODER[0], slow, turn, seed)
    for seed, motion, sigma in product(range(10, 14), ("long", "long turns"), SIGMAS[:4]):
        yield Spec("nothing", "unconstrained", motion, 100, sigma, seed=seed)


def correlated_specs() -> Iterator[Spec]:
    kinds, moving = ("filter", "vibration"), [label for label in CONSTRAINTS if label != "fixed"]
    for seed, kind, (slow, turn), label in product((50, 51), kinds, ((3e-4, 1e-3), (1e-3, 3e-3)), moving):
        yield Spec("correlated", label, "measured", 50, ENCODER[0], slow, turn, seed, kind)


def frames_specs() -> Iterator[Spec]:
    kinds, moving = ("away", "inverse"), [label for label in CONSTRAINTS if label != "fixed"]
    for seed, kind, slow, label in product((60, 61), kinds, (0.0, 1e-3), moving):
        white = ENCODER[0] if slow else 3e-3
        yield Spec("frames", label, "measured", 20, white, slow, 5 * slow, seed, kind)


def stops_specs() -> Iterator[Spec]:
    moving = [label for label in CONSTRAINTS if label != "fixed"]
    for (slow, turn), label in product(((0.0, 0.0), *SLOW[:3]), moving):
        for white in (ENCODER[0],) if slow else SIGMAS[:4]:
            yield Spec("stops", label, "stops", 20, white, slow, turn, 30)


def small_specs() -> Iterator[Spec]:
    moving = [label for label in CONSTRAINTS if label != "fixed"]
    for motion, white, label in product(("small", "small turns", "small shifts"), SIGMAS[1:3], moving):
        yield Spec("small", label, motion, 20, white, seed=80)


def faults_specs() -> Iterator[Spec]:
    moving = [label for label in CONSTRAINTS if label != "fixed"]
    for fault, white, label in product(
        ("jumps", "runs", "gap", "missing", "hidden", "repeats", "bursts"), SIGMAS[1:4], moving
    ):
        yield Spec("faults", label, "measured", 20, white, seed=40, fault=fault)


def planar_specs() -> Iterator[Spec]:
    errors = [(sigma, 0.0, 0.0) for sigma in SIGMAS[2:4]] + [(ENCODER[0], *slow) for slow in SLOW[:3]]
    for seed, (white, slow, turn), label in product((90, 91), errors, "ABDEFIJ"):
        yield Spec("planar", label, "measured", 20, white, slow, turn, seed)


def stages_specs() -> Iterator[Spec]:
    errors = [(sigma, 0.0, 0.0) for sigma in SIGMAS[:4]] + [(ENCODER[0], *slow) for slow in SLOW]
    for seed, (white, slow, turn), label in product((95, 96), errors, STAGES):
        yield Spec("stages", label, "measured", 20, white, slow, turn, seed)


def paper_specs() -> Iterator[Spec]:
    for motion, sigma, label in product(("exciting", "paper"), SIGMAS[:4], TWELVE):
        yield Spec("paper", label, motion, 10, sigma)
    for seed, (slow, turn), label in product(range(4), SLOW[1:3], TWELVE):
        yield Spec("paper", label, "measured", 20, ENCODER[0], slow, turn, seed)


PLANS = {
    "white": white_specs,
    "soft": soft_specs,
    "repeatable": repeatable_specs,
    "correlated": correlated_specs,
    "frames": frames_specs,
    "stops": stops_specs,
    "small": small_specs,
    "planar": planar_specs,
    "stages": stages_specs,
    "faults": faults_specs,
    "nothing": nothing_specs,
    "paper": paper_specs,
}

# ---------- simulation: the frame moves along its free axes, in closed form but for two integrals
_STEP, _NODES, _CHUNK = 0.005, 1001, 256  # time step, s; integration nodes; recordings per chunk
_TIMES = _STEP * np.arange(_NODES)
_EXCITING = np.array([[0.9, 2.9, 4.9], [1.4, 3.4, 5.4], [1.9, 3.9, 4.4]])  # rad/s
_PAPER = np.zeros((4, 6, 3))  # amplitude, rate (rad/s), phase, stops
_PAPER[:3, :, 0] = (
    (0.5, -0.5, 0.5, -0.1, 0.1, 0.1),
    (0, 0, 3, 0, 2, 3),
    np.pi / 2 * np.array([1, 1, 1, 1, 1, 0]),
)
_PAPER[:3, 0, 1] = 0.5, 2, 0
# fractions of the rotations and the translations of the motion ``measured``
_PARTS = {"small": (0.1, 0.1), "small turns": (0.1, 1), "small shifts": (1, 0.1), "long turns": (2, 1)}
_STOPS = 0.6  # rests per second
_FILTER = 0.06  # s, time constant of correlated errors


def simulate(specs: Sequence[Spec]) -> list[Case]:
    """Simulate recordings; each recording depends only on its :class:`Spec`."""
    return [case for i in range(0, len(specs), _CHUNK) for case in _simulate_chunk(specs[i : i + _CHUNK])]


def _simulate_chunk(specs: Sequence[Spec]) -> list[Case]:
    random = [np.random.default_rng(zlib.crc32(spec.recording.encode())) for spec in specs]
    kinds = [_ALL[spec.label].kind or "BB" for spec in specs]
    axes_on_body, origin_on_body = (
        np.array([kind[i] == "B" for kind in kinds])[:, None, None] for i in (0, 1)
    )
    start, axes = np.moveaxis(np.array([Rotation.random(2, rng).as_matrix() for rng in random]), 1, 0)
    offset = np.array([rng.uniform(-0.5, 0.5, 3) for rng in random])
    origin_b = np.array([rng.uniform(-LEVER, LEVER, 3) for rng in random])
    origin_g = offset + np.einsum("nij,nj->ni", start, origin_b)
    sines = np.array([_draw_sines(spec, rng) for spec, rng in zip(specs, random, strict=True)])
    rotations = _integrate_rotation(sines, axes, start, axes_on_body)
    for i in [i for i, spec in enumerate(specs) if _ALL[spec.label].angular == "110"]:
        first, second = (_STEP * np.cumsum(_velocity(sines[i], _TIMES)[k])[:, None] for k in (0, 1))
        outer, inner = (
            Rotation.from_rotvec(first * axes[i, :, 0]),
            Rotation.from_rotvec(second * axes[i, :, 1]),
        )
        rotations[i] = outer.as_matrix() @ inner.as_matrix() @ start[i]
    speed = np.einsum(
        "nij,njk->nki", axes, _velocity(sines, _TIMES)[:, 3:]
    )  # in the body in which the axes are fixed
    tip = np.where(
        axes_on_body, np.einsum("nkij,nkj->nki", rotations, speed), speed
    )  # a point of {b}, in {g}
    seen = np.where(
        axes_on_body, speed, np.einsum("nkji,nkj->nki", rotations, speed)
    )  # a point of {g}, in {b}
    tip, seen = origin_g[:, None] + _integrate(tip), origin_b[:, None] - _integrate(seen)
    rotations = rotations[:, ::2]
    from_tip = tip - np.einsum("nkij,nj->nki", rotations, origin_b)
    from_seen = origin_g[:, None] - np.einsum("nkij,nkj->nki", rotations, seen)
    positions = np.where(origin_on_body, from_tip, from_seen)
    moved = _integrate(np.moveaxis(_velocity(sines, _TIMES), 1, 2))
    in_ground = np.where(axes_on_body, start @ axes, axes)
    cases = []
    for i, spec in enumerate(specs):
        taken = np.s_[i, : -1 : 100 // spec.rate]
        poses = _disturb(spec, rotations[taken], positions[taken], random[i])
        truth = truth_at_start(spec.label, in_ground[i], origin_g[i], rotations[i, 0], positions[i])
        names: tuple[str, ...] = (_ALL[spec.label].name,)
        if spec.motion == "paper" and spec.label in AMBIGUOUS:
            names, truth = names + AMBIGUOUS[spec.label], no_truth()
        key, times = f"{spec.group}/{spec.recording}", np.arange(len(poses)) / spec.rate
        poses, times = _spoil(spec.fault, poses, times, random[i])
        strong = bool(_weakest_axis(spec, moved[taken]) >= (20 if spec.slow else 10))
        paper = spec.group == "paper"
        case = Case(key, spec.group, spec.label, poses, times, names, truth, strong, paper)
        if spec.group == "frames":
            case = _in_other_frames(case, spec.fault, random[i])
        cases.append(_in_plane(case) if spec.group == "planar" else case)
    return cases


def _draw_sines(spec: Spec, rng: np.random.Generator) -> np.ndarray:
    """Amplitude, rate, phase and stops (4, 6, 3) of three sines along three angular and three linear axes."""
    phase, unit = rng.uniform(0, 2 * np.pi, (6, 3)), np.repeat([1.0, 0.25], 3)[:, None]
    stops = np.full((6, 3), _STOPS if spec.motion == "stops" else 0.0)
    if spec.motion == "exciting":
        sines = np.array(
            [0.6 * unit * np.ones(3), np.concatenate([_EXCITING, 1.13 * _EXCITING]), phase, stops]
        )
    elif spec.motion == "slow":
        amplitude = rng.uniform(0.35, 0.85, (6, 1)) * unit * [1, 0, 0]
        sines = np.array([amplitude, rng.uniform(0.2, 0.6, (6, 1)) * np.ones(3), phase, stops])
    elif spec.motion == "paper":
        sines = _PAPER.copy()
    else:
        amplitude, rate = rng.uniform(0.3, 1, (6, 3)), 2 * np.pi * rng.uniform(0.1, 0.8, (6, 3))
        sines = np.array([amplitude, (5 if spec.motion.startswith("long") else 1) * rate, phase, stops])
        rms = np.std(_integrate(_velocity(sines, _TIMES).T), axis=0)
        turn, shift = _PARTS.get(spec.motion, (1, 1))
        size = np.concatenate([np.full(3, turn * 0.5), shift * rng.uniform(0.05, 0.1, 3)])
        sines[0] *= (size / rms)[:, None]
    entry = _ALL[spec.label]
    if spec.label == "screw":
        pitch = rng.choice([-1, 1]) * rng.uniform(0.03, 0.1)  # m/rad
        sines[:, 3] = sines[:, 0] * np.array([[pitch], [1], [1], [1]])
    sines[0] *= np.array([float(free) for free in entry.angular + entry.linear])[:, None]
    return sines


def _velocity(sines: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Velocities (..., 6, T) along the axes, from sines (..., 4, 6, 3); the fourth is the rate of stops."""
    amplitude, rate, phase, stops = np.moveaxis(sines, -3, 0)[..., None, :]
    # in the first half of a period the path is followed at the speed 4 sin^2, in the second half not at all
    cycles = stops * times[:, None]
    within = np.minimum(cycles % 1, 0.5)
    passed = np.floor(cycles) + 2 * within - np.sin(4 * np.pi * within) / (2 * np.pi)
    moving = stops > 0
    reached = np.where(moving, passed / np.where(moving, stops, 1), times[:, None])
    speed = np.where(moving, 4 * np.sin(2 * np.pi * within) ** 2, 1)
    return np.sum(speed * amplitude * np.sin(rate * reached + phase), axis=-1)


def _integrate(values: np.ndarray) -> np.ndarray:
    """Simpson's integral (..., T, n) from the first node to every second node."""
    step = _STEP / 3 * (values[..., :-1:2, :] + 4 * values[..., 1::2, :] + values[..., 2::2, :])
    return np.concatenate([np.zeros_like(step[..., :1, :]), np.cumsum(step, axis=-2)], axis=-2)


def _integrate_rotation(
    sines: np.ndarray, axes: np.ndarray, start: np.ndarray, on_body: np.ndarray
) -> np.ndarray:
    """Rotations (N, T, 3, 3) of a body that turns about the frame's axes, by fourth-order Magnus steps."""
    nodes = _TIMES[:-1] + _STEP / 2
    first, second = (
        np.einsum("nij,njk->nki", axes, _velocity(sines, nodes + sign * _STEP * np.sqrt(3) / 6)[:, :3])
        for sign in (-1, 1)
    )
    bend = np.where(on_body, 1, -1) * np.sqrt(3) / 12 * _STEP**2
    step = _STEP / 2 * (first + second) + bend * np.cross(first, second)
    turns = Rotation.from_rotvec(step.reshape(-1, 3)).as_matrix().reshape(*step.shape, 3)
    rotations = np.empty((len(axes), _NODES, 3, 3))
    rotations[:, 0] = start
    for k in range(_NODES - 1):
        now, turn = rotations[:, k], turns[:, k]
        rotations[:, k + 1] = np.where(on_body, now @ turn, turn @ now)
    return rotations


def _disturb(spec: Spec, rotation: np.ndarray, position: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Add white noise and slow errors to poses (K, 4, 4)."""
    times = np.arange(len(position)) / spec.rate
    white = rng.normal(size=(2, len(times), 3)) * spec.white
    white[1] *= ENCODER[1] / ENCODER[0] if spec.slow else 1 / LEVER
    if spec.group == "repeatable":
        slow = np.array([_repeatable_error(rotation, position, rng) for _ in range(4)]) / np.sqrt(2)
    elif spec.group == "correlated":
        slow = np.array([_correlated_error(spec.fault, times, rng) for _ in range(4)]) / np.sqrt(2)
    else:
        slow = np.array([_slow_error(times, rng) for _ in range(4)]) / np.sqrt(2)
    shift = spec.slow * (slow[0] + np.einsum("kij,kj->ki", rotation, slow[1]))
    before, after = (Rotation.from_rotvec(spec.slow_turn * slow[i]) for i in (2, 3))
    turned = before.as_matrix() @ rotation @ (after * Rotation.from_rotvec(white[1])).as_matrix()
    return make_poses(turned, position + white[0] + shift)


def _spoil(
    fault: str, poses: np.ndarray, times: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Let poses jump by 0.1 m and 0.5 rad, in runs or not; remove or repeat poses; spoil their times."""
    if fault == "repeats":
        return poses[np.arange(len(times)) // 2 * 2], times
    if fault == "bursts":
        number = np.arange(len(times))
        return poses, times[np.minimum(number // 5 * 5 + 4, len(times) - 1)] + 1e-4 * (number % 5)
    if fault == "missing":
        kept = np.sort(rng.permutation(len(times))[: 7 * len(times) // 10])
        return poses[kept], times[kept]
    if fault == "hidden":
        ends = np.sort(rng.permutation(len(times) - 24)[:4]) + 6 * np.arange(1, 5)
        kept = np.setdiff1d(np.arange(len(times)), ends[:, None] - np.arange(6))
        return poses[kept], times[kept]
    if fault == "gap":
        start = rng.integers(len(times) // 4, len(times) // 2)
        kept = (times < times[start]) | (times >= times[start] + 1)
        return poses[kept], times[kept]
    jumps: list[range] = []
    if fault == "jumps":
        jumps = [range(k, k + 1) for k in (rng.choice([0, len(times) - 1]), *rng.integers(0, len(times), 3))]
    if fault == "runs":
        jumps = [range(k, k + rng.integers(2, 8)) for k in rng.integers(5, len(times) - 15, 2)]
    for jump in jumps:
        poses[jump, :3, :3] = poses[jump, :3, :3] @ Rotation.from_rotvec(0.5 * rng.normal(size=3)).as_matrix()
        poses[jump, :3, 3] += 0.1 * rng.normal(size=3)
    return poses, times


_INVERSE = {"E": "F", "F": "E", "I": "J", "J": "I", "K": "L", "L": "K"}
_UNNAMED = {"G": "3 rotations, 2 translations in GG", "H": "3 rotations, 1 translation in BB"}


def _in_other_frames(case: Case, kind: str, rng: np.random.Generator) -> Case:
    """Move the frame of the body by 1 m in its own axes, or that of the ground, and invert the poses."""
    moved, poses, point = rng.normal(size=3), case.poses.copy(), case.truth.point.copy()
    moved /= np.linalg.norm(moved)
    if kind == "away":
        poses[:, :3, 3] += poses[:, :3, :3] @ moved
        point[BODY] -= moved
        return replace(case, poses=poses, truth=replace(case.truth, point=point))
    poses[:, :3, 3] += moved
    point[GROUND] += moved
    angular, linear, point, directions = (
        np.flip(leaf, 0) for leaf in (case.truth.angular, case.truth.linear, point, case.truth.directions)
    )
    truth = Truth(angular, linear, point, directions, case.truth.line)
    label = _INVERSE.get(case.label, case.label)
    names = (_UNNAMED.get(label, CONSTRAINTS[label].name),)
    return replace(case, poses=np.linalg.inv(poses), label=label, expected=names, truth=truth)


def _in_plane(case: Case) -> Case:
    """Let the axis of rotation be z in both bodies, and leave out the height, the roll and the pitch."""
    truth, rotation = case.truth, case.poses[:, :3, :3]
    axes = truth.angular
    if np.isnan(axes).any():  # a slide: any plane that contains its direction
        axis = np.cross(truth.linear[GROUND], np.roll(truth.linear[GROUND], 1))
        axes = np.array([axis, rotation[0].T @ axis]) / np.linalg.norm(axis)
    turn = np.array([Rotation.align_vectors([[0, 0, 1]], [each])[0].as_matrix() for each in axes])
    seen = turn[GROUND] @ rotation @ turn[BODY].T
    angle = Rotation.from_rotvec(np.arctan2(seen[:, 1, 0], seen[:, 0, 0])[:, None] * [0, 0, 1])
    position = case.poses[:, :3, 3] @ turn[GROUND].T * [1, 1, 0]
    angular, linear, point = (
        np.einsum("bij,bj->bi", turn, each) for each in (truth.angular, truth.linear, truth.point)
    )
    directions = turn @ truth.directions @ turn.transpose(0, 2, 1)
    truth = Truth(angular, linear, point, directions, truth.line)
    return replace(case, poses=make_poses(angle.as_matrix(), position), truth=truth)


def _slow_error(times: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Slow error (K, 3): three sines in random directions, with a mean RMS of 1 per component."""
    direction = rng.normal(size=(3, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    rate, phase = 2 * np.pi * rng.uniform(0.1, 1.2, 3), rng.uniform(0, 2 * np.pi, 3)
    error = np.sin(times[:, None] * rate + phase) @ direction
    return np.asarray(error / np.sqrt(np.mean(error**2)))


def _correlated_error(kind: str, times: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Error (K, 3) with an RMS of 1 per component: filtered white noise, or a vibration."""
    if kind == "vibration":
        rate, phase = 2 * np.pi * rng.uniform(7, 11, 3), rng.uniform(0, 2 * np.pi, 3)
        return np.asarray(np.sqrt(2) * np.sin(times[:, None] * rate + phase))
    keep = np.exp(-(times[1] - times[0]) / _FILTER)
    noise = rng.normal(size=(len(times) + 100, 3))
    return np.asarray(lfilter([np.sqrt(1 - keep**2)], [1, -keep], noise, axis=0)[100:])


def _repeatable_error(rotation: np.ndarray, position: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Quadratic function (K, 3) of the displacement from the mean pose, with an RMS of 1 per component."""
    turned = Rotation.from_matrix(rotation)
    moved = np.hstack([position - position.mean(axis=0), LEVER * (turned * turned.mean().inv()).as_rotvec()])
    unit = moved / np.sqrt(np.mean(np.sum(moved**2, axis=1)))
    first, second = np.triu_indices(6)
    error = np.hstack([unit, unit[:, first] * unit[:, second]]) @ rng.normal(size=(27, 3))
    error -= error.mean(axis=0)
    return np.asarray(error / np.sqrt(np.mean(error**2)))


def _weakest_axis(spec: Spec, moved: np.ndarray) -> float:
    """Smallest RMS along a principal axis of the free motion, in units of the error; see the help."""
    entry, moved = _ALL[spec.label], moved - moved.mean(axis=0)
    free = [i for i, dof in enumerate(entry.angular + entry.linear) if dof == "1"]
    turned, slid = moved[:, [i for i in free if i < 3]], moved[:, [i for i in free if i >= 3]]
    if turned.size and spec.label != "screw" and spec.motion != "paper":
        slid = slid - turned @ np.linalg.lstsq(turned, slid, rcond=None)[0]
    white = max(spec.white / LEVER, GIVE[1]), max(spec.white, GIVE[0])
    errors = (spec.slow_turn, spec.slow) if spec.slow else white
    parts = [part / error for part, error in zip((turned, slid), errors, strict=True) if part.size]
    return min(
        (float(np.linalg.svd(part, full_matrices=False)[1][-1]) / np.sqrt(len(part)) for part in parts),
        default=np.inf,
    )


def make_poses(rotations: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Poses (K, 4, 4) from rotations (K, 3, 3) and positions (K, 3) m."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations, positions
    return poses


def truth_at_start(
    label: str, axes: np.ndarray, origin: np.ndarray, rotation: np.ndarray, positions: np.ndarray
) -> Truth:
    """Geometry in both bodies, from axes (3, 3) and an origin (3,) m in {g} at the start.

    ``rotation`` (3, 3) is the orientation of {b} at the start; ``positions`` (K, 3) m are the origins of {b}.
    """
    entry, line = _ALL[label], label in ("A", "C", "screw")
    both = np.array([axes, rotation.T @ axes])
    angular, linear = (np.full((2, 3), np.nan) if i is None else both[:, :, i] for i in entry.axes)
    if line:
        origin = origin + angular[0] * (angular[0] @ (positions.mean(axis=0) - origin))
    point = np.array([origin, rotation.T @ (origin - positions[0])])
    directions = both[:, :, list(entry.origin)] @ both[:, :, list(entry.origin)].mT
    if not entry.origin:
        point, directions = no_truth().point, no_truth().directions
    if entry.kind is not None:  # the axis and the origin are fixed only in the bodies that the type names
        linear, point = linear.copy(), point.copy()
        linear["GB".index(entry.kind[0]) ^ 1] = np.nan
        point["GB".index(entry.kind[1]) ^ 1] = np.nan
    return Truth(angular, linear, point, directions, line)


def in_both(axis: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """A direction (2, 3): in {g}, and its median in {b}."""
    in_body = np.median(axis @ poses[:, :3, :3], axis=0)
    return np.array([axis, in_body / np.linalg.norm(in_body)])


def hinge_truth(axis: np.ndarray, point: np.ndarray, poses: np.ndarray) -> Truth:
    """Geometry of a hinge about a line in {g}, with the point nearest to the positions as origin."""
    both = in_both(axis / np.linalg.norm(axis), poses)
    point = point + both[0] * (both[0] @ (np.median(poses[:, :3, 3], axis=0) - point))
    in_body = np.median(np.einsum("kji,kj->ki", poses[:, :3, :3], point - poses[:, :3, 3]), axis=0)
    directions = np.eye(3) - both[:, :, None] * both[:, None, :]
    return Truth(both, no_truth().linear, np.array([point, in_body]), directions, line=True)


def arm_cases(trials: int = 2) -> list[Case]:
    """Demonstrations of the twelve constraints on the simulated arm; imports the modules of the arm."""
    import jax

    from reframe_jax.simulation import arm

    cases = []
    setups = {"realistic": (arm.REALISTIC, "exciting"), "matched": (arm.MATCHED, "brisk")}
    for (name, (imperfections, excitation)), label in product(setups.items(), TWELVE):
        seed = jax.random.fold_in(jax.random.key(2025), ord(label))
        options: Any = {"spread": arm.SPREAD, "imperfections": imperfections, "excitation": excitation}
        parts = arm.demonstrations(label, seed, trials, **options)
        for i, made in enumerate([part[k] for part in parts for k in range(len(part.poses))]):
            poses, exact = np.asarray(made.poses, dtype=float), np.asarray(made.exact_poses, dtype=float)
            rotation, position, kind = exact[0, :3, :3], exact[0, :3, 3], made.truth.linear_type.name
            axes, origin = np.asarray(made.truth.linear_axes), np.asarray(made.truth.position)
            axes = rotation @ axes if kind[0] == "B" else axes
            origin = position + rotation @ origin if kind[1] == "B" else origin
            truth = truth_at_start(label, axes, origin, rotation, exact[:, :3, 3])
            # same length as the other recordings at 20 Hz
            key, times, names = (
                f"arm/{label}/{name}/{i}",
                np.asarray(made.times)[:-1],
                (CONSTRAINTS[label].name,),
            )
            cases.append(Case(key, "arm", label, poses[:-1], times, names, truth))
    return cases

"""Compare ``identify(..., assume=...)`` with textbook estimators for a known joint.

The joints are balls and hinges with motions of a person, with small and large angles. The noise is white.
With soft errors, the sensor also slips on the body by millimetres and degrees while the joint turns. The
sensor is 0.25 m from the joint. Methods:

- ``assume``: ``rf.identify`` with ``assume="ball"`` or ``"hinge"``;
- ``SCoRE``: the symmetrical centre of rotation (Ehrig et al. 2006): least squares of R x + p = y. For the
  motion of one body in the frame of another, SCoRE equals the least-squares pivot;
- ``SARA``: the symmetrical axis of rotation (Ehrig et al. 2007): the direction that R x - y = -p does not
  determine, through the solution with the smallest norm;
- ``circle``: the axis of the circle through the positions of the sensor, which is the truth for recorded
  doors;
- ``calibrate``: ``rf.calibrate``, the least-squares pivot without outliers.

The error of a centre is its distance from the truth, in the ground. The errors of an axis are its angle and
its distance, at the point closest to the sensor. The table has the median and the largest error of each
setting.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import reframe_jax as rf
from benchmarks.common import machine, new_parser, write_record
from benchmarks.golden import fit_axis
from reframe_jax.geometry.numpy_rotations import nearest_rotations
from reframe_jax.joints.joint import two_digits

__all__ = ["Setting", "axis_errors", "axis_of", "centre_errors", "main", "make", "sara", "score"]

DATA = Path(__file__).parents[2] / "shared" / "data"
POSES, DT = 250, 0.04  # poses per recording; sample time, s
LEVER = np.array([0.15, 0.1, 0.17])  # m, from the sensor to the joint, in the body
CLUSTER = 0.1  # m, size of the marker cluster: the ratio of position noise to orientation noise
SOFT = 0.005, np.radians(2)  # m and rad, amplitude of soft errors
RANGES = {
    "small": np.radians(10),
    "large": np.radians(35),
}  # rad, amplitude about each axis of a ball; a hinge has twice this amplitude
NOISES = 1e-4, 1e-3, 5e-3  # m
RECORDINGS = 12
DOORS = tuple(f"kitchen_door_{number}" for number in (389, 391, 403, 405, 411, 412))
MEASURED = np.array([0.00914, -0.00131, -0.99996]), np.array([-0.03309, -0.24509, -0.00055])
TOUCHED = np.array([0.2457, -0.8800, 0.0432])  # m, in the ground, from the recording tcp_touches_14

Line = tuple[np.ndarray, np.ndarray]
"""A line in the ground: its direction and a point, m."""


@dataclass(frozen=True)
class Setting:
    """A simulated setting: "ball" or "hinge", noise in m, "small" or "large" angles, and soft errors."""

    joint: str
    noise: float
    reach: str
    soft: bool


def make(setting: Setting, count: int, seed: int = 0) -> tuple[np.ndarray, list[Line]]:
    """Simulate recordings of a joint.

    Returns:
        Poses (count, K+1, 4, 4), m, and the axis of every recording; a ball uses only the point of the axis.
    """
    rng = np.random.default_rng(seed)
    times = DT * np.arange(POSES)
    poses, lines = np.tile(np.eye(4), (count, POSES, 1, 1)), []
    for recording in poses:
        home, axis, point = Rotation.random(rng=rng), _direction(rng), rng.uniform(-0.5, 0.5, 3)
        amplitude = RANGES[setting.reach]
        if setting.joint == "hinge":
            turns = np.outer(2 * amplitude * _wave(rng, times, 1)[:, 0], axis)
        else:
            turns = amplitude * _wave(rng, times, 3)
        turned = Rotation.from_rotvec(turns) * home
        places = point - turned.apply(LEVER)
        if setting.soft:
            # the slip depends on the motion, like skin, and has an independent component
            slip = turns / amplitude @ rng.normal(size=(3, 6)) / 2 + _wave(rng, times, 6)
            places = places + turned.apply(SOFT[0] * slip[:, :3])
            turned = turned * Rotation.from_rotvec(SOFT[1] * slip[:, 3:])
        recording[:, :3, 3] = places + setting.noise * rng.normal(size=(POSES, 3))
        shaken = Rotation.from_rotvec(setting.noise / CLUSTER * rng.normal(size=(POSES, 3)))
        recording[:, :3, :3] = (turned * shaken).as_matrix()
        lines.append((axis, point))
    return poses, lines


def _direction(rng: np.random.Generator) -> np.ndarray:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def _wave(rng: np.random.Generator, times: np.ndarray, width: int) -> np.ndarray:
    """Smooth motions (K+1, width) with an amplitude of about 1: sums of three sines of 0.1 to 0.6 Hz."""
    rates, phases = 2 * np.pi * rng.uniform(0.1, 0.6, (3, width)), rng.uniform(0, 2 * np.pi, (3, width))
    weights = np.array([0.6, 0.4, 0.3])[:, None]
    return np.sum(weights * np.sin(rates * times[:, None, None] + phases), axis=1)


# ---------- textbooks
def score(poses: np.ndarray) -> Line:
    """Estimate the centre by SCoRE."""
    return np.full(3, np.nan), _solve(poses)[0][3:]


def sara(poses: np.ndarray) -> Line:
    """Estimate the axis by SARA."""
    _, (left, sizes, right), target = _solve(poses)
    least = right[:5].T @ ((left.T[:5] @ target) / sizes[:5])
    direction = right[5, 3:]
    return direction / np.linalg.norm(direction), least[3:]


def circle(poses: np.ndarray) -> Line:
    """Estimate the axis of the circle through the positions."""
    return fit_axis(poses[:, :3, 3], circle=True)


def _solve(poses: np.ndarray) -> tuple[np.ndarray, Any, np.ndarray]:
    """Least squares of R x - y = -p: the solution (6,), the singular values, and the right-hand side."""
    design = np.concatenate([poses[:, :3, :3], np.tile(-np.eye(3), (len(poses), 1, 1))], axis=2)
    target = -poses[:, :3, 3].ravel()
    parts = np.linalg.svd(design.reshape(-1, 6), full_matrices=False)
    return parts[2].T @ ((parts[0].T @ target) / parts[1]), parts, target


# ---------- ours
def axis_of(found: rf.Identification, poses: np.ndarray) -> Line:
    """Return the identified axis in the ground, at the mean pose; for a ball, only the point is valid."""
    axis, point = np.asarray(found.angular.axes)[:, 2], np.asarray(found.linear.position)
    if found.angular.frame_type == rf.AngularType.B:
        axis = nearest_rotations(poses[:, :3, :3].mean(axis=0)) @ axis
    if found.linear.frame_type.position_body == rf.AngularType.B:
        point = (poses[:, :3, :3] @ point + poses[:, :3, 3]).mean(axis=0)
    return axis, point


def calibrated(poses: np.ndarray) -> Line:
    """Estimate the centre by ``calibrate``."""
    return np.full(3, np.nan), rf.calibrate(poses).point


# ---------- errors
def centre_errors(found: Line, truth: Line, poses: np.ndarray) -> tuple[float, float]:
    """NaN for the angle, and the distance of two centres, mm."""
    return float("nan"), 1e3 * float(np.linalg.norm(found[1] - truth[1]))


def axis_errors(found: Line, truth: Line, poses: np.ndarray) -> tuple[float, float]:
    """Angle between two axes, deg, and their distance, mm, at the point closest to the sensor."""
    (axis, point), (true_axis, true_point) = found, truth
    middle = poses[:, :3, 3].mean(axis=0)
    near = point + axis * ((middle - point) @ axis)
    sine, cosine = np.linalg.norm(np.cross(axis, true_axis)), abs(axis @ true_axis)
    return float(np.degrees(np.arctan2(sine, cosine))), 1e3 * float(
        np.linalg.norm(np.cross(near - true_point, true_axis))
    )


BALL: dict[str, Callable[[np.ndarray], Line]] = {"SCoRE": score, "calibrate": calibrated}
HINGE: dict[str, Callable[[np.ndarray], Line]] = {"SARA": sara, "circle": circle}


def _rows(
    name: str, joint: str, poses: Sequence[np.ndarray], truths: Sequence[Line], ours: list[Line]
) -> Any:
    """One row per method for a set of recordings."""
    fits, errors = (BALL, centre_errors) if joint == "ball" else (HINGE, axis_errors)
    lines = {"assume": ours} if ours else {}
    lines |= {contestant: [fit(each) for each in poses] for contestant, fit in fits.items()}
    for contestant, found in lines.items():
        every = np.array([errors(*each) for each in zip(found, truths, poses, strict=True)])
        yield {
            "case": name,
            "joint": joint,
            "contestant": contestant,
            "angle_median_deg": _plain(np.median(every[:, 0])),
            "angle_largest_deg": _plain(np.max(every[:, 0])),
            "distance_median_mm": _plain(np.median(every[:, 1])),
            "distance_largest_mm": _plain(np.max(every[:, 1])),
        }


def _plain(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None


def run(settings: Sequence[Setting], count: int, real: bool) -> list[dict[str, Any]]:
    """Run all methods on simulated recordings, then on real recordings."""
    rows: list[dict[str, Any]] = []
    for seed, setting in enumerate(settings):
        poses, lines = make(setting, count, seed)
        soft = ", soft" if setting.soft else ""
        name = f"{setting.joint}, {setting.reach}, {1e3 * setting.noise:g} mm{soft}"
        ours = [axis_of(rf.identify(each, assume=setting.joint, dt=DT), each) for each in poses]
        rows += _rows(name, setting.joint, list(poses), lines, ours)
    for name in (*DOORS, "hinge") if real else ():
        recording = rf.load_recording(DATA / f"{name}.csv")
        truth = MEASURED if name == "hinge" else circle(recording.poses)
        found = rf.identify(recording.poses, times=recording.times, assume="hinge")
        poses = recording.poses[np.asarray(found.counted)]
        mine = _rows(name, "hinge", [poses], [truth], [axis_of(found, recording.poses)])
        rows += [row for row in mine if name == "hinge" or row["contestant"] != "circle"]
    if real:
        touches = rf.load_recording(DATA / "cases" / "tcp_touches_14.csv").poses
        rows += _rows("tcp_touches_14", "ball", [touches], [(TOUCHED, TOUCHED)], [])
    return rows


def print_table(rows: Sequence[dict[str, Any]], count: int) -> None:
    """Print the table."""
    print(f"{count} recordings of {POSES * DT:g} s a setting: median and largest error; {machine()}")
    print(f"{'':32}{'':10}{'angle, deg':>16}{'distance, mm':>16}")
    last = None
    for row in rows:
        name = "" if row["case"] == last else row["case"]
        last = row["case"]
        cells = ""
        for kind in ("angle", "distance"):
            unit = "deg" if kind == "angle" else "mm"
            median, most = row[f"{kind}_median_{unit}"], row[f"{kind}_largest_{unit}"]
            cells += f"{'-':>16}" if median is None else f"{two_digits(median):>8}{two_digits(most):>8}"
        print(f"{name:32}{row['contestant']:10}{cells}")


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the benchmark."""
    parser: argparse.ArgumentParser = new_parser("assumed", __doc__)
    add = parser.add_argument
    add("--quick", action="store_true", help="two simulated recordings of a hinge and a ball only")
    add("--json", type=Path, help="file to write all figures to")
    options = parser.parse_args(argv)
    every = [
        Setting(joint, noise, reach, soft)
        for joint in ("ball", "hinge")
        for soft in (False, True)
        for reach in RANGES
        for noise in NOISES
    ]
    settings = (
        [each for each in every if each.noise == 1e-3 and each.reach == "large"] if options.quick else every
    )
    count = 2 if options.quick else RECORDINGS
    rows = run(settings, count, DATA.is_dir() and not options.quick)
    print_table(rows, count)
    write_record(options.json, {"machine": machine(), "rows": rows})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

"""Test error bars under slow errors: six kitchen doors, and a hinge with a measured axis.

A camera recorded the doors. The positions of a door are on a circle within millimetres; the axis of this
circle is the truth. Each half of a recording gives an estimate and a 95 % region. The table has the errors of
the whole recording, the half-widths of its intervals in the worst direction, the distances between the
estimates of both halves, and the fractions of regions that contain the truth and the estimate of the other
half. The table also has the largest differences between halves and between thirds, and whether the intervals
of the whole recording are at least as wide; the parts have the types of the whole recording. A part that
hardly moves may differ by more. The last rows have every second, fourth and tenth pose of the hinge, that is,
lower sampling rates.
"""

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import jax
import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

import reframe_jax as rf
from benchmarks.common import new_parser
from benchmarks.golden import fit_axis
from reframe_jax.geometry.numpy_rotations import nearest_rotations
from reframe_jax.geometry.rotations import rotation_exp

__all__ = ["DOORS", "DOOR_DATA", "EVERY", "check_door", "check_parts", "check_rate", "in_region"]

DOOR_DATA = Path(__file__).parents[2] / "shared" / "data"
DOORS = tuple(f"kitchen_door_{number}" for number in (389, 391, 403, 405, 411, 412))
_MEASURED = {"hinge": (np.array([0.00914, -0.00131, -0.99996]), np.array([-0.03309, -0.24509, -0.00055]))}


def in_region(error: np.ndarray, covariance: np.ndarray) -> bool:
    """Whether the 95 % region of a covariance (3, 3) contains an error (3,)."""
    values, axes = np.linalg.eigh(covariance)
    known = values > 1e-9 * values[-1]
    return bool(np.sum((error @ axes)[known] ** 2 / values[known]) < chi2.ppf(0.95, known.sum()))


def _half_width(covariance: ArrayLike) -> float:
    """Half-width of the 95 % interval of a covariance (3, 3) in the worst direction."""
    return 1.96 * float(np.sqrt(np.linalg.eigvalsh(np.asarray(covariance))[-1]))


EVERY = 2, 4, 10  # of the poses of the hinge, recorded at 20 Hz


class _Estimate:
    """A hinge in the ground: its line, its axis in the body of the angular type, and their covariances."""

    def __init__(self, recording: rf.Recording, rows: slice) -> None:
        poses, times = np.asarray(recording.poses)[rows], np.asarray(recording.times)[rows]
        self.found = rf.identify(poses, times=times, assume="hinge")
        self.covariance = rf.covariance(self.found, poses, times=times)
        rotations = poses[:, :3, :3]
        self.rotation = nearest_rotations(rotations.mean(axis=0))
        self.body = self.found.angular.frame_type == rf.AngularType.B
        self.axis = np.asarray(self.found.angular.axes)[:, 2]
        self.in_ground = self.rotation @ self.axis if self.body else self.axis
        self.poses = poses

    def line_error(self, point: np.ndarray, axis: np.ndarray) -> np.ndarray:
        """Shift (3,) m of the origin from a line in the ground, without the free direction."""
        if self.found.linear.frame_type.position_body == rf.AngularType.B:
            away = point - self.poses[:, :3, 3]
            point = np.einsum("kji,kj->i", self.poses[:, :3, :3], away) / len(away)
            axis = self.rotation.T @ axis
        shift = np.asarray(self.found.linear.position) - point
        free = np.asarray(self.found.linear.free_position)
        return shift - axis * (shift @ free @ axis) / (axis @ free @ axis)

    def point_in_ground(self) -> np.ndarray:
        """The origin, (3,) m, in the ground; the mean over all poses if it is fixed in the body."""
        at = np.asarray(self.found.linear.position)
        on_body = self.found.linear.frame_type.position_body == rf.AngularType.B
        return (self.poses[:, :3, :3] @ at + self.poses[:, :3, 3]).mean(axis=0) if on_body else at

    def axis_error(self, axis: np.ndarray) -> np.ndarray:
        """Rotation vector (3,) rad from an axis in the ground to the identified axis."""
        axis = self.rotation.T @ axis if self.body else axis
        return np.cross(axis, self.axis * np.sign(axis @ self.axis))


def _errors_of_whole(whole: _Estimate, axis: np.ndarray, point: np.ndarray) -> dict[str, float]:
    """Errors of an estimate, widths of its 95 % intervals, and whether its 95 % regions contain the truth."""
    line, turn = whole.line_error(point, axis), whole.axis_error(axis)
    of_line, of_axis = (
        np.asarray(part) for part in (whole.covariance.position, whole.covariance.angular_axes)
    )
    return {
        "line, mm": 1e3 * float(np.linalg.norm(line)),
        "line within, mm": 1e3 * _half_width(of_line),
        "line holds": in_region(line, of_line),
        "axis, deg": float(np.degrees(np.linalg.norm(turn))),
        "axis within, deg": float(np.degrees(_half_width(of_axis))),
        "axis holds": in_region(turn, of_axis),
    }


def check_parts(name: str) -> dict[str, float]:
    """Largest differences between halves and between thirds, and whether intervals are as wide."""
    recording = rf.load_recording(DOOR_DATA / f"{name}.csv")
    whole, poses, times = _Estimate(recording, slice(None)), recording.poses, np.asarray(recording.times)
    free, kind = np.asarray(whole.found.linear.free_position), int(whole.found.linear.type_code)
    lines, axes = [], []
    for count in (2, 3):
        found = []
        for i in range(count):
            rows = slice(len(times) * i // count, len(times) * (i + 1) // count)
            part = rf.identify(poses[rows], times=times[rows], assume="hinge").candidates
            axis = np.asarray(rotation_exp(part.angular.rotvec[int(whole.found.angular.type_code)]))[:, 2]
            found.append((np.asarray(part.linear.position)[kind], axis))
        for (one, one_axis), (other, other_axis) in combinations(found, 2):
            lines.append(1e3 * float(np.linalg.norm(one - other - free @ (one - other))))
            axes.append(float(np.degrees(np.linalg.norm(np.cross(one_axis, other_axis)))))
    return {
        "lines of parts apart, mm": max(lines),
        "line interval as wide": max(lines) <= 1e3 * _half_width(whole.covariance.position),
        "axes of parts apart, deg": max(axes),
        "axis interval as wide": max(axes) <= np.degrees(_half_width(whole.covariance.angular_axes)),
    }


def check_rate(every: int) -> dict[str, float]:
    """Errors of the hinge with the measured axis, from every so many poses."""
    recording = rf.load_recording(DOOR_DATA / "hinge.csv")
    return _errors_of_whole(_Estimate(recording, slice(None, None, every)), *_MEASURED["hinge"])


def check_door(name: str) -> dict[str, float]:
    """Errors of the whole recording and its halves, and whether regions contain truth and estimates."""
    recording = rf.load_recording(DOOR_DATA / f"{name}.csv")
    axis, point = _MEASURED.get(name) or fit_axis(np.asarray(recording.poses)[:, :3, 3], circle=True)
    number = len(recording.times)
    spans = slice(None), slice(number // 2), slice(number // 2, None)
    whole, *halves = (_Estimate(recording, rows) for rows in spans)
    row = _errors_of_whole(whole, axis, point)
    lines, axes, apart_by = [], [], []
    for one, other in (halves, halves[::-1]):
        apart = one.line_error(other.point_in_ground(), other.in_ground)
        lines.append(in_region(apart, np.asarray(one.covariance.position)))
        apart_by.append(1e3 * float(np.linalg.norm(apart)))
        turn = one.axis_error(other.in_ground)
        if one.body and other.body:
            turn = np.cross(other.axis, one.axis * np.sign(one.axis @ other.axis))
        axes.append(in_region(turn, np.asarray(one.covariance.angular_axes)))
    row |= {
        "lines of halves apart, mm": max(apart_by),
        "halves hold each other's line": float(np.mean(lines)),
        "halves hold each other's axis": float(np.mean(axes)),
    }
    return row


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the benchmark."""
    new_parser("uncertainty_doors", __doc__).parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    rows = {name: check_door(name) | check_parts(name) for name in (*DOORS, *_MEASURED)}
    slower = {f"hinge, 1 of {every} poses": check_rate(every) for every in EVERY}
    for name, row in (rows | slower).items():
        print(f"{name}: {'; '.join(f'{key} {value:.2f}' for key, value in row.items())}")
    for key in next(iter(rows.values())):
        if "hold" in key or "as wide" in key:
            print(f"{key}: {np.mean([rows[name][key] for name in DOORS]):.0%} of the doors")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

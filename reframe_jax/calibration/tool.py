"""The tip of a tool from touches of one point, or its axis from turns about it: NumPy only.

Pivot calibration: a tip x that touches the point y at every pose (R, p) satisfies R x + p = y, six linear
unknowns (Yaniv, "Which pivot calibration?", SPIE Medical Imaging 2015). Spin calibration: a body that turns
about one axis keeps its direction, R a = b, and its place across it. Poses are separate measurements: their
order plays no part. Errors of a touch count as independent, and of the same size in every direction.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.calibration.robust import fit_touches, student_factor
from reframe_jax.recordings.checks import MIN_POSES, make_poses
from reframe_jax.recordings.rows import Rows

__all__ = ["Calibration", "calibrate"]

_TILTED = 0.02  # rad RMS, less than which a direction did not turn: many trackers have such errors
_TURNED = 0.1  # rad RMS that a body turns about an axis at least
_WOBBLE = 0.2  # tilt of an axis over the turn about it, beyond which it is none
_CHARTS = 5  # times that the direction of an axis is fitted, each time close to the one before


@dataclass(frozen=True, eq=False)
class Calibration:
    """The tip or the axis of a tool {b}, and where it is in the ground {g}.

    Attributes:
        tip: (3,) m, in {b}; with ``spin`` the point of the axis that is closest to the origin of {b}.
        point: (3,) m, in {g}: the point that the tip touched; with ``spin`` the mean of where ``tip`` was.
        covariance: (6, 6) m^2 of ``tip`` and ``point``; with ``spin`` of the place across
            the axis.
        residuals: (N,) m, distance of every touch from the point, outliers included; with ``spin`` across the
            axis.
        used: (N,) bool, rows that are no outliers.
        turned: rad RMS by which the body turned the direction in it that it turned least; with ``spin`` the
            direction across the axis.
        weakest: (3,) unit vector, in {b}: that direction, along which the tip is least certain.
        freedom: residuals beyond the unknowns: the degrees of freedom of Student's distribution.
        axis: (3,) unit vector, in {b}, of a spin, its largest component positive; None of a pivot.
        ground_axis: (3,) unit vector, in {g}, likewise.
        axis_covariance: (3, 3) rad^2 of ``axis``, or None.
        axis_residuals: (N,) rad, angle of every pose between both axes, or None.
    """

    tip: np.ndarray
    point: np.ndarray
    covariance: np.ndarray
    residuals: np.ndarray
    used: np.ndarray
    turned: float
    weakest: np.ndarray
    freedom: int
    axis: np.ndarray | None = None
    ground_axis: np.ndarray | None = None
    axis_covariance: np.ndarray | None = None
    axis_residuals: np.ndarray | None = None

    @property
    def outliers(self) -> np.ndarray:
        """(M,) int, rows that were left out, from 0."""
        return np.flatnonzero(~self.used)

    @property
    def rms(self) -> float:
        """Root mean square of the residuals that are used, m."""
        return float(np.sqrt(np.mean(self.residuals[self.used] ** 2)))

    @property
    def tip_interval(self) -> np.ndarray:
        """(3,) m, half the widths of the intervals that hold the components of ``tip`` with 95 %."""
        return self._interval(np.diagonal(self.covariance)[:3])

    @property
    def point_interval(self) -> np.ndarray:
        """(3,) m, the same of ``point``."""
        return self._interval(np.diagonal(self.covariance)[3:])

    @property
    def axis_interval(self) -> float | None:
        """The same of the direction of ``axis``, rad, where it is widest; None of a pivot."""
        if self.axis_covariance is None:
            return None
        return float(self._interval(np.linalg.eigvalsh(self.axis_covariance)[-1]))

    def _interval(self, variances: Any) -> Any:
        return student_factor(self.freedom) * np.sqrt(np.maximum(variances, 0))


def calibrate(poses: ArrayLike, *, spin: bool = False) -> Calibration:
    """Calibrate a tool: its tip from touches of one point, or its axis from turns about itself.

    Rows that do not fit the others are left out where there are five or more. The result does not depend on
    the order of the rows. A pose that repeats exactly, as of an arm at rest, counts once.

    Args:
        poses: (N, 4, 4) poses of the tool {b} in the ground {g}, m; N >= 4. For the tip, every pose with the
            tip at the same point, tilted in two directions or more.
        spin: whether the tool was turned about its own axis, which is found instead.

    Returns:
        The calibration, with residuals and error bars. In a recording of a continuous motion, errors of
        neighbours are alike: its error bars are too small, and :func:`reframe_jax.identify` with
        ``assume="ball"`` or ``"hinge"`` is the better choice.

    Raises:
        ValueError: if the poses are too few, not rigid, or do not determine the tip or the axis; the message
            gives the direction that is undetermined.
    """
    checked = _check(poses)
    # sorted, so that the order of the rows makes no difference
    numbers, rows = np.unique(checked.reshape(-1, 16), axis=0, return_inverse=True)
    if len(numbers) < MIN_POSES:
        raise ValueError(
            f"A calibration needs {MIN_POSES} different poses or more; there are {len(numbers)}."
        )
    found, rows = (_spin if spin else _pivot)(numbers.reshape(-1, 4, 4)), rows.ravel()
    angles = found.axis_residuals
    return replace(
        found,
        residuals=found.residuals[rows],
        used=found.used[rows],
        axis_residuals=None if angles is None else angles[rows],
    )


def _pivot(poses: np.ndarray) -> Calibration:
    turns = poses[:, :3, :3]
    _check_tilts(turns)
    fit = fit_touches(_design(turns, np.eye(3), np.eye(3)), -poses[:, :3, 3])
    turned, weakest = _check_tilts(turns[fit.used])
    return Calibration(
        tip=fit.solution[:3],
        point=fit.solution[3:],
        covariance=fit.covariance,
        residuals=np.linalg.norm(fit.residuals, axis=1),
        used=fit.used,
        turned=turned,
        weakest=weakest,
        freedom=fit.freedom,
    )


def _spin(poses: np.ndarray) -> Calibration:
    turns, places = poses[:, :3, :3], poses[:, :3, 3]
    _check_turn(turns, wobble=False)
    axis = _principal(turns)[1][:, 0]
    for _ in range(_CHARTS):
        ground = np.mean(turns @ axis, axis=0)
        ground /= np.linalg.norm(ground)
        across, beside = _across(axis), _across(ground)
        direction = fit_touches(_design(turns, across, beside), -turns @ axis @ beside)
        axis, ground = axis + across @ direction.solution[:2], ground + beside @ direction.solution[2:]
        axis, ground = axis / np.linalg.norm(axis), ground / np.linalg.norm(ground)
    kept = direction.used
    _check_turn(turns[kept], wobble=True)
    across, beside = _across(axis), _across(ground)
    design, target = _design(turns, across, beside), -places @ beside
    line = fit_touches(design[kept], target[kept])
    used = kept.copy()
    used[kept] = line.used
    tip = across @ line.solution[:2]
    point = beside @ line.solution[2:] + ground * np.mean((turns[used] @ tip + places[used]) @ ground)
    of_axis = across @ direction.covariance[:2, :2] @ across.T
    basis = np.zeros((6, 4))
    basis[:3, :2], basis[3:, 2:] = across, beside
    covariance = basis @ line.covariance @ basis.T
    covariance[:3, :3] += np.outer(axis, axis) * (tip @ of_axis @ tip)  # across the axis, wherever that is
    values, vectors = _principal(turns[used])
    sign = float(np.sign(axis[np.argmax(np.abs(axis))]))
    return Calibration(
        tip=tip,
        point=point,
        covariance=covariance,
        axis=sign * axis,
        ground_axis=sign * ground,
        axis_covariance=of_axis,
        residuals=np.linalg.norm(target - design @ line.solution, axis=1),
        axis_residuals=_angles(turns @ axis, ground),
        used=used,
        turned=float(np.sqrt(values[1])),
        weakest=vectors[:, 1],
        freedom=min(line.freedom, direction.freedom),
    )


def _principal(turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean squares (3,), rad^2, by which rotations (N, 3, 3) move directions of the body; least first.

    And the directions, as columns. Sines for angles: they count a turn of a half like one of a quarter.
    """
    apart = turns - turns.mean(axis=0)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->ij", apart, apart) / len(turns))
    return np.maximum(values, 0), vectors


def _check_tilts(turns: np.ndarray) -> tuple[float, np.ndarray]:
    """The direction that turned least, and by how much."""
    values, vectors = _principal(turns)
    sizes, weakest = np.sqrt(values), vectors[:, 0]
    if sizes[1] < _TILTED:
        raise ValueError(
            f"The rotations do not determine the tip: the poses turn by {np.degrees(sizes[2]):.2g} deg "
            "(RMS) only. Tilt the tool in two directions or more, by 20 degrees or more."
        )
    if sizes[0] < _TILTED:
        raise ValueError(
            "The rotations do not determine the tip along the direction "
            f"{_in_words(weakest)} in the body: the tool turned about this axis only, which tilted by "
            f"{np.degrees(sizes[0]):.2g} deg (RMS). Tilt the tool in another direction too; spin=True "
            "(--spin) finds the axis itself."
        )
    return float(sizes[0]), weakest


def _check_turn(turns: np.ndarray, *, wobble: bool) -> None:
    """Check that the body turned, and about one axis."""
    sizes = np.sqrt(_principal(turns)[0])
    if sizes[1] < _TURNED:
        raise ValueError(
            f"The rotations do not determine the axis: the poses turn by {np.degrees(sizes[1]):.2g} deg "
            "(RMS) only. Turn the tool about its axis by 60 degrees or more."
        )
    if wobble and sizes[0] > _WOBBLE * sizes[1]:
        raise ValueError(
            f"The poses do not turn about one axis: the best one tilts by {np.degrees(sizes[0]):.2g} deg "
            f"(RMS), while the body turns by {np.degrees(sizes[1]):.2g} deg. For touches of one point, leave "
            "out spin (--spin)."
        )


def _design(turns: np.ndarray, across: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """Design (N, k, 2k) of "the same place": R x - y, of coordinates of x and y along some directions.

    Args:
        turns: (N, 3, 3).
        across: (3, k) directions in the body.
        beside: (3, k) directions in the ground.
    """
    inside = beside.T @ turns @ across
    return np.concatenate([inside, np.broadcast_to(-np.eye(inside.shape[1]), inside.shape)], axis=2)


def _across(axis: np.ndarray) -> np.ndarray:
    """Two unit vectors perpendicular to an axis, (3, 2)."""
    basis: np.ndarray = np.linalg.svd(axis[None])[2][1:].T
    return basis


def _angles(directions: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Angles (N,) between directions (N, 3) and an axis (3,), rad."""
    return np.arctan2(np.linalg.norm(np.cross(directions, axis), axis=1), directions @ axis)


def _in_words(vector: np.ndarray) -> str:
    vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
    return "(" + ", ".join(f"{number:.3f}" for number in np.round(vector, 3) + 0.0) + ")"


def _check(poses: ArrayLike) -> np.ndarray:
    """Poses (N, 4, 4), float64, with proper rotations."""
    try:
        array = np.asarray(poses, dtype=float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"poses must be an array of numbers: {error}") from error
    if array.ndim != 3 or array.shape[1:] != (4, 4):
        raise ValueError(f"poses must have shape (N, 4, 4), not {array.shape}.")
    if len(array) < MIN_POSES:
        raise ValueError(f"A calibration needs {MIN_POSES} poses or more; there are {len(array)}.")
    rows = Rows(Path("poses"), "row", np.arange(len(array)), array.reshape(-1, 16), None)
    finite = np.isfinite(rows.values).all(axis=1)
    if not finite.all():
        raise rows.error(int(np.argmin(finite)), "is not finite: leave it out.")
    return make_poses(rows)

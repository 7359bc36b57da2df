"""The tip of a tool from touches of one point, or its axis from rotations about the axis, with NumPy only.

Pivot calibration: a tip x that touches the point y in every pose (R, p) satisfies R x + p = y, with six
linear unknowns (Yaniv, "Which pivot calibration?", SPIE Medical Imaging 2015). Spin calibration: a body that
turns about one axis keeps the direction of the axis, R a = b, and its position across the axis. Poses are
separate measurements in any order. Their errors are independent, with equal variances in all directions.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.calibration.robust import fit_touches, student_factor
from reframe_jax.geometry.numpy_rotations import positive_axis
from reframe_jax.recordings.checks import MIN_POSES, make_poses
from reframe_jax.recordings.recording import Rows

_TILTED = 0.02  # rad RMS, least rotation of a direction; tracker errors can reach it
_TURNED = 0.1  # rad RMS, least rotation about an axis
_WOBBLE = 0.2  # largest tilt of an axis, as a fraction of the rotation about it
_CHARTS = 5  # fits of the direction of an axis, each linearized at the previous one


@dataclass(frozen=True, eq=False)
class Calibration:
    """The tip or the axis of a tool {b}, and its location in the ground {g}.

    Attributes:
        tip: (3,) m, in {b}; with ``spin``, the point of the axis that is closest to the origin of {b}.
        point: (3,) m, in {g}: the touched point; with ``spin``, the mean position of ``tip``.
        covariance: (6, 6) m^2 of ``tip`` and ``point``; with ``spin``, across the axis.
        residuals: (N,) m, distance of every touch from the point, with outliers; with ``spin``, across the
            axis.
        used: (N,) bool, False for outliers.
        turned: rad RMS, rotation of the direction in the body that turned least; with ``spin``, of the
            directions across the axis.
        weakest: (3,) unit vector in {b}, the direction that turned least, along which the tip is least
            certain.
        freedom: degrees of freedom of the residuals, for Student's distribution.
        axis: (3,) unit vector in {b}, axis of a spin, with a positive largest component; None for a pivot.
        ground_axis: (3,) unit vector in {g}, the same axis.
        axis_covariance: (3, 3) rad^2 of ``axis``, or None.
        axis_residuals: (N,) rad, angle between both axes in every pose, or None.
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
        """(M,) int, indices from 0 of the rows that were left out."""
        return np.flatnonzero(~self.used)

    @property
    def rms(self) -> float:
        """Root mean square of the used residuals, m."""
        return float(np.sqrt(np.mean(self.residuals[self.used] ** 2)))

    @property
    def tip_interval(self) -> np.ndarray:
        """(3,) m, half widths of the 95 % intervals of the components of ``tip``."""
        return self._interval(np.diagonal(self.covariance)[:3])

    @property
    def point_interval(self) -> np.ndarray:
        """(3,) m, half widths of the 95 % intervals of the components of ``point``."""
        return self._interval(np.diagonal(self.covariance)[3:])

    @property
    def axis_interval(self) -> float | None:
        """Radius of the cone that contains ``axis`` with a probability of 95 %, rad; None for a pivot."""
        if self.axis_covariance is None:
            return None
        factor = self.freedom * (0.05 ** (-2 / self.freedom) - 1)  # of F's distribution with 2 coordinates
        return float(np.sqrt(factor * max(np.linalg.eigvalsh(self.axis_covariance)[-1], 0)))

    def _interval(self, variances: Any) -> Any:
        return student_factor(self.freedom) * np.sqrt(np.maximum(variances, 0))


def calibrate(poses: "ArrayLike", *, spin: bool = False) -> Calibration:
    """Calibrate a tool: its tip from touches of one point, or its axis from rotations about the axis.

    With five rows or more, outliers are left out. The order of the rows has no effect, and a pose that
    repeats exactly counts once.

    Args:
        poses: (N, 4, 4) poses of the tool {b} in the ground {g}, m; N >= 4. For the tip, all poses have the
            tip at the same point and are tilted in two directions or more.
        spin: whether the tool was turned about its own axis, to find the axis.

    Returns:
        The calibration, with residuals and error bars. In a continuous motion, consecutive errors are
        correlated and these error bars are too small: use :func:`reframe_jax.identify` with ``assume="ball"``
        or ``"hinge"``.

    Raises:
        ValueError: if the poses are too few, not rigid, or do not determine the tip or the axis.
    """
    try:
        array = np.asarray(poses, dtype=float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"poses must be an array of numbers: {error}") from error
    if array.ndim != 3 or array.shape[1:] != (4, 4):
        raise ValueError(f"poses must have shape (N, 4, 4), not {array.shape}.")
    given = Rows(Path("poses"), "row", np.arange(len(array)), array.reshape(-1, 16), None)
    finite = np.isfinite(given.values).all(axis=1)
    if not finite.all():
        raise given.error(int(np.argmin(finite)), "is not finite: leave it out.")
    # sorted, so that the order of the rows has no effect
    numbers, rows = np.unique(make_poses(given).reshape(-1, 16), axis=0, return_inverse=True)
    if len(numbers) < MIN_POSES:
        number = f"there are {len(numbers)}"
        raise ValueError(f"A calibration needs {MIN_POSES} different poses or more; {number}.")
    found, rows = (_spin if spin else _pivot)(numbers.reshape(-1, 4, 4)), rows.ravel()
    angles = None if found.axis_residuals is None else found.axis_residuals[rows]
    return replace(found, residuals=found.residuals[rows], used=found.used[rows], axis_residuals=angles)


def _pivot(poses: np.ndarray) -> Calibration:
    turns = poses[:, :3, :3]
    _check_tilts(turns)
    fit = fit_touches(_design(turns, np.eye(3), np.eye(3)), -poses[:, :3, 3])
    turned, weakest = _check_tilts(turns[fit.used])
    return Calibration(
        *(fit.solution[:3], fit.solution[3:], fit.covariance, np.linalg.norm(fit.residuals, axis=1)),
        *(fit.used, turned, weakest, fit.freedom),
    )


def _spin(poses: np.ndarray) -> Calibration:
    turns, positions = poses[:, :3, :3], poses[:, :3, 3]
    _check_rotation(turns, wobble=False)
    axis = _principal(turns)[1][:, 0]
    for _ in range(_CHARTS):
        ground = _unit(np.mean(turns @ axis, axis=0))
        across, beside = _across(axis), _across(ground)
        direction = fit_touches(_design(turns, across, beside), -turns @ axis @ beside)
        axis = _unit(axis + across @ direction.solution[:2])
        ground = _unit(ground + beside @ direction.solution[2:])
    kept = direction.used
    _check_rotation(turns[kept], wobble=True)
    across, beside = _across(axis), _across(ground)
    design, target = _design(turns, across, beside), -positions @ beside
    line = fit_touches(design[kept], target[kept])
    used = kept.copy()
    used[kept] = line.used
    tip = across @ line.solution[:2]
    point = beside @ line.solution[2:] + ground * np.mean((turns[used] @ tip + positions[used]) @ ground)
    of_axis = across @ direction.covariance[:2, :2] @ across.T
    basis = np.zeros((6, 4))
    basis[:3, :2], basis[3:, 2:] = across, beside
    covariance = basis @ line.covariance @ basis.T
    covariance[:3, :3] += np.outer(axis, axis) * (tip @ of_axis @ tip)  # because of the direction of the axis
    values, vectors = _principal(turns[used])
    sign = float(np.sign(axis[np.argmax(np.abs(axis))]))
    directions = turns @ axis
    return Calibration(
        *(tip, point, covariance, np.linalg.norm(target - design @ line.solution, axis=1), used),
        *(float(np.sqrt(values[1])), vectors[:, 1], min(line.freedom, direction.freedom)),
        axis=sign * axis,
        ground_axis=sign * ground,
        axis_covariance=of_axis,
        axis_residuals=np.arctan2(np.linalg.norm(np.cross(directions, ground), axis=1), directions @ ground),
    )


def _principal(turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean squares (3,), rad^2, of the motion of the principal directions, and these, least first."""
    apart = turns - turns.mean(axis=0)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->ij", apart, apart) / len(turns))
    return np.maximum(values, 0), vectors


def _check_tilts(turns: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the rotation of the direction that turned least, and this direction."""
    values, vectors = _principal(turns)
    sizes, weakest = np.sqrt(values), vectors[:, 0]
    if sizes[1] < _TILTED:
        raise ValueError(
            f"The rotations do not determine the tip: the tool turned by only {np.degrees(sizes[2]):.2g} deg "
            "(RMS). Tilt the tool in two directions or more, by 20 degrees or more."
        )
    if sizes[0] < _TILTED:
        axis = np.round(positive_axis(weakest), 3) + 0.0
        raise ValueError(
            f"The rotations do not determine the tip along ({axis[0]:.3f}, {axis[1]:.3f}, {axis[2]:.3f}) in "
            "the body: the tool turned only about this axis, which tilted by "
            f"{np.degrees(sizes[0]):.2g} deg (RMS). Tilt the tool in another direction too; spin=True "
            "(--spin) finds the axis itself."
        )
    return float(sizes[0]), weakest


def _check_rotation(turns: np.ndarray, *, wobble: bool) -> None:
    """Check that the body turned, about one axis."""
    sizes = np.sqrt(_principal(turns)[0])
    if sizes[1] < _TURNED:
        raise ValueError(
            "The rotations do not determine the axis: the tool turned by only "
            f"{np.degrees(sizes[1]):.2g} deg (RMS). Turn the tool about its axis by 60 degrees or more."
        )
    if wobble and sizes[0] > _WOBBLE * sizes[1]:
        raise ValueError(
            f"The poses do not turn about one axis: the best axis tilts by {np.degrees(sizes[0]):.2g} deg "
            f"(RMS), while the body turns by {np.degrees(sizes[1]):.2g} deg. For touches of one point, leave "
            "out spin (--spin)."
        )


def _design(turns: np.ndarray, across: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """Design (N, k, 2k) of R x - y, for coordinates along directions (3, k) in the body and in the ground."""
    inside = beside.T @ turns @ across
    return np.concatenate([inside, np.broadcast_to(-np.eye(inside.shape[1]), inside.shape)], axis=2)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def _across(axis: np.ndarray) -> np.ndarray:
    """Two unit vectors perpendicular to an axis, (3, 2)."""
    return np.linalg.svd(axis[None])[2][1:].T

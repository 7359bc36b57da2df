"""Other estimators of hinges, slides and frames from noisy poses, and the scores of all estimators.

Some estimators fit a line in the ground, for suitable constraints only: a circle or a line through the
positions, the algebraic pivot (least squares of R p + t = c over all poses, as in SARA and SCoRE), and the
mean screw axis over pairs of poses half a window apart. Other estimators fit frames, for all twelve
constraints: ``identify``, ``identify`` with ``scales=1``, and SciPy's dual annealing on the paper's
objective.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import reframe_jax as rf
from benchmarks.bounds import Bound
from benchmarks.determined import Determination
from benchmarks.dual_annealing import rotation_matrix, sampled_velocities, solve
from reframe_jax.geometry.rotations import rotation_log
from reframe_jax.simulation import metrics

__all__ = ["LINE_FITS", "QUANTITIES", "Line", "Scores", "Windows", "anneal", "line_scores", "scores"]

QUANTITIES = ("angular", "linear", "position")
_CONFIDENT = 0.9  # probability from which a name counts as confident
_THRESHOLDS = rf.Thresholds()


@dataclass(frozen=True)
class Windows:
    """Windows of one constraint.

    Attributes:
        label: label of the constraint.
        frame: true geometry, arrays (N, ...).
        poses, exact: (N, K+1, 4, 4) m, measured and true poses.
        dt: s.
        bound: Cramér-Rao bounds of every window.
        determination: whether the motion determines the constraint.
    """

    label: str
    frame: rf.ConstraintFrame
    poses: np.ndarray
    exact: np.ndarray
    dt: float
    bound: Bound
    determination: Determination

    def __getitem__(self, rows: Any) -> "Windows":
        """Select windows."""
        parts = self.frame, self.bound, self.determination
        frame, bound, determination = jax.tree.map(lambda leaf: leaf[rows], parts)
        return Windows(self.label, frame, self.poses[rows], self.exact[rows], self.dt, bound, determination)


@dataclass(frozen=True)
class Scores:
    """Scores of one method in every window.

    Attributes:
        errors: (N,) errors of each of ``QUANTITIES``, in rad, rad and m; NaN without an estimate or a truth.
        bounds: (N,) Cramér-Rao bounds of the same quantities.
        right: (N,) 0 or 1 for correct "types", "dof" and "name", and for "confident_wrong": a wrong name with
            a probability of 0.9 or more. NaN if the motion does not determine the constraint. "determined":
            whether the motion determines the degrees of freedom. Empty for methods without a classification.
    """

    errors: dict[str, np.ndarray]
    bounds: dict[str, np.ndarray]
    right: dict[str, np.ndarray]


@dataclass(frozen=True)
class Line:
    """Lines in the ground: directions (N, 3), and a point on each, (N, 3) m; NaN if a fit has no result."""

    direction: np.ndarray
    point: np.ndarray


def scores(found: rf.Identification, windows: Windows) -> Scores:
    """Scores of frames: the winners if every type is correct (A to D), else the frames of the true types."""
    frame, start = windows.frame, jnp.asarray(windows.exact[:, 0])
    entry = rf.CONSTRAINTS[windows.label]
    kinds = list(rf.LinearType) if entry.linear_type is None else [entry.linear_type]
    by_type = [metrics.geometry_errors(found, _express_in_type(windows, kind), start=start) for kind in kinds]
    bodies = [int(kind.orientation_body) for kind in kinds]
    linear = _choose(np.asarray(found.linear.type_code), [int(kind) for kind in kinds])
    angular = _choose(np.asarray(found.angular.type_code), bodies)
    rows = np.arange(len(start))

    def pick(name: str, index: np.ndarray) -> np.ndarray:
        chosen: np.ndarray = np.stack([np.asarray(getattr(e, name)) for e in by_type])[index, rows]
        return chosen

    types, body = np.array([int(kind) for kind in kinds])[linear], np.array(bodies)[angular]
    bound = jax.tree.map(np.asarray, windows.bound)
    determination, right = windows.determination, np.asarray(found.name == entry.name)
    said = {
        "types": np.asarray(metrics.types_correct(found, frame, ties=True)),
        "dof": np.asarray(metrics.dof_correct(found, frame)),
        "name": right,
        "confident_wrong": ~right & (np.asarray(found.probability) >= _CONFIDENT),
    }
    return Scores(
        {
            "angular": pick("angular", angular),
            "linear": pick("linear", linear),
            "position": pick("position", linear),
        },
        {
            "angular": bound.angular[rows, body],
            "linear": bound.linear[rows, types],
            "position": bound.position[rows, types],
        },
        {
            name: np.where(determination.name if name == "name" else determination.dof, values, np.nan)
            for name, values in said.items()
        }
        | {"determined": determination.dof},
    )


def _choose(codes: np.ndarray, known: list[int]) -> np.ndarray:
    """Index of every code in a list of known codes; 0 for unknown codes."""
    return np.argmax(codes[:, None] == np.array(known)[None], axis=1)


def _express_in_type(windows: Windows, kind: rf.LinearType) -> rf.ConstraintFrame:
    """Express the true constraint in another type, with equal axes and origin at the start."""
    start = jnp.asarray(windows.exact[:, 0])
    turn, back = start[:, :3, :3], jnp.linalg.inv(start)
    axes, position = windows.frame.linear_axes, windows.frame.position
    old = windows.frame.linear_type
    if old.orientation_body != kind.orientation_body:
        axes = (turn if kind.orientation_body == rf.AngularType.G else turn.mT) @ axes
    if old.position_body != kind.position_body:
        move = start if kind.position_body == rf.AngularType.G else back
        position = (move[:, :3, :3] @ position[:, :, None])[..., 0] + move[:, :3, 3]
    return rf.ConstraintFrame.named(
        windows.label, linear_type=kind, rotvec=rotation_log(axes), position=position
    )


def anneal(found: rf.Identification, windows: Windows) -> tuple[rf.Identification, float]:
    """Run dual annealing with the settings of the paper: its result as an identification, and the time in s.

    Args:
        found: result of ``identify`` for the same windows; all scored fields are replaced.
        windows: a few windows, because each takes about a second.
    """
    centre = windows.poses[:, :, :3, 3].mean(axis=1)
    rows, total = [], 0.0
    for i, poses in enumerate(windows.poses):
        poses = np.array(poses)
        poses[:, :3, 3] -= centre[i]  # the ground's origin is the centre of the search bounds
        results, seconds = solve(poses, seed=i, dt=windows.dt)
        total += seconds
        rates, maps = (np.asarray(v) for v in sampled_velocities(jnp.asarray(poses), windows.dt))
        samples = [
            *rates,
            *(m[..., 0] + m[..., 1:] @ r.x[3:] for m, r in zip(maps, results[2:], strict=True)),
        ]
        axes, rms = zip(
            *(_sorted_axes(s, r.x[:3]) for s, r in zip(samples, results, strict=True)), strict=True
        )
        in_ground = np.array([kind.position_body == rf.AngularType.G for kind in rf.LinearType])
        origin = np.stack([r.x[3:] for r in results[2:]]) + np.where(in_ground[:, None], centre[i], 0)
        rows.append((np.stack(axes), np.stack(rms), np.array([r.fun for r in results]), origin))
    axes, rms, norms, origins = (jnp.asarray(np.stack(part)) for part in zip(*rows, strict=True))
    optima = rotation_log(axes), rms, norms
    turning, moving = ([leaf[:, types] for leaf in optima] for types in (slice(0, 2), slice(2, 6)))
    limit = _THRESHOLDS
    angular, of_angular = _replaced(found.angular, found.candidates.angular, turning, limit.angular)
    linear, of_linear = _replaced(found.linear, found.candidates.linear, moving, limit.linear)
    # both angular types express the same constraint unless two axes are free
    angular = replace(angular, tied=angular.tied | (jnp.sum(angular.dof, axis=-1) != 2)[:, None])
    of_linear = replace(of_linear, position=origins)
    every = replace(found.candidates, angular=of_angular, linear=of_linear)
    return replace(found, angular=angular, linear=linear, candidates=every), total


def _sorted_axes(samples: np.ndarray, rotvec: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Axes as columns and RMS velocities along them, ascending, of velocities (K, 3) and a frame."""
    axes = rotation_matrix(rotvec)
    rms = np.sqrt(np.mean((samples @ axes) ** 2, axis=0))
    order = np.argsort(rms)
    axes = axes[:, order]
    return axes * np.array([1, 1, np.sign(np.linalg.det(axes))]), rms[order]


def _replaced(
    part: Any, candidates: Any, optima: list[jax.Array], threshold: float | jax.Array
) -> tuple[Any, Any]:
    """Replace the optima of a frame and its candidates: rotation vectors, RMS and norms of every type."""
    rotvec, rms, norms = optima
    winner, rows = jnp.argmin(norms, axis=1), jnp.arange(len(norms))
    dof = (rms > threshold).astype(jnp.int32)
    tied = jnp.arange(norms.shape[1])[None] == winner[:, None]
    part = replace(part, type_code=winner, rotvec=rotvec[rows, winner], dof=dof[rows, winner], tied=tied)
    return part, replace(candidates, rotvec=rotvec, rms=rms, dof=dof, norm=norms)


def line_scores(line: Line, windows: Windows) -> Scores:
    """Scores of lines: errors relative to the axis of A or C, or the direction of B."""
    entry = rf.CONSTRAINTS[windows.label]
    truth = _express_in_type(windows, rf.LinearType.GG)
    axes, origin = np.asarray(truth.linear_axes), np.asarray(truth.position)
    axis = entry.angular_axis if entry.angular_axis is not None else entry.linear_axis
    true = axes[:, :, axis]
    sine = np.linalg.norm(np.cross(line.direction, true), axis=-1)
    angle = np.arctan2(sine, np.abs(np.sum(line.direction * true, axis=-1)))
    offset = ((line.point - origin)[:, None] @ axes)[:, 0] * np.array(entry.position)
    nothing = np.full(len(angle), np.nan)
    bound = jax.tree.map(np.asarray, windows.bound)
    kind = int(rf.LinearType.GG)
    return Scores(
        {
            "angular": angle if entry.angular_axis is not None else nothing,
            "linear": angle if entry.linear_axis is not None else nothing,
            "position": np.linalg.norm(offset, axis=-1) if any(entry.position) else nothing,
        },
        {
            "angular": bound.angular[:, int(rf.AngularType.G)],
            "linear": bound.linear[:, kind],
            "position": bound.position[:, kind],
        },
        {},
    )


def circle_fit(poses: np.ndarray) -> Line:
    """Axis of the circle through the positions: the least-squares plane, and Kåsa's circle in this plane."""
    mean = poses[:, :, :3, 3].mean(axis=1)
    points = poses[:, :, :3, 3] - mean[:, None]
    _, basis = np.linalg.eigh(points.mT @ points)
    flat = points @ basis[:, :, 1:]
    design = np.concatenate([2 * flat, np.ones((*flat.shape[:2], 1))], axis=-1)
    squares = np.sum(flat**2, axis=-1)[..., None]
    centre = (np.linalg.pinv(design) @ squares)[:, :2]
    return Line(basis[:, :, 0], mean + (basis[:, :, 1:] @ centre)[..., 0])


def line_fit(poses: np.ndarray) -> Line:
    """Least-squares line through the positions."""
    mean = poses[:, :, :3, 3].mean(axis=1)
    points = poses[:, :, :3, 3] - mean[:, None]
    return Line(np.linalg.eigh(points.mT @ points)[1][:, :, 2], mean)


def pivot_fit(poses: np.ndarray) -> Line:
    """Least squares of R p + t = c over all poses; the axis is the direction that does not determine p."""
    turn, shift = poses[..., :3, :3].mean(axis=1), poses[..., :3, 3].mean(axis=1)
    turns, shifts = poses[..., :3, :3] - turn[:, None], poses[..., :3, 3] - shift[:, None]
    normal = np.einsum("nkij,nkil->njl", turns, turns)
    strengths, basis = np.linalg.eigh(normal)
    right = -np.einsum("nkij,nki->nj", turns, shifts)
    # the point on the axis nearest to the body's origin
    inverse = np.where(np.arange(3) == 0, 0, 1 / strengths)
    point = np.einsum("nij,nj,nkj,nk->ni", basis, inverse, basis, right)
    axis = np.einsum("nij,nj->ni", turn, basis[:, :, 0])
    pivot = np.einsum("nij,nj->ni", turn, point) + shift
    return Line(axis / np.linalg.norm(axis, axis=-1, keepdims=True), pivot)


def screw_fit(poses: np.ndarray) -> Line:
    """Mean screw axis of the displacements over half a window, weighted by the rotation angle."""
    half = poses.shape[1] // 2
    turn = poses[:, half:, :3, :3] @ poses[:, :-half, :3, :3].mT
    middle = poses[:, :, :3, 3].mean(axis=1)
    first, last = poses[:, :-half, :3, 3] - middle[:, None], poses[:, half:, :3, 3] - middle[:, None]
    shift = last - np.einsum("nkij,nkj->nki", turn, first)
    skew = np.stack(
        [turn[..., i, j] - turn[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=-1
    )  # 2 sin(angle) times the axis
    direction = np.linalg.eigh(skew.mT @ skew)[1][:, :, 2]
    across = np.eye(3) - direction[:, :, None] * direction[:, None]
    design = np.eye(3) - turn
    normal = across @ np.einsum("nkij,nkil->njl", design, design) @ across
    right = across @ np.einsum("nkij,nki->nj", design, shift @ across)[..., None]
    return Line(direction, middle + (np.linalg.pinv(normal, rcond=1e-9) @ right)[..., 0])


LINE_FITS: dict[str, tuple[str, Callable[[np.ndarray], Line]]] = {
    "circle fit": ("A", circle_fit),
    "line fit": ("B", line_fit),
    "pivot": ("A", pivot_fit),
    "mean screw": ("AC", screw_fit),
}
"""Fits by name: suitable constraints, and the fit as a function of poses (N, K+1, 4, 4)."""

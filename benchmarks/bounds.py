"""Cramér-Rao bounds of the geometry of all twelve constraints under white noise.

The unknowns are a frame X in the ground, a frame Y in the body, and all true poses. The measurements are the
poses T_k with Gaussian noise of known covariance S. A constraint is an equation c(X, Y, T_k) = 0. Let C and J
be the derivatives of c with respect to the frames and the poses. After elimination of the poses, the
information about the frames is

    F = C' (J S J')^-1 C,

which is a sum over samples if every equation contains one pose. Such equations are:

- rotation: X' R Y does not change the single free axis (A, C to F, I, J), or is the identity (B);
- A to D, I, K: a point of the body stays on a line, on a plane, or at a point of the ground;
- J, L: a point of the ground stays on a line or plane of the body.

Contour following and rolling (E to H) constrain a velocity, which no equation in one pose expresses. Their
equations contain two consecutive poses: the chord of the point has no component along the constrained mean
axis of the step. J S J' is then the full banded covariance, in blocks. The bound assumes nothing about the
motion between samples.

Directions in which the frames can move without violating the constraint have no information. A quantity that
depends on such a direction has an infinite bound.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from reframe_jax.constraints.catalogue import lookup
from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.types import ORIENTATION_BODIES, POSITION_BODIES, AngularType, LinearType
from reframe_jax.geometry.rotations import hat, rotation_exp

__all__ = ["Bound", "cramer_rao"]

_ROWS = 6  # equations per sample: three for rotation, three for translation; unused equations are zero
_UNDETERMINED = (
    1e-11  # fraction of the largest eigenvalue of the information, below which there is no information
)
_DEPENDS = (
    1e-6  # squared fraction of a quantity in directions without information, above which it is undetermined
)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Bound:
    """Lower bounds on the RMS errors of unbiased estimates, for the quantities of :mod:`metrics`.

    NaN if the constraint does not determine the quantity, infinite if the motion does not.

    Attributes:
        angular: (..., 2) rad, for the determined axis of the angular frame, by ``AngularType``.
        linear: (..., 4) rad, for the determined axis of the linear frame, by ``LinearType``.
        position: (..., 4) m, for the determined components of the position, at the point nearest to the
            centre of the motion, by ``LinearType``.
    """

    angular: jax.Array
    linear: jax.Array
    position: jax.Array


@dataclass(frozen=True)
class _Class:
    """Equations and determined components of a constraint, as arrays for one compiled program.

    Attributes:
        angular: (3, 9) coefficients of the entries of X' R Y, row by row.
        linear: (3, 12) coefficients of the four displacements of :func:`_equations`.
        angular_odd, linear_odd: (3,) 1 for the axes towards which the determined axis can tilt.
        kept: (3,) 1 for the determined components of the position.
    """

    angular: np.ndarray
    linear: np.ndarray
    angular_odd: np.ndarray
    linear_odd: np.ndarray
    kept: np.ndarray


def cramer_rao(
    frame: ConstraintFrame, poses: jax.Array, sigma: ArrayLike, rotation_ratio: ArrayLike
) -> Bound:
    """Compute the bounds for windows of one constraint, in float64 only.

    Args:
        frame: the true constraint, one of the twelve with the axes of :meth:`ConstraintFrame.named`; its
            arrays have the batch axis of the poses.
        poses: (N, K+1, 4, 4) true poses, m.
        sigma: (N,) or a number, m, standard deviation of every component of the position.
        rotation_ratio: (N,) or a number, rad/m, ratio of the standard deviation of every component of the
            rotation to ``sigma``.

    Returns:
        Bounds, (N, ...).

    Raises:
        ValueError: if the frame is not one of the twelve, or its angular and linear axes are fixed in
            different bodies.
        TypeError: for poses in float32.
    """
    if poses.dtype != jnp.float64:
        raise TypeError(f"bounds need float64 poses, not {poses.dtype}.")
    kind = _class_of(frame)
    bodies = np.array(
        [
            frame.linear_type.orientation_body == AngularType.G,
            frame.linear_type.position_body == AngularType.G,
        ]
    )
    count = len(poses)
    sigma, ratio = (jnp.broadcast_to(jnp.asarray(x, float), (count,)) for x in (sigma, rotation_ratio))
    axes = jnp.broadcast_to(frame.linear_axes, (count, 3, 3))
    position = jnp.broadcast_to(frame.position, (count, 3))
    parts = (kind.angular, kind.linear, kind.angular_odd, kind.linear_odd, kind.kept)
    angular, linear, moved = _bounds(
        *(jnp.asarray(part) for part in parts), bodies, axes, position, poses, ratio
    )
    scale = sigma[:, None]
    return Bound(scale * angular, scale * linear[:, ORIENTATION_BODIES], scale * moved[:, POSITION_BODIES])


def _class_of(frame: ConstraintFrame) -> _Class:
    entry = lookup(frame.linear_type, frame.angular_dof, frame.linear_dof)
    if entry is None or (entry.angular_dof, entry.linear_dof) != (frame.angular_dof, frame.linear_dof):
        raise ValueError(
            "bounds are known for the twelve constraints of the catalogue, in their order of axes."
        )
    if frame.angular_type != frame.linear_type.orientation_body:
        raise ValueError("both parts of the frame must be oriented in the same body.")
    angular = np.zeros((3, 3, 3))  # equation, row and column of X' R Y
    free = [i for i in range(3) if entry.angular_dof[i]]
    pairs = [(1, 0), (2, 1), (0, 2)] if not free else [(i, free[0]) for i in range(3) if i != free[0]]
    for equation, (row, column) in enumerate(pairs if len(free) < 2 else []):
        angular[equation, row, column] = 1
    # the displacement that is zero, by type; A to D, which have all types, use GB
    linear = np.zeros((3, 4, 3))
    linear[:, int(LinearType.GB if entry.linear_type is None else entry.linear_type)] = np.diag(
        1.0 - np.array(entry.linear_dof)
    )

    def others(odd: int | None) -> np.ndarray:
        return np.zeros(3) if odd is None else 1.0 - np.eye(3)[odd]

    return _Class(
        angular.reshape(3, 9),
        linear.reshape(3, 12),
        others(entry.angular_axis),
        others(entry.linear_axis),
        np.array(entry.position, dtype=float),
    )


@jax.jit
@partial(jax.vmap, in_axes=(*[None] * 6, 0, 0, 0, 0))
def _bounds(
    angular: jax.Array,
    linear: jax.Array,
    angular_odd: jax.Array,
    linear_odd: jax.Array,
    kept: jax.Array,
    in_ground: jax.Array,
    axes: jax.Array,
    position: jax.Array,
    poses: jax.Array,
    ratio: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Bounds (2,) by body for both axes and the position, for a sigma of 1 m."""
    turn, shift = poses[0, :3, :3], poses[0, :3, 3]
    # both frames agree at the start
    in_x = jnp.where(in_ground[0], axes, turn @ axes)
    x_at = jnp.where(in_ground[1], position, turn @ position + shift)
    in_y, y_at = turn.T @ in_x, turn.T @ (x_at - shift)
    information = _information(angular, linear, (in_x, x_at, in_y, y_at), poses, ratio)
    values, vectors = jnp.linalg.eigh(information)
    known = values > _UNDETERMINED * values[-1]
    spread = jnp.where(known, 1 / jnp.where(known, values, 1), 0)

    def rms(rows: jax.Array, wanted: jax.Array) -> jax.Array:
        """RMS bound of linear functions (3, 12) of the frames, over the selected functions."""
        shares = jnp.square((rows * wanted[:, None]) @ vectors)
        bound = jnp.sqrt(jnp.sum(shares * spread[None]))
        undetermined = jnp.sum(jnp.where(known[None], 0, shares)) > _DEPENDS
        bound = jnp.where(undetermined, jnp.inf, bound)
        return jnp.where(jnp.any(wanted > 0), bound, jnp.nan)

    centre = jnp.mean(poses[:, :3, 3], axis=0)
    eye, results = jnp.eye(12), []
    for start, own, at, middle in ((0, in_x, x_at, centre), (6, in_y, y_at, jnp.zeros(3))):
        tilt, move = eye[start : start + 3], eye[start + 3 : start + 6]
        away = (1 - kept) * (own.T @ (middle - at))  # to the point nearest to the centre
        results.append([rms(tilt, angular_odd), rms(tilt, linear_odd), rms(move - hat(away) @ tilt, kept)])
    by_quantity = [jnp.stack(pair) for pair in zip(*results, strict=True)]
    return by_quantity[0], by_quantity[1], by_quantity[2]


_Frames = tuple[jax.Array, jax.Array, jax.Array, jax.Array]
"""Axes and origin of X in the ground, of Y in the body."""


def _equations(
    selections: tuple[jax.Array, jax.Array],
    frames: _Frames,
    before: jax.Array,
    here: jax.Array,
    change: jax.Array,
) -> jax.Array:
    """Residuals (6,) of the constraint at a sample, for changes (24,) of the frames and two poses."""
    in_x, x_at, in_y, y_at = frames
    xw, xv, yw, yv, *noise = jnp.split(change, 8)
    x_axes, y_axes = in_x @ rotation_exp(xw), in_y @ rotation_exp(yw)
    x_at, y_at = x_at + in_x @ xv, y_at + in_y @ yv
    first, last = rotation_exp(noise[0]) @ before[:3, :3], rotation_exp(noise[2]) @ here[:3, :3]
    p, q = before[:3, 3] + noise[1], here[:3, 3] + noise[3]
    middle = (first + last) / 2
    in_body = last.T @ (x_at - q)
    chords = {
        LinearType.BB: y_axes.T @ middle.T @ (q - p + (last - first) @ y_at),
        LinearType.GB: x_axes.T @ (q + last @ y_at - x_at),
        LinearType.GG: x_axes.T @ middle @ (first.T @ (x_at - p) - in_body),
        LinearType.BG: y_axes.T @ (in_body - y_at),
    }
    displacements = jnp.concatenate([chords[kind] for kind in LinearType])
    turned = (x_axes.T @ last @ y_axes).reshape(9)
    return jnp.concatenate([selections[0] @ turned, selections[1] @ displacements])


def _information(
    angular: jax.Array, linear: jax.Array, frames: _Frames, poses: jax.Array, ratio: jax.Array
) -> jax.Array:
    """Information about the frames (12, 12) after elimination of all poses in order."""
    before = jnp.concatenate([poses[:1], poses[:-1]])
    derivative = jax.jacfwd(partial(_equations, (angular, linear), frames), argnums=2)
    both = jax.vmap(derivative, in_axes=(0, 0, None))(before, poses, jnp.zeros(24))
    holds = jnp.concatenate([jnp.any(angular != 0, axis=1), jnp.any(linear != 0, axis=1)])
    # the first sample has no previous pose
    of_pairs = jnp.any(linear.reshape(3, 4, 3)[:, np.array([LinearType.BB, LinearType.GG])] != 0, axis=(1, 2))
    of_pairs = jnp.concatenate([jnp.zeros(3, dtype=bool), of_pairs])
    here = jnp.tile(holds[None], (len(poses), 1)).at[0].set(holds & ~of_pairs)
    both = jnp.where(here[:, :, None], both, 0)
    by_frames, by_before, by_here = both[:, :, :12], both[:, :, 12:18], both[:, :, 18:]
    variances = jnp.concatenate([jnp.full(3, ratio) ** 2, jnp.ones(3)])[None, None]
    own = (by_here * variances) @ by_here.mT + (by_before * variances) @ by_before.mT
    own = own + jnp.where(here[:, :, None], 0, jnp.eye(_ROWS)[None])
    earlier = jnp.concatenate([jnp.zeros_like(by_here[:1]), by_here[:-1]])
    coupling = (by_before * variances) @ earlier.mT

    def eliminate(
        last: tuple[jax.Array, jax.Array, jax.Array], sample: tuple[jax.Array, jax.Array, jax.Array]
    ) -> tuple[tuple[jax.Array, jax.Array, jax.Array], None]:
        covariance, rest, information = last
        own, coupling, new = sample
        weighted = jnp.linalg.solve(covariance, jnp.concatenate([coupling.T, rest], axis=1))
        covariance = own - coupling @ weighted[:, :_ROWS]
        rest = new - coupling @ weighted[:, _ROWS:]
        return (covariance, rest, information + rest.T @ jnp.linalg.solve(covariance, rest)), None

    start = jnp.eye(_ROWS), jnp.zeros((_ROWS, 12)), jnp.zeros((12, 12))
    (_, _, information), _ = jax.lax.scan(eliminate, start, (own, coupling, by_frames))
    return (information + information.T) / 2

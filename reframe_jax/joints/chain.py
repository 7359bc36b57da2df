"""Chains of hinges, slides and balls, in NumPy: poses from coordinates, and coordinates from poses.

With all coordinates at zero the child is at its home pose. Each part then moves everything after it:
T(q) = M_1(q_1) M_2(q_2) ... T_home, a product of exponentials.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Literal

import numpy as np

from reframe_jax.geometry.numpy_rotations import rotation_matrices, rotation_vectors, skew_vectors

PartKind = Literal["hinge", "slide", "ball"]

_STEPS = 6  # largest number of Gauss-Newton steps; the initial guess has exact rotations
_CONVERGED = 1e-9  # rad or m, step size below which the iteration stops
_DAMPING = 1e-12  # added to the diagonal of the normal equations, which are singular at gimbal lock
_CHUNK = 16384  # poses per chunk; limits the memory
_SMALL = 1e-6  # rad or m, step of the finite differences
_LOCKED = np.radians(80.0)  # largest angle of the second of three hinges; at 90 degrees two axes coincide


@dataclass(frozen=True, eq=False)
class JointPart:
    """One part of a joint: a hinge, a slide or a ball.

    Attributes:
        kind: "hinge" and "slide" have one coordinate (rad, m), "ball" has three (a rotation vector, rad).
        axis: (3,) unit vector in the parent, at zero coordinates; zeros for a ball.
        point: (3,) m in the parent, at zero coordinates: a point on the axis of a hinge, or the centre of a
            ball. Unused for a slide.
        low, high: recorded range, rad or m; for a ball 0 and the largest angle from zero.
        hinges: three hinges that can replace a ball, with their recorded ranges; empty if they come near
            gimbal lock, and for hinges and slides.
        pitch: m/rad, translation of a screw along its axis per radian of rotation, positive for a
            right-handed thread; 0 for parts that are not screws.
    """

    kind: PartKind
    axis: np.ndarray
    point: np.ndarray
    low: float = 0.0
    high: float = 0.0
    hinges: "tuple[JointPart, ...]" = ()
    pitch: float = 0.0

    @property
    def width(self) -> int:
        """Number of coordinates."""
        return 3 if self.kind == "ball" else 1


def split_coordinates(parts: Sequence[JointPart], coordinates: np.ndarray) -> list[np.ndarray]:
    """Return views of the coordinates (..., n) of a chain, one (..., width) for every part."""
    return np.split(coordinates, np.cumsum([part.width for part in parts], dtype=int), axis=-1)[:-1]


def chain_poses(parts: Sequence[JointPart], home: np.ndarray, coordinates: np.ndarray) -> np.ndarray:
    """Compute poses (..., 4, 4), m, of the child in the parent from coordinates (..., n), rad and m."""
    pose = np.broadcast_to(np.eye(4), (*coordinates.shape[:-1], 4, 4))
    for part, values in zip(parts, split_coordinates(parts, coordinates), strict=True):
        moved = np.tile(np.eye(4), (*values.shape[:-1], 1, 1))
        if part.kind == "slide":
            moved[..., :3, 3] = values * part.axis
        else:
            turn = rotation_matrices(values if part.kind == "ball" else values * part.axis)
            moved[..., :3, :3] = turn
            moved[..., :3, 3] = part.point - turn @ part.point + part.pitch * values * part.axis
        pose = pose @ moved
    return pose @ home


def chain_coordinates(
    parts: Sequence[JointPart], home: np.ndarray, poses: np.ndarray, length: float
) -> np.ndarray:
    """Compute the coordinates (K, n) at which a chain is nearest to poses (K, 4, 4), with unwrapped angles.

    The chain has at most one ball. A position error of ``length`` has the weight of an orientation error of
    1 rad.
    """
    chunks = (poses[first : first + _CHUNK] for first in range(0, len(poses), _CHUNK))
    found = np.concatenate([_nearest(parts, home, chunk, length) for chunk in chunks])
    for part, values in zip(parts, split_coordinates(parts, found), strict=True):
        if part.kind == "hinge":
            values[:] = np.unwrap(values, axis=0)
    return found


def _nearest(parts: Sequence[JointPart], home: np.ndarray, poses: np.ndarray, length: float) -> np.ndarray:
    """Compute the coordinates of a chunk of poses with the Gauss-Newton method."""

    def residuals(coordinates: np.ndarray) -> np.ndarray:
        """Residuals (K, 6), m: three orientation errors times ``length``, three position errors."""
        model = chain_poses(parts, home, coordinates)
        turn = poses[:, :3, :3].swapaxes(-1, -2) @ model[:, :3, :3]
        return np.concatenate([length / 2 * skew_vectors(turn), model[:, :3, 3] - poses[:, :3, 3]], axis=-1)

    found = _first_guess(parts, home, poses)
    number = found.shape[-1]
    for _ in range(_STEPS if number else 0):
        columns = [residuals(found + step) - residuals(found - step) for step in _SMALL * np.eye(number)]
        jacobian = np.stack(columns, axis=-1) / (2 * _SMALL)
        transposed = jacobian.swapaxes(-1, -2)
        square = transposed @ jacobian
        square += _DAMPING * np.trace(square, axis1=1, axis2=2)[:, None, None] * np.eye(number)
        change = np.linalg.solve(square, transposed @ residuals(found)[..., None])[..., 0]
        found = found - change
        if np.abs(change).max() < _CONVERGED:
            break
    return found


def _first_guess(parts: Sequence[JointPart], home: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Initial coordinates: hinge and ball angles from the orientations, part by part; slides at zero."""
    turned = poses[:, :3, :3] @ home[:3, :3].T
    hinges = [part for part in parts if part.kind == "hinge"]
    found = []
    for part in parts:
        if part.kind == "slide":
            found.append(np.zeros((len(poses), 1)))
        elif part.kind == "ball":
            found.append(rotation_vectors(turned))
        else:
            later = hinges[hinges.index(part) + 1 :]
            angle = _angle_about(part.axis, turned, later[-1].axis if later else None)
            turned = rotation_matrices(-angle[:, None] * part.axis) @ turned
            if part.pitch:  # add the full turns with which a screw agrees with the positions
                angle = np.unwrap(angle)
                missing = np.median((poses[:, :3, 3] - home[:3, 3]) @ part.axis / part.pitch - angle)
                angle += 2 * np.pi * np.round(missing / (2 * np.pi))
            found.append(angle[:, None])
    return np.concatenate(found, axis=-1) if found else np.zeros((len(poses), 0))


def _angle_about(axis: np.ndarray, turned: np.ndarray, later: np.ndarray | None) -> np.ndarray:
    """Angles (K,) about the axis of a hinge, from rotations (K, 3, 3) of this hinge and all later hinges.

    ``later`` is the axis of the last hinge of the chain, or None if this hinge is the last one. A hinge
    between the two is perpendicular to both.
    """
    if later is not None:
        seen = turned @ later
        return np.arctan2(seen @ np.cross(axis, later), seen @ later - (seen @ axis) * (axis @ later))
    along = np.einsum("i,kij,j->k", axis, turned, axis)
    return np.arctan2(skew_vectors(turned) @ axis, np.trace(turned, axis1=1, axis2=2) - along)


def ball_hinges(point: np.ndarray, vectors: np.ndarray) -> tuple[JointPart, ...]:
    """Return three hinges that reproduce the rotation vectors (K, 3), rad, of a ball joint.

    The axes are perpendicular where all angles are zero. They are the principal axes of the recorded rotation
    vectors, in the order that keeps the second hinge farthest from gimbal lock. If the second hinge comes
    near gimbal lock, the result is empty.
    """
    turns = rotation_matrices(vectors)
    bases = np.array([*permutations(np.linalg.eigh(vectors.T @ vectors)[1].T)])
    bases[:, 2] = np.cross(bases[:, 0], bases[:, 1])
    # angle of the second hinge: the third axis leaves the plane normal to the first by this angle
    leaning = [np.abs(turns @ basis[2] @ basis[0]).max() for basis in bases]
    best = int(np.argmin(leaning))
    if leaning[best] > np.sin(_LOCKED):
        return ()
    basis = bases[best]
    turned = basis @ turns @ basis.T
    angles = (
        np.arctan2(-turned[:, 1, 2], turned[:, 2, 2]),
        np.arcsin(np.clip(turned[:, 0, 2], -1, 1)),
        np.arctan2(-turned[:, 0, 1], turned[:, 0, 0]),
    )
    return tuple(
        JointPart("hinge", axis, point, float(seen.min()), float(seen.max()))
        for axis, seen in zip(basis, map(np.unwrap, angles), strict=True)
    )

"""Simulated recordings of a few constraints in NumPy, with their truth; nothing is compiled for them."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

DT, POSES = 0.08, 64


class Contact(NamedTuple):
    """A recording and its truth.

    Attributes:
        poses: (POSES, 4, 4) m.
        ground_axis, body_axis: axis of the contact frame in {g} and in {b}: of a hinge, of a slide, or the
            normal of the plane.
        ground_point, body_point: m, origin of the contact frame in {g} and in {b}.
    """

    poses: np.ndarray
    ground_axis: np.ndarray
    body_axis: np.ndarray
    ground_point: np.ndarray
    body_point: np.ndarray


def _sines(rng: np.random.Generator, size: float, rows: int) -> np.ndarray:
    """Smooth motions (rows, POSES) with about this RMS."""
    rate, phase = rng.uniform(0.2, 0.9, (rows, 3, 1)), rng.uniform(0, 6.28, (rows, 3, 1))
    return size * np.sqrt(2 / 3) * np.sin(2 * np.pi * rate * DT * np.arange(POSES) + phase).sum(axis=1)


def simulate_contact(kind: str, seed: int, sigma: float = 3e-4, slow: float = 0.0) -> Contact:
    """A hinge ("A"), a slide ("B"), a cylinder ("C") or a pin on a plane ("K").

    Args:
        kind: label of the constraint.
        seed: of geometry, motion and errors.
        sigma: m, white noise of positions; of rotations, 3 rad/m times that.
        slow: m, errors that change within seconds; of rotations, 5 rad/m times that.
    """
    rng = np.random.default_rng([ord(kind), seed])
    ground, body = Rotation.random(2, random_state=rng)
    point, on_body = rng.uniform(-0.5, 0.5, 3), rng.uniform(0.1, 0.2, 3)
    turns, slides = np.zeros((3, POSES)), np.zeros((3, POSES))
    if kind in "AC":
        turns[2] = _sines(rng, 0.5, 1)
    if kind in "BC":
        slides[2] = _sines(rng, 0.08, 1)
    if kind == "K":
        turns, slides[:2] = _sines(rng, 0.5, 3), _sines(rng, 0.08, 2)
    slides = slides + _sines(rng, slow, 3)
    rotation = ground * Rotation.from_rotvec(_sines(rng, 5 * slow, 3).T) * Rotation.from_rotvec(turns.T)
    rotation = rotation * body.inv()
    poses = np.tile(np.eye(4), (POSES, 1, 1))
    poses[:, :3, 3] = point + ground.apply(slides.T) - rotation.apply(on_body)
    poses[:, :3, 3] += rng.normal(0, sigma, (POSES, 3))
    poses[:, :3, :3] = (rotation * Rotation.from_rotvec(rng.normal(0, 3 * sigma, (POSES, 3)))).as_matrix()
    return Contact(poses, ground.as_matrix()[:, 2], body.as_matrix()[:, 2], point, on_body)

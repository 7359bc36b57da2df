"""Simulate a hand-held pointer whose tip dwells at points: spherical joints with free motion between them."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from reframe_jax.geometry import rotations, transforms
from reframe_jax.geometry.products import apply, matmul
from reframe_jax.simulation.motions import PoseErrors, disturb

__all__ = ["PointerSimulation", "simulate_pointer"]

_OPTICAL = PoseErrors(sigma=2e-4, rotation_ratio=5.0)  # 0.2 mm, 1 mrad
_DETOUR = 0.05  # m, detour of the tip from the straight line between two points, along each axis
_SWING = 0.35, 0.35, 0.6  # rad, amplitudes about the axes of the pointer; the last axis is along the pointer
_RATES = 0.25, 0.9  # Hz, lowest and highest frequency of the hand
_WAVES = 4  # number of sines per rotation


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PointerSimulation:
    """A simulated recording of a pointer.

    Attributes:
        times: (N,) s.
        poses: (N, 4, 4) measured poses; m.
        exact_poses: (N, 4, 4) poses without errors.
        points: (P, 3) m, dwell points of the tip, in the ground.
        tip: (3,) m, position of the tip in the body.
        dwells: (P, 2) index of the first pose of each dwell, and of the first pose after it.
    """

    times: jax.Array
    poses: jax.Array
    exact_poses: jax.Array
    points: jax.Array
    tip: jax.Array
    dwells: np.ndarray


def simulate_pointer(
    points: ArrayLike,
    key: jax.Array,
    *,
    dwell: float = 4.0,
    travel: float = 1.5,
    dt: float = 0.02,
    tip: ArrayLike | tuple[float, float, float] = (0.02, -0.01, -0.18),
    errors: PoseErrors = _OPTICAL,
) -> PointerSimulation:
    """Simulate a pointer that pivots about several points, and moves freely between them.

    The recording starts and ends with free motion. The orientation is a sum of sines of 0.25 to 0.9 Hz. The
    tip moves between points along minimum-jerk profiles, with a detour of about 5 cm.

    Args:
        points: (P, 3) m, dwell points in the ground.
        key: JAX random key of the motion and the errors.
        dwell: s, duration of each dwell.
        travel: s, duration of each motion between two points, to the first point and from the last.
        dt: sample time, s.
        tip: (3,) m, position of the tip in the body.
        errors: errors of the tracker; by default 0.2 mm and 1 mrad.

    Raises:
        ValueError: if the points or the tip have other shapes, or a time is not positive.
    """
    points, tip = jnp.asarray(points, dtype=float), jnp.asarray(tip, dtype=float)
    if points.ndim != 2 or points.shape[0] < 1 or points.shape[1] != 3 or tip.shape != (3,):
        raise ValueError(f"points must have shape (P, 3) and tip (3,), not {points.shape} and {tip.shape}.")
    if not min(dwell, travel, dt) > 0:
        raise ValueError(f"dwell, travel and dt must be positive, not {dwell}, {travel} and {dt}.")
    rate_key, phase_key, way_key, detour_key, error_key = jax.random.split(key, 5)
    stay, go = round(dwell / dt), round(travel / dt)
    away = 0.15 * jax.random.normal(way_key, (2, 3), points.dtype)
    stops = jnp.concatenate([points[:1] + away[:1], points, points[-1:] + away[1:]])
    detours = _DETOUR * jax.random.normal(detour_key, (len(stops) - 1, 3), points.dtype)
    path = _path(stops, detours, stay, go)
    times = dt * jnp.arange(len(path), dtype=points.dtype)
    rates = jax.random.uniform(rate_key, (3, _WAVES), points.dtype, *_RATES)
    phases = jax.random.uniform(phase_key, (3, _WAVES), points.dtype, 0, 2 * np.pi)
    waves = jnp.sin(2 * np.pi * rates[None] * times[:, None, None] + phases[None])
    turns = jnp.asarray(_SWING, points.dtype)[None] * jnp.sum(waves, axis=-1) / _WAVES**0.5
    tilt, twist = turns.at[:, 2].set(0), turns.at[:, :2].set(0)
    rotation = matmul(rotations.rotation_exp(tilt), rotations.rotation_exp(twist))
    exact = transforms.make_pose(rotation, path - apply(rotation, tip[None]))
    start = go + (stay + go) * np.arange(len(points))
    return PointerSimulation(
        times=times,
        poses=disturb(exact, error_key, errors, dt),
        exact_poses=exact,
        points=points,
        tip=tip,
        dwells=np.stack([start, start + stay + 1], axis=1),
    )


def _path(stops: jax.Array, detours: jax.Array, stay: int, go: int) -> jax.Array:
    """Path of the tip, (N, 3) m; the tip dwells at all stops except the first and the last."""
    s = jnp.arange(1, go + 1, dtype=stops.dtype)[:, None] / go
    gone = s**3 * (10 - 15 * s + 6 * s**2)
    aside = jnp.sin(np.pi * gone) ** 2
    pieces = [stops[:1]]
    for i in range(len(stops) - 1):
        way = (stops[i + 1] - stops[i])[None]
        pieces.append(stops[i][None] + gone * way + aside * detours[i][None])
        if i < len(stops) - 2:
            pieces.append(jnp.broadcast_to(stops[i + 1], (stay, 3)))
    return jnp.concatenate(pieces)

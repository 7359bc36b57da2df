"""A hand-held pointer whose tip dwells at points: spherical joints with free motion between."""

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
_DETOUR = 0.05  # m by which the tip leaves the straight line between two points, along each axis
_SWING = 0.35, 0.35, 0.6  # rad, about the axes of the pointer, the last along it
_RATES = 0.25, 0.9  # Hz, lowest and highest of the hand
_WAVES = 4  # sines of each rotation


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PointerSimulation:
    """A simulated recording of a pointer.

    Attributes:
        times: (N,) s.
        poses: (N, 4, 4) measured poses; m.
        exact_poses: (N, 4, 4) poses without errors.
        points: (P, 3) m, where the tip dwelt, in the ground.
        tip: (3,) m, in the body.
        dwells: (P, 2) indices of the first pose of each dwell, and of the first behind it.
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
    """Simulate a pointer that pivots about one point after the other, and moves freely between.

    The recording begins and ends with free motion. The hand swings all the time by a sum of sines of
    0.25 to 0.9 Hz. The tip goes from point to point at minimum jerk, on a detour of about 5 cm.

    Args:
        points: (P, 3) m, in the ground.
        key: of the motion and the errors.
        dwell: s, at each point.
        travel: s, from one point to the next, to the first and from the last.
        dt: sample time, s.
        tip: (3,) m, in the body.
        errors: of the tracker; by default 0.2 mm and 1 mrad.

    Raises:
        ValueError: if the points or the tip are not of these shapes, or a time is not positive.
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
    """Path of the tip, (N, 3) m: it stays at all stops but the first and the last."""
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

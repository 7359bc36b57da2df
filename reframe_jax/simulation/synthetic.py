"""Simulate constrained motions with known truth, exactly or as in the paper's section 5.1.

Two options matter. The *generator*: the paper takes one Euler step of Eq. 9 per sample, which obeys the
constraint in the ``"left"`` discretization only. The exact generator integrates the motion between samples,
as a real mechanism moves. The *excitation*: the paper's velocities make some constraints ambiguous. For E and
F, the motion is a pure rotation about a point 0.2 m away; for I and J, other types fit equally well. Three
incommensurate sines along every free axis make the true constraint the only optimum. The module
:mod:`reframe_jax.simulation.motions` has the errors of trackers.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from reframe_jax.constraints.catalogue import constraint as named
from reframe_jax.constraints.frame import ConstraintFrame, Frame, body_twist, frame_arrays
from reframe_jax.geometry import rotations, transforms
from reframe_jax.geometry.products import matmul
from reframe_jax.motion.paths import bracket

__all__ = [
    "EXCITATIONS",
    "Excitation",
    "Simulation",
    "add_pose_noise",
    "exciting",
    "paper_excitation",
    "pitch_of",
    "simulate",
]

Excitation = Callable[[jax.Array], tuple[jax.Array, jax.Array]]
"""Function of time (s) that returns angular and linear velocities, (3,) each, along the frames' axes."""

_RATES = ((0.9, 2.9, 4.9), (1.4, 3.4, 5.4), (1.9, 3.9, 4.4))  # rad/s, by axis
_LINEAR_RATE = 1.13  # ratio of linear to angular rates
_ANGULAR_AMPLITUDE = 0.6  # rad/s, amplitude of each sine
_LINEAR_AMPLITUDE = 0.15  # m/s, amplitude of each sine
_PITCH = 0.05  # m/rad, default pitch of a screw
_ROTATION_RATIO = 3.0  # rad/m, standard deviation of orientations to that of positions in the paper
_SUBSTEPS = 4  # Runge-Kutta steps per sample; the error is about 1e-7 m at dt = 0.1 s


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Simulation:
    """A simulated recording.

    Attributes:
        times: (K+1,) s.
        poses, exact_poses: (K+1, 4, 4) m, measured poses, noise included, and poses without noise.
        truth: the constraint that was simulated.
    """

    times: jax.Array
    poses: jax.Array
    exact_poses: jax.Array
    truth: ConstraintFrame


def paper_excitation(key: jax.Array) -> Excitation:
    """Return the velocities, rad/s and m/s, of Overbeek et al. 2025, section 5.1; the key has no effect."""

    def velocity(t: jax.Array) -> tuple[jax.Array, jax.Array]:
        one = jnp.ones_like(t)
        angular = jnp.stack([1 + jnp.sin(2 * t), -one, jnp.cos(3 * t)])
        linear = jnp.stack([-one, jnp.cos(2 * t), jnp.sin(3 * t)])
        return 0.5 * angular, 0.1 * linear

    return velocity


def exciting(key: jax.Array) -> Excitation:
    """Return velocities of three incommensurate sines along every axis, 0.7 rad/s and 0.18 m/s RMS.

    The key draws the phases of the sines.
    """
    phases = jax.random.uniform(key, (2, 3, 3), maxval=2 * jnp.pi, dtype=float)

    def velocity(t: jax.Array) -> tuple[jax.Array, jax.Array]:
        rates = jnp.asarray(_RATES, dtype=phases.dtype)
        angular = jnp.sum(jnp.sin(rates * t + phases[0]), axis=-1)
        linear = jnp.sum(jnp.sin(_LINEAR_RATE * rates * t + phases[1]), axis=-1)
        return _ANGULAR_AMPLITUDE * angular, _LINEAR_AMPLITUDE * linear

    return velocity


EXCITATIONS = {"exciting": exciting, "paper": paper_excitation}
"""Excitations by name: functions of a key that return the velocities."""


def simulate(
    constraint: str | ConstraintFrame,
    key: jax.Array,
    *,
    noise: float | jax.Array = 0.0,
    duration: float = 5.0,
    dt: float = 0.1,
    excitation: str | Excitation = "exciting",
    exact: bool = True,
    start: jax.Array | None = None,
    ease: float | jax.Array = 0.0,
    pitch: float | jax.Array | None = None,
) -> Simulation:
    """Simulate a body that moves under a constraint.

    The recording has round(duration / dt) + 1 poses. The function works under ``jit`` and ``vmap``, with
    batches of keys, noise levels or geometries of the frame.

    Args:
        constraint: label or name of a constraint, with the geometry of the paper, or any frame.
        key: JAX random key of the excitation and of the noise.
        noise: standard deviation sigma of the position noise in m; see :func:`add_pose_noise`.
        duration: s.
        dt: sample time, s.
        excitation: a name of :data:`EXCITATIONS` or a function of time.
        exact: whether to integrate the motion between samples; False takes one step per sample, as in the
            paper.
        start: (4, 4) first pose; the identity by default. If the angular and the linear axes are fixed in
            different bodies, they must agree at the first pose, otherwise the motion obeys another
            constraint.
        ease: s, duration of the smooth start from rest, and of the smooth end.
        pitch: m/rad, pitch of a screw: the velocity along each linear axis is the pitch times the velocity
            about the same angular axis, instead of the linear velocity of the excitation. By default 0.05 for
            the constraint "screw", and None (no screw) for other constraints.

    Raises:
        KeyError: for an unknown constraint.
        ValueError: for an unknown excitation.
    """
    if isinstance(constraint, str):
        frame = ConstraintFrame.named(constraint)
        pitch = pitch_of(constraint) if pitch is None else pitch
    else:
        frame = constraint
    if isinstance(excitation, str) and excitation not in EXCITATIONS:
        raise ValueError(f"Unknown excitation {excitation!r}; choose from {', '.join(EXCITATIONS)}.")
    first = jnp.eye(4, dtype=frame.position.dtype) if start is None else start
    pitch = None if pitch is None else jnp.asarray(pitch, dtype=first.dtype)
    options = {"excitation": excitation, "exact": exact, "steps": round(duration / dt)}
    times, measured, poses = _simulate(frame_arrays(frame), key, first, noise, dt, ease, pitch, **options)
    return Simulation(times, measured, poses, frame)


def pitch_of(label: str) -> float | None:
    """Default pitch of a simulated constraint: m/rad for a screw, None for other constraints."""
    return _PITCH if named(label).label == "screw" else None


@partial(jax.jit, static_argnames=("excitation", "exact", "steps"))
def _simulate(
    frame: Frame,
    key: jax.Array,
    first: jax.Array,
    noise: float | jax.Array,
    dt: float,
    ease: float | jax.Array,
    pitch: jax.Array | None,
    *,
    excitation: str | Excitation,
    exact: bool,
    steps: int,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return times (steps + 1,), measured poses and true poses (steps + 1, 4, 4), from the first pose on."""
    phase_key, noise_key = jax.random.split(key)
    times = dt * jnp.arange(steps + 1, dtype=first.dtype)
    velocity = EXCITATIONS[excitation](phase_key) if isinstance(excitation, str) else excitation

    def twist(t: jax.Array, pose: jax.Array) -> jax.Array:
        angular, linear = velocity(t)
        linear = linear if pitch is None else pitch * angular
        fraction = _ease_factor(t, ease) * _ease_factor(steps * dt - t, ease)
        wanted = frame.free * fraction * jnp.concatenate([angular, linear])
        return body_twist(frame, pose[:3, :3], pose[:3, 3], wanted)

    def advance(pose: jax.Array, t: jax.Array) -> tuple[jax.Array, jax.Array]:
        if not exact:
            return matmul(pose, transforms.pose_exp(dt * twist(t, pose))), pose
        h = dt / _SUBSTEPS

        def substep(pose: jax.Array, i: jax.Array) -> tuple[jax.Array, None]:
            return _runge_kutta(twist, pose, t + i * h, h), None

        moved, _ = jax.lax.scan(substep, pose, jnp.arange(_SUBSTEPS, dtype=pose.dtype))
        return moved, pose

    poses = jax.lax.scan(advance, first, times)[1]
    return times, add_pose_noise(poses, noise_key, noise), poses


def _ease_factor(t: jax.Array, ease: float | jax.Array) -> jax.Array:
    """Factor on the velocity at a time after rest, which increases smoothly from 0 to 1."""
    rises = jnp.asarray(ease, dtype=t.dtype) > 0
    s = jnp.where(rises, jnp.clip(t / jnp.where(rises, ease, 1), 0, 1), 1)
    return s * s * (3 - 2 * s)


def _runge_kutta(
    twist: Callable[[jax.Array, jax.Array], jax.Array], pose: jax.Array, t: jax.Array, h: float
) -> jax.Array:
    """One step of the fourth-order Runge-Kutta-Munthe-Kaas method for dT/dt = T [V(t, T)]."""

    def stage(carry: tuple[jax.Array, jax.Array], weights: jax.Array) -> tuple[Any, None]:
        slope, total = carry
        fraction, weight = weights
        x = fraction * h * slope
        here = twist(t + fraction * h, matmul(pose, transforms.pose_exp(x.T.ravel()))).reshape(2, 3).T
        # dx/dt at T exp(x), to the order of the method
        turned = bracket(x, here)
        slope = here + turned / 2 + bracket(x, turned) / 12
        return (slope, total + weight * slope), None

    zero = jnp.zeros((3, 2), dtype=pose.dtype)
    tableau = jnp.asarray([[0, 1 / 6], [1 / 2, 1 / 3], [1 / 2, 1 / 3], [1, 1 / 6]], dtype=pose.dtype)
    (_, slope), _ = jax.lax.scan(stage, (zero, zero), tableau)
    return matmul(pose, transforms.pose_exp(h * slope.T.ravel()))


@jax.jit
def add_pose_noise(poses: jax.Array, key: jax.Array, sigma: float | jax.Array) -> jax.Array:
    """Add Gaussian noise to positions and rotation vectors of poses (..., 4, 4) (paper, section 5.1).

    ``sigma`` is the standard deviation of each position component, m; in rad and times 3 of each component of
    the rotation vector.
    """
    position_key, rotation_key = jax.random.split(key)
    shape, dtype = (*poses.shape[:-2], 3), poses.dtype
    sigma = jnp.asarray(sigma, dtype=dtype)
    position = poses[..., :3, 3] + sigma * jax.random.normal(position_key, shape, dtype)
    turn = _ROTATION_RATIO * sigma * jax.random.normal(rotation_key, shape, dtype)
    rotvec = rotations.rotation_log(poses[..., :3, :3]) + turn
    return transforms.make_pose(rotations.rotation_exp(rotvec), position)

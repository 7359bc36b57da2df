"""Random motions for benchmarks and tests: hand-like excitations, and constraints with random geometry.

Importing this module adds the excitations ``"hand"``, ``"sine"``, ``"slow"`` and ``"reach"`` to
:data:`reframe_jax.simulation.synthetic.EXCITATIONS`. They imitate hands: they are slower than ``"exciting"``,
rarely move along all axes at the same time, and often rest.
"""

from typing import Any

import jax
import jax.numpy as jnp

from reframe_jax.constraints.catalogue import constraint
from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.geometry import rotations, transforms
from reframe_jax.geometry.products import apply
from reframe_jax.simulation.motions import PoseErrors, disturb
from reframe_jax.simulation.synthetic import EXCITATIONS, Excitation, Simulation, pitch_of, simulate

__all__ = ["random_constraint", "random_motion"]

_HAND_SINES = 2, 4  # smallest and largest number of sines per axis
_HAND_RATE = 0.1, 1.0  # Hz
_HAND_SPEED = (0.1, 1.0), (0.02, 0.3)  # RMS, rad/s and m/s
_SINE_RATE, _SLOW_RATE = (1.0, 4.0), (0.2, 0.6)  # rad/s
_SINE_SPEED = (0.35, 0.85), (0.0875, 0.2125)  # amplitude, rad/s and m/s
_REACH = (0.3, 1.2), (0.08, 0.35)  # displacement, rad and m
_LEAVES, _TURNS, _RETURNS = (0.05, 0.25), (0.4, 0.6), (0.75, 0.95)  # times, as fractions of the duration
_WIDTH = 0.5  # m, half the width of the cubes in which positions are drawn


def hand(key: jax.Array, duration: float | jax.Array | None = None) -> Excitation:
    """Smooth motion: two to four sines of 0.1 to 1 Hz along every axis, with random amplitudes and phases.

    The long-term RMS velocity along each axis has a log-uniform distribution from 0.1 to 1 rad/s and 0.02 to
    0.3 m/s. An axis with a fast rotation also has a fast translation.
    """
    del duration
    keys = jax.random.split(key, 5)
    few, most = _HAND_SINES
    count = jax.random.randint(keys[0], (2, 3, 1), few, most + 1)
    weight = jax.random.uniform(keys[1], (2, 3, most), minval=0.3, dtype=float)
    weight = jnp.where(jnp.arange(most)[None, None] < count, weight, 0)
    weight = weight / jnp.linalg.norm(weight, axis=-1, keepdims=True)
    rates = 2 * jnp.pi * _uniform(keys[2], (2, 3, most), _HAND_RATE)
    phases = jax.random.uniform(keys[3], (2, 3, most), maxval=2 * jnp.pi, dtype=float)
    pace = jax.random.uniform(keys[4], (3,), dtype=float)
    low, high = jnp.asarray(_HAND_SPEED, dtype=float).T[:, :, None]
    speed = low * (high / low) ** pace[None]
    return _sines(jnp.sqrt(2) * speed[..., None] * weight, rates, phases)


def sine(key: jax.Array, duration: float | jax.Array | None = None) -> Excitation:
    """One sine of 1 to 4 rad/s along every axis, with amplitudes of 0.35 to 0.85 rad/s, 0.09 to 0.21 m/s."""
    del duration
    return _one_sine(key, _SINE_RATE)


def slow(key: jax.Array, duration: float | jax.Array | None = None) -> Excitation:
    """One sine with a rate of 0.2 to 0.6 rad/s along every axis, with the amplitudes of :func:`sine`."""
    del duration
    return _one_sine(key, _SLOW_RATE)


def reach(key: jax.Array, duration: float | jax.Array = 5.0) -> Excitation:
    """Move out and back along minimum-jerk profiles within a duration (s), with rests at both ends.

    Each axis has random times of departure, reversal and return, and moves by 0.3 to 1.2 rad or 0.08 to 0.35
    m.
    """
    keys = jax.random.split(key, 6)
    leave, turn, back = (
        duration * _uniform(k, (2, 3), interval)
        for k, interval in zip(keys[:3], (_LEAVES, _TURNS, _RETURNS), strict=True)
    )
    distance = jnp.stack([_uniform(k, (3,), size) for k, size in zip(keys[3:5], _REACH, strict=True)])
    distance = distance * jnp.where(jax.random.bernoulli(keys[5], shape=(2, 3)), 1, -1)

    def velocity(t: jax.Array) -> tuple[jax.Array, jax.Array]:
        speed = distance * (_minimum_jerk(t, leave, turn) - _minimum_jerk(t, turn, back))
        return speed[0], speed[1]

    return velocity


EXCITATIONS.update(hand=hand, sine=sine, slow=slow, reach=reach)


def _uniform(key: jax.Array, shape: tuple[int, ...], interval: tuple[float, float]) -> jax.Array:
    return jax.random.uniform(key, shape, minval=interval[0], maxval=interval[1], dtype=float)


def _one_sine(key: jax.Array, rate: tuple[float, float]) -> Excitation:
    rate_key, phase_key, speed_key = jax.random.split(key, 3)
    rates = _uniform(rate_key, (2, 3, 1), rate)
    phases = jax.random.uniform(phase_key, (2, 3, 1), maxval=2 * jnp.pi, dtype=float)
    low, high = jnp.asarray(_SINE_SPEED, dtype=float).T[:, :, None, None]
    amplitudes = low + (high - low) * jax.random.uniform(speed_key, (2, 3, 1), dtype=float)
    return _sines(amplitudes, rates, phases)


def _sines(amplitudes: jax.Array, rates: jax.Array, phases: jax.Array) -> Excitation:
    """Sums of sines from arrays (2, 3, n): angular and linear velocity, three axes, n sines."""

    def velocity(t: jax.Array) -> tuple[jax.Array, jax.Array]:
        speed = jnp.sum(amplitudes * jnp.sin(rates * t + phases), axis=-1)
        return speed[0], speed[1]

    return velocity


def _minimum_jerk(t: jax.Array, start: jax.Array, end: jax.Array) -> jax.Array:
    """Speed along a minimum-jerk profile of unit length, 1/s; zero before the start and after the end."""
    s = jnp.clip((t - start) / (end - start), 0, 1)
    return 30 * s**2 * (1 - s) ** 2 / (end - start)


def random_constraint(
    label: str, key: jax.Array, *, linear_type: LinearType | None = None
) -> tuple[ConstraintFrame, jax.Array]:
    """Draw a constraint with random geometry, and a random first pose (4, 4) of the body, m.

    The frame has a random orientation, and its origin is within 0.5 m of the body's origin along each axis at
    the start. The body has a random orientation, and its origin is within 0.5 m of the ground's origin. The
    angular and the linear axes are fixed in the same body, so the constraint is the same for every first
    pose. All labels have the same geometry for a key, but may express it in another body. ``linear_type`` is
    as in :meth:`ConstraintFrame.named`.
    """
    entry = constraint(label)
    kind = entry.linear_type if linear_type is None else linear_type
    rotvec, in_body, in_ground, start = _geometry(key)
    in_the_ground = kind is not None and kind.position_body == AngularType.G
    position = in_ground if in_the_ground else in_body
    frame = ConstraintFrame.named(entry.label, linear_type=kind, rotvec=rotvec, position=position)
    return frame, start


def random_motion(
    label: str,
    key: jax.Array,
    *,
    samples: int,
    dt: float,
    excitation: str | Excitation = "hand",
    errors: PoseErrors = PoseErrors(),  # noqa: B008
) -> Simulation:
    """Simulate a motion under a constraint with random geometry, with the errors of a tracker.

    For a given key and a given ``samples * dt``, the geometry and the motion are the same at every sample
    time and for all errors.

    Args:
        label: label or name of a constraint.
        key: JAX random key of the geometry, the excitation and the errors.
        samples: K, number of steps.
        dt: sample time, s; not an array.
        excitation: a name of :data:`reframe_jax.simulation.synthetic.EXCITATIONS`, or a function of time.
        errors: errors of the tracker; none by default.

    Returns:
        The recording with K + 1 poses; the first of its ``exact_poses`` is the first pose.

    Raises:
        KeyError: for an unknown label.
        ValueError: for an unknown excitation.
    """
    geometry_key, motion_key, error_key = jax.random.split(key, 3)
    frame, start = random_constraint(label, geometry_key)
    options: Any = {"duration": samples * dt, "dt": dt, "excitation": excitation, "pitch": pitch_of(label)}
    exact = simulate(frame, motion_key, start=start, **options).exact_poses
    times = dt * jnp.arange(samples + 1, dtype=exact.dtype)
    return Simulation(times, disturb(exact, error_key, errors, dt), exact, frame)


@jax.jit
def _geometry(key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Orientation (3,) rad, position (3,) m in the body and in the ground, and first pose (4, 4)."""
    turn_key, start_key, here_key, there_key = jax.random.split(key, 4)
    rotation = rotations.quaternion_to_rotation(_random_quaternion(start_key))
    in_body, away = (
        jax.random.uniform(k, (3,), minval=-_WIDTH, maxval=_WIDTH, dtype=float) for k in (here_key, there_key)
    )
    rotvec = rotations.rotation_log(rotations.quaternion_to_rotation(_random_quaternion(turn_key)))
    return rotvec, in_body, apply(rotation, in_body) + away, transforms.make_pose(rotation, away)


def _random_quaternion(key: jax.Array) -> jax.Array:
    """Quaternion (4,) with a uniform distribution over all rotations."""
    four = jax.random.normal(key, (4,), dtype=float)
    return four / jnp.linalg.norm(four)

"""Named excitations: velocities over time along the free axes of a simulated constraint.

``"paper"`` and ``"exciting"`` are for comparisons: ``"paper"`` has the velocities of the paper, and
``"exciting"`` makes the true constraint the only optimum. The other excitations imitate hands: they are
slower, rarely move along all axes at the same time, and often rest.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

__all__ = ["EXCITATIONS", "Excitation", "exciting", "hand", "paper_excitation", "reach", "sine", "slow"]

Excitation = Callable[[jax.Array], tuple[jax.Array, jax.Array]]
"""Function of time (s) that returns angular and linear velocities, (3,) each, along the frames' axes."""

_RATES = ((0.9, 2.9, 4.9), (1.4, 3.4, 5.4), (1.9, 3.9, 4.4))  # rad/s, by axis
_LINEAR_RATE = 1.13  # ratio of linear to angular rates
_ANGULAR_AMPLITUDE = 0.6  # rad/s, amplitude of each sine
_LINEAR_AMPLITUDE = 0.15  # m/s, amplitude of each sine
_HAND_SINES = 2, 4  # smallest and largest number of sines per axis
_HAND_RATE = 0.1, 1.0  # Hz
_HAND_SPEED = (0.1, 1.0), (0.02, 0.3)  # RMS, rad/s and m/s
_SINE_RATE, _SLOW_RATE = (1.0, 4.0), (0.2, 0.6)  # rad/s
_SINE_SPEED = (0.35, 0.85), (0.0875, 0.2125)  # amplitude, rad/s and m/s
_REACH = (0.3, 1.2), (0.08, 0.35)  # displacement, rad and m
_LEAVES, _TURNS, _RETURNS = (0.05, 0.25), (0.4, 0.6), (0.75, 0.95)  # times, as fractions of the duration


def paper_excitation(key: jax.Array, duration: float | jax.Array | None = None) -> Excitation:
    """The velocities of the paper's section 5.1; ignores the key and the duration."""
    del key, duration

    def velocity(t: jax.Array) -> tuple[jax.Array, jax.Array]:
        one = jnp.ones_like(t)
        angular = jnp.stack([1 + jnp.sin(2 * t), -one, jnp.cos(3 * t)])
        linear = jnp.stack([-one, jnp.cos(2 * t), jnp.sin(3 * t)])
        return 0.5 * angular, 0.1 * linear

    return velocity


def exciting(key: jax.Array, duration: float | jax.Array | None = None) -> Excitation:
    """Three incommensurate sines along every axis, with random phases: 0.7 rad/s and 0.18 m/s RMS."""
    del duration
    phases = jax.random.uniform(key, (2, 3, 3), maxval=2 * jnp.pi, dtype=float)

    def velocity(t: jax.Array) -> tuple[jax.Array, jax.Array]:
        rates = jnp.asarray(_RATES, dtype=phases.dtype)
        angular = jnp.sum(jnp.sin(rates * t + phases[0]), axis=-1)
        linear = jnp.sum(jnp.sin(_LINEAR_RATE * rates * t + phases[1]), axis=-1)
        return _ANGULAR_AMPLITUDE * angular, _LINEAR_AMPLITUDE * linear

    return velocity


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


EXCITATIONS: dict[str, Callable[[jax.Array, float | jax.Array], Excitation]] = {
    "exciting": exciting,
    "paper": paper_excitation,
    "hand": hand,
    "sine": sine,
    "slow": slow,
    "reach": reach,
}
"""Excitations by name: functions of a key and the duration (s) that return the velocities."""


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

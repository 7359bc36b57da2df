"""The paper's classification: thresholds of RMS velocities."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

__all__ = ["Thresholds", "degrees_of_freedom", "free_rotations"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Thresholds:
    """RMS velocities above which an axis counts as free.

    The defaults are the midpoints of the ranges that classify the paper's robot data (section 5.6).

    Attributes:
        angular: rad/s.
        linear: m/s.
    """

    angular: float | jax.Array = 0.160
    linear: float | jax.Array = 0.037


def degrees_of_freedom(rms: jax.Array, threshold: jax.Array | float) -> jax.Array:
    """1 where an axis is free, (..., 3) int32; a constrained axis has an RMS below the threshold."""
    return (rms > threshold).astype(jnp.int32)


def free_rotations(dof: jax.Array) -> jax.Array:
    """Axes about which a frame can turn freely, (..., 3) bool: the other two are of one kind."""
    return jnp.roll(dof, 1, axis=-1) == jnp.roll(dof, -1, axis=-1)

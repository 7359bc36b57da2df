"""The box in which a solver searches."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

__all__ = ["Box"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Box:
    """Bounds of every unknown.

    Attributes:
        low, high: (dim,), or (dim, ...) for one box per problem, in the unit of the unknown (rad for rotation
            vectors, m for positions).
    """

    low: jax.Array
    high: jax.Array

    def bounds(self, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Bounds shaped to broadcast against unknowns (dim, ...)."""
        if self.low.ndim > 1:
            return self.low.reshape(x.shape), self.high.reshape(x.shape)
        shape = (-1, *([1] * (x.ndim - 1)))
        return self.low.reshape(shape), self.high.reshape(shape)

    def clip(self, x: jax.Array) -> jax.Array:
        """Nearest point of the box."""
        return jnp.clip(x, *self.bounds(x))

    def scale(self, unit: jax.Array) -> jax.Array:
        """Point of the box from one of the unit cube."""
        low, high = self.bounds(unit)
        return low + (high - low) * unit

    def fold(self, z: jax.Array) -> jax.Array:
        """Point of the box, (dim,), from an unbounded one: smooth, onto, and flat at the faces.

        Lets an unbounded minimizer end on a face.
        """
        return (self.high + self.low) / 2 + (self.high - self.low) / 2 * jnp.sin(z)

    def unfold(self, x: jax.Array) -> jax.Array:
        """An unbounded point that :meth:`fold` maps to x."""
        unit = (2 * x - self.high - self.low) / (self.high - self.low)
        return jnp.arcsin(jnp.clip(unit, -1, 1))

"""The box that bounds the search of a solver."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

__all__ = ["Box"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Box:
    """Lower and upper bounds of the unknowns.

    Attributes:
        low, high: (dim,) bounds, or (dim, ...) for one box per problem, in the unit of the unknown (rad for
            rotation vectors, m for positions).
    """

    low: jax.Array
    high: jax.Array

    def bounds(self, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Reshape the bounds so that they broadcast against unknowns (dim, ...)."""
        if self.low.ndim > 1:
            return self.low.reshape(x.shape), self.high.reshape(x.shape)
        shape = (-1, *([1] * (x.ndim - 1)))
        return self.low.reshape(shape), self.high.reshape(shape)

    def clip(self, x: jax.Array) -> jax.Array:
        """Project a point onto the box."""
        return jnp.clip(x, *self.bounds(x))

    def scale(self, unit: jax.Array) -> jax.Array:
        """Map a point of the unit cube to the box."""
        low, high = self.bounds(unit)
        return low + (high - low) * unit

    def fold(self, z: jax.Array) -> jax.Array:
        """Map an unbounded point to the box, (dim,), smoothly and with zero slope at the faces.

        Every point of the box has a preimage, so an unbounded minimizer can end on a face.
        """
        return (self.high + self.low) / 2 + (self.high - self.low) / 2 * jnp.sin(z)

    def unfold(self, x: jax.Array) -> jax.Array:
        """Return an unbounded point that :meth:`fold` maps to x."""
        unit = (2 * x - self.high - self.low) / (self.high - self.low)
        return jnp.arcsin(jnp.clip(unit, -1, 1))

"""The box in which a solver searches."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Box:
    """Lower and upper bounds of the unknowns of a search.

    Attributes:
        low, high: (dim,) for equal bounds of all problems, or (dim, ...) with one box per problem. The units
            are those of the unknowns: rad for rotation vectors, m for positions.
    """

    low: jax.Array
    high: jax.Array

    def bounds(self, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the lower and the upper bounds, reshaped for operations with unknowns x, (dim, ...)."""
        if self.low.ndim > 1:
            return self.low.reshape(x.shape), self.high.reshape(x.shape)
        shape = (-1, *([1] * (x.ndim - 1)))
        return self.low.reshape(shape), self.high.reshape(shape)

    def clip(self, x: jax.Array) -> jax.Array:
        """Move unknowns (dim, ...) outside the box to the nearest point of the box."""
        return jnp.clip(x, *self.bounds(x))

    def scale(self, unit: jax.Array) -> jax.Array:
        """Map points (dim, ...) of the unit cube to the box."""
        low, high = self.bounds(unit)
        return low + (high - low) * unit

    def fold(self, z: jax.Array) -> jax.Array:
        """Map any vector z (dim,) to a point of the box, by a sine per component.

        A minimizer without bounds can search over z: the map is smooth and reaches every point of the box,
        also on its faces, where the slope is zero.
        """
        return (self.high + self.low) / 2 + (self.high - self.low) / 2 * jnp.sin(z)

    def unfold(self, x: jax.Array) -> jax.Array:
        """Return a vector z (dim,) that :meth:`fold` maps to a point x of the box."""
        unit = (2 * x - self.high - self.low) / (self.high - self.low)
        return jnp.arcsin(jnp.clip(unit, -1, 1))

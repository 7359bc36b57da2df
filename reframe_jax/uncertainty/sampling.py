"""How paths are sampled for an estimate, and the transpose of that."""

from collections.abc import Callable
from dataclasses import dataclass

import jax

from reframe_jax.arrays import jnp, lax

__all__ = ["Sampling"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sampling:
    """How paths are sampled: chords between two poses, or all poses about their mean.

    The scales are such that the sum of squares of what is sampled is its mean square.

    Attributes:
        about_mean: (N,) bool, which of the two.
        shares: (K+1, N) weight of each pose about the mean, of sum 1.
        lag: (N,) samples between the ends of a chord.
        scales: (K+1, N) 1/s, of every chord, by its first pose; 0 for those that do not count.
    """

    about_mean: jax.Array
    shares: jax.Array
    lag: jax.Array
    scales: jax.Array

    def take(self, path: jax.Array) -> jax.Array:
        """Samples (n, K+1, N) of paths (n, K+1, N)."""
        mean = jnp.sum(self.shares[None] * path, axis=1, keepdims=True)
        centred = (path - mean) * jnp.sqrt(self.shares)[None]
        return self._either(centred, self.chords, path)

    def give_back(self, samples: jax.Array) -> jax.Array:
        """The transpose of :meth:`take`."""
        scaled = jnp.sqrt(self.shares)[None] * samples
        centred = scaled - self.shares[None] * jnp.sum(scaled, axis=1, keepdims=True)
        return self._either(centred, self.from_chords, samples)

    def pose_weights(self) -> jax.Array:
        """How often the noise of every pose counts in what is sampled, (K+1, N)."""
        once = jnp.square(self.scales)
        first = self._index() - self.lag[None]
        ends = jnp.take_along_axis(once, jnp.maximum(first, 0), axis=0)
        return jnp.where(self.about_mean[None], self.shares, once + jnp.where(first >= 0, ends, 0))

    def chords(self, path: jax.Array) -> jax.Array:
        """Velocities of all chords, (n, K+1, N), whatever ``about_mean`` says."""
        end = jnp.minimum(self._index() + self.lag[None], path.shape[1] - 1)
        return (jnp.take_along_axis(path, end[None], axis=1) - path) * self.scales[None]

    def from_chords(self, samples: jax.Array) -> jax.Array:
        """The transpose of :meth:`chords`."""
        scaled = samples * self.scales[None]
        first = self._index() - self.lag[None]
        ends = jnp.take_along_axis(scaled, jnp.maximum(first, 0)[None], axis=1)
        return jnp.where((first >= 0)[None], ends, 0) - scaled

    def _either(
        self, centred: jax.Array, by_chords: Callable[[jax.Array], jax.Array], values: jax.Array
    ) -> jax.Array:
        """What belongs to each window; chords are gathered, which costs most, only where one needs them."""

        def both(_: None) -> jax.Array:
            return jnp.where(self.about_mean[None, None], centred, by_chords(values))

        return lax.cond(jnp.all(self.about_mean), lambda _: centred, both, None)

    def _index(self) -> jax.Array:
        return jnp.arange(self.scales.shape[0], dtype=jnp.int32)[:, None]

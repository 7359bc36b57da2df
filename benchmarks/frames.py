"""The paper's norm over orientation and origin together, the unknowns of its dual annealing."""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.geometry.symmetric import to_matrix
from reframe_jax.objectives.moments import covariance_at
from reframe_jax.objectives.norms import log_power_mean


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FrameObjective:
    """log J as a function of the orientation and the origin of a frame.

    The unknowns are a rotation vector (3 numbers, rad) and, for linear velocities, an origin (3 numbers, m).
    """

    coefficients: jax.Array  # (6, 10, ...) moments, or (6, 1, ...) for angular velocities
    power: float = field(default=0.0, metadata={"static": True})  # exponent of the mean over the axes

    @property
    def dim(self) -> int:
        """Number of unknowns: 6 for linear velocities, 3 for angular velocities."""
        return 6 if self.coefficients.shape[1] > 1 else 3

    @property
    def batch(self) -> tuple[int, ...]:
        """Shape of the problems."""
        return self.coefficients.shape[2:]

    @property
    def dtype(self) -> np.dtype:
        """Dtype of the unknowns and the values."""
        return self.coefficients.dtype

    def value(self, x: jax.Array) -> jax.Array:
        """Return log J (...) of the frames with unknowns x, (dim, ...)."""
        axes = rotation_exp(jnp.moveaxis(x[:3], 0, -1))
        sigma = to_matrix(covariance_at(self.coefficients, (x[-3], x[-2], x[-1])))
        squares = jnp.einsum("...ij,...ik,...kj->j...", axes, sigma, axes, precision="highest")
        return log_power_mean(jnp.log(squares) / 2, self.power)

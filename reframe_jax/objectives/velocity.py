"""What a solver minimizes: log J of many problems at once, as a function of an array of unknowns."""

from dataclasses import dataclass, field
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry import rotations, symmetric
from reframe_jax.objectives.moments import covariance_at
from reframe_jax.objectives.norms import log_power_mean

__all__ = ["FrameObjective", "MomentsOfOrigins", "PositionObjective"]


class _Moments:
    """What objectives that are functions of moments have in common."""

    moments: jax.Array

    @property
    def batch(self) -> tuple[int, ...]:
        """Shape of the problems."""
        return self.moments.shape[2:]

    @property
    def dtype(self) -> np.dtype:
        """Of the unknowns and the values."""
        return self.moments.dtype


class MomentsOfOrigins(_Moments):
    """The same of those whose unknowns are the origin."""

    @property
    def dim(self) -> int:
        """Number of unknowns."""
        return 3

    def covariance(self, x: jax.Array) -> symmetric.Symmetric:
        """Covariance of the motion of the origin ``x``, (3, ...)."""
        return covariance_at(self.moments, (x[0], x[1], x[2]))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FrameObjective(_Moments):
    """log J over orientation and origin, for any exponent.

    The unknowns are the rotation vector and, unless the velocities have no position, the origin.

    Attributes:
        moments: (6, 10, ...), or (6, 1, ...) for angular velocities; the trailing axes are problems.
        exponent: of the power mean over axes.
    """

    moments: jax.Array
    exponent: float = field(default=0.0, metadata={"static": True})

    @property
    def dim(self) -> int:
        """Number of unknowns: 6, or 3 without a position."""
        return 6 if self.moments.shape[1] > 1 else 3

    @property
    def unknowns(self) -> Literal["frame"]:
        """Orientation and origin."""
        return "frame"

    def covariance(self, x: jax.Array) -> symmetric.Symmetric:
        """Velocity covariance at the origin in ``x``."""
        if self.dim == 3:
            return covariance_at(self.moments, (x[0], x[0], x[0]))
        return covariance_at(self.moments, (x[3], x[4], x[5]))

    def log_rms(self, x: jax.Array) -> jax.Array:
        """(3, ...): logarithm of the RMS along each axis."""
        axes = rotations.rotation_exp(jnp.moveaxis(x[:3], 0, -1))
        sigma = self.covariance(x)
        squares = []
        for n in range(3):
            ex, ey, ez = axes[..., 0, n], axes[..., 1, n], axes[..., 2, n]
            outer = (ex * ex, ex * ey, ex * ez, ey * ey, ey * ez, ez * ez)
            squares.append(symmetric.trace_product(sigma, outer))
        return jnp.log(jnp.stack(squares)) / 2

    def value(self, x: jax.Array) -> jax.Array:
        """Logarithm of J, (...), of the unknowns (dim, ...)."""
        return log_power_mean(self.log_rms(x), self.exponent)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PositionObjective(MomentsOfOrigins):
    """log J over the origin alone: the best orientation is eliminated in closed form.

    The variances along orthogonal axes are the diagonal of E^T Sigma E, which the eigenvalues of
    Sigma majorize (Schur-Horn). A power mean of the RMS values with exponent p <= 2 is a symmetric
    concave function of the variances, hence smallest at the eigenvalues: for every such norm the best
    axes are the eigenvectors of Sigma. For the geometric mean J is det(Sigma)^(1/6).

    Attributes:
        moments: (6, 10, ...), or (6, 1, ...) for angular velocities; the trailing axes are problems.
        exponent: of the power mean over axes.
    """

    moments: jax.Array
    exponent: float = field(default=0.0, metadata={"static": True})

    @property
    def unknowns(self) -> Literal["position"]:
        """The origin alone."""
        return "position"

    def value(self, x: jax.Array) -> jax.Array:
        """Logarithm of J, (...), of the origin (3, ...); infinite where Sigma is not positive definite."""
        covariance = self.covariance(x)
        # the geometric mean needs the product of the variances only, which the pivots have too
        pivots = self.exponent == 0
        variances = jnp.stack(symmetric.pivots(covariance) if pivots else symmetric.eigh(covariance)[0])
        positive = jnp.all(variances > 0, axis=0)
        log_rms = jnp.log(jnp.where(positive[None], variances, 1)) / 2
        return jnp.where(positive, log_power_mean(log_rms, self.exponent), jnp.inf)

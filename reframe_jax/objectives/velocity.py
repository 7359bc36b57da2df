"""The paper's norms as objectives: the value is log J, over frames or over origins."""

from dataclasses import dataclass, field
from typing import ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry import rotations, symmetric
from reframe_jax.geometry.small import times, total
from reframe_jax.objectives.moments import covariance_at
from reframe_jax.objectives.norms import log_power_mean


def log_norm(covariance: symmetric.Symmetric, exponent: float) -> jax.Array:
    """Return the lowest log J (...) of all axes, for the six components (...) of velocity covariances.

    The result is infinite where a covariance is not positive definite.
    """
    # the geometric mean needs only the product of the variances, which equals the product of the pivots
    squares = jnp.stack(symmetric.pivots(covariance) if exponent == 0 else symmetric.eigh(covariance)[0])
    positive = jnp.all(squares > 0, axis=0)
    log_rms = jnp.log(jnp.where(positive[None], squares, 1)) / 2
    return jnp.where(positive, log_power_mean(log_rms, exponent), jnp.inf)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Moments:
    """Base class of objectives that depend on moments."""

    moments: jax.Array  # (6, 10, ...), or (6, 1, ...) for angular velocities; the trailing axes are problems
    exponent: float = field(default=0.0, metadata={"static": True})  # of the power mean over the axes

    @property
    def batch(self) -> tuple[int, ...]:
        """Shape of the problems."""
        return self.moments.shape[2:]

    @property
    def dtype(self) -> np.dtype:
        """Dtype of the unknowns and the values."""
        return self.moments.dtype


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FrameObjective(_Moments):
    """log J as a function of the orientation and the origin of a frame.

    The unknowns are a rotation vector (3 numbers, rad) and, for linear velocities, an origin (3 numbers, m).
    """

    unknowns: ClassVar[Literal["frame"]] = "frame"

    @property
    def dim(self) -> int:
        """Number of unknowns: 6 for linear velocities, 3 for angular velocities."""
        return 6 if self.moments.shape[1] > 1 else 3

    def value(self, x: jax.Array) -> jax.Array:
        """Return log J (...) of the frames with unknowns x, (dim, ...)."""
        axes = jnp.moveaxis(rotations.rotation_exp(jnp.moveaxis(x[:3], 0, -1)), (-2, -1), (0, 1))
        sigma = covariance_at(self.moments, (x[-3], x[-2], x[-1]))
        squares = total(axes * times(jnp.stack(sigma)[np.array(symmetric.PACKED)], axes), 0)
        return log_power_mean(jnp.log(squares) / 2, self.exponent)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PositionObjective(_Moments):
    """log J as a function of the origin of a frame, with the best axes at each origin.

    The best axes are the eigenvectors of the velocity covariance Sigma. Proof: the variances along orthogonal
    axes E are the diagonal of E^T Sigma E, which the eigenvalues of Sigma majorize (Schur-Horn). A power mean
    of the RMS values with exponent p <= 2 is a symmetric concave function of the variances, so its minimum is
    at the eigenvalues. For the geometric mean, J is det(Sigma)^(1/6).
    """

    unknowns: ClassVar[Literal["position"]] = "position"
    dim: ClassVar[int] = 3

    def covariance(self, x: jax.Array) -> symmetric.Symmetric:
        """Return the velocity covariance at origins x, (3, ...) m, as six arrays (...)."""
        return covariance_at(self.moments, (x[0], x[1], x[2]))

    def value(self, x: jax.Array) -> jax.Array:
        """Return log J (...) at origins x, (3, ...) m; infinite if Sigma is not positive definite."""
        return log_norm(self.covariance(x), self.exponent)

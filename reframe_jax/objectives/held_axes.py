"""The objective of a frame whose degrees of freedom are known: its constrained axes alone."""

from dataclasses import dataclass
from typing import cast

import jax
import jax.numpy as jnp

from reframe_jax.geometry import symmetric
from reframe_jax.geometry.symmetric import INDEX_PAIRS, Symmetric
from reframe_jax.objectives.moments import covariance_gradient, covariance_hessian
from reframe_jax.objectives.velocity import MomentsOfOrigins

__all__ = ["HeldAxesObjective"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class HeldAxesObjective(MomentsOfOrigins):
    """Logarithm of the product of the smallest variances, of as many axes as are constrained.

    With Gaussian noise of unknown size along the constrained axes, and any motion along the free ones, it is
    -2/K times the logarithm of the likelihood. The best axes are the eigenvectors of Sigma for it too.

    Attributes:
        moments: (6, 10, ...) of the paths; the trailing axes are problems.
        held: (3, ...) 1 for constrained axes, which come first, 0 for free ones.
    """

    moments: jax.Array
    held: jax.Array

    def value(self, x: jax.Array) -> jax.Array:
        """Of the origin (3, ...), (...); infinite where the variances are not positive."""
        variances = jnp.stack(symmetric.eigh(self.covariance(x))[0])
        positive = variances[0] > 0
        logs = jnp.log(jnp.where(positive[None], variances, 1))
        return jnp.where(positive, jnp.sum(self.held * logs, axis=0), jnp.inf)

    def slope_and_curvature(self, x: jax.Array) -> tuple[jax.Array, Symmetric]:
        """Gradient, (3, ...), and Hessian with respect to the origin (3, ...), in closed form.

        With the variances s_i, h_i = 1 for constrained axes, and M_a = dSigma/dx_a along the eigenvectors,
        the Hessian is

            sum_i h_i (M_ab,ii / s_i - M_a,ii M_b,ii / s_i^2) - 2 sum_(i<j) c_ij M_a,ij M_b,ij,

        with c_ij = 1 / (s_i s_j) for two constrained axes, 1 / (s_i (s_j - s_i)) if only i is, else 0.
        """
        at = x[0], x[1], x[2]
        values, axes = symmetric.eigh(self.covariance(x))
        tiny = float(jnp.finfo(self.dtype).tiny)
        s = jnp.maximum(jnp.stack(values), tiny)
        h = self.held
        first = h / s
        slopes = covariance_gradient(self.moments, at)
        turned = [dict(zip(INDEX_PAIRS, symmetric.along(slope, axes), strict=True)) for slope in slopes]
        between = {
            (i, j): first[i] / jnp.where(h[j] > 0, s[j], jnp.maximum(s[j] - s[i], tiny))
            for i, j in INDEX_PAIRS
            if i != j
        }

        def trace(m: Symmetric) -> jax.Array:
            one, two, three = (first[i] * symmetric.quadratic_form(axes[i], m, axes[i]) for i in range(3))
            return one + two + three

        def bend(a: int, b: int) -> jax.Array:
            total = jnp.zeros_like(s[0])
            for i in range(3):
                total = total - first[i] / s[i] * turned[a][i, i] * turned[b][i, i]
            for ij, weight in between.items():
                total = total - 2 * weight * turned[a][ij] * turned[b][ij]
            return total

        gradient = jnp.stack([sum(first[i] * turned[a][i, i] for i in range(3)) for a in range(3)])
        seconds = covariance_hessian(self.moments)
        hessian = tuple(trace(m) + bend(a, b) for m, (a, b) in zip(seconds, INDEX_PAIRS, strict=True))
        return gradient, cast(Symmetric, hessian)

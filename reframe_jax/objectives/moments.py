"""Second moments of the affine velocity maps of a window, an exact compression of the window.

Every objective depends on the samples only through the velocity covariance

    Sigma(p) = mean_k u(k; p) u(k; p)^T,      u(k; p) = a(k) + B(k) p,

whose six components are quadratic polynomials in p. A window needs 6 x 10 coefficients per frame type,
independent of the number of samples. Arrays have coefficients first and problems last, so that a search over
many problems is elementwise arithmetic on contiguous arrays.
"""

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry.symmetric import INDEX_PAIRS, Symmetric, Vector

__all__ = ["MONOMIALS", "add_variance", "component_moments", "covariance_at", "velocity_moments"]

MONOMIALS = tuple((a, b) for a in range(4) for b in range(a, 4))
"""Index pairs (a, b) into (1, px, py, pz), whose products are the monomials of the ten coefficients."""


def velocity_moments(maps: jax.Array, weights: jax.Array | None = None) -> jax.Array:
    """Compute the moments of affine velocity maps.

    Args:
        maps: (..., K, 3, 4), the matrix (a | B) of every sample: u = a + B p.
        weights: (..., K), >= 0, for a weighted mean over the samples; equal by default.

    Returns:
        (6, 10, ...), coefficients of Sigma(p); (6, 1, ...) for maps (..., K, 3, 1), which do not depend on a
        position.
    """
    components = jnp.moveaxis(maps, (-2, -1, -3), (0, 1, 2))
    return component_moments(components, None if weights is None else jnp.moveaxis(weights, -1, 0))


def component_moments(maps: jax.Array, weights: jax.Array | None = None) -> jax.Array:
    """Moments (6, 10, ...) of maps (3, 4, K, ...), or (6, 1, ...) of (3, 1, K, ...), components first."""
    weights = jnp.ones_like(maps[0, 0]) if weights is None else weights
    weighted = maps * (weights / jnp.sum(weights, axis=0, keepdims=True))[None, None]
    means = jnp.einsum("iak...,jbk...->iajb...", weighted, maps, precision="highest")
    one, other = np.array(INDEX_PAIRS).T[:, :, None]
    a, b = np.array([(0, 0)] if maps.shape[1] == 1 else MONOMIALS).T
    same = (a == b).reshape(1, -1, *[1] * (maps.ndim - 3))
    return means[one, a, other, b] + jnp.where(same, 0, means[one, b, other, a])


def add_variance(moments: jax.Array, variance: jax.Array) -> jax.Array:
    """Add a variance (...) in every direction to moments (6, columns, ...)."""
    return moments.at[np.array([0, 3, 5]), 0].add(variance)


def covariance_at(moments: jax.Array, position: Vector) -> Symmetric:
    """Evaluate Sigma(p) from moments (6, 10, ...), or (6, 1, ...) without a position, by Horner's rule."""
    q = [moments[:, m] for m in range(moments.shape[1])]
    total = q[0]
    if len(q) > 1:
        x, y, z = (p[None] for p in position)
        in_x = q[1] + x * q[4] + y * q[5] + z * q[6]
        in_y = q[2] + y * q[7] + z * q[8]
        total = q[0] + x * in_x + y * in_y + z * (q[3] + z * q[9])
    xx, xy, xz, yy, yz, zz = total
    return xx, xy, xz, yy, yz, zz

"""Reduce the velocities of a window to second moments, which determine every norm exactly.

The velocity of the origin p of a frame, in sample k, is u(k; p) = a(k) + B(k) p. The norms depend on the
samples only through the velocity covariance

    Sigma(p) = mean_k u(k; p) u(k; p)^T,

whose six components are quadratic polynomials in p. A window therefore needs 6 x 10 coefficients per frame
type for any number of samples. Arrays have coefficients first and problems last, so that a search over many
problems is elementwise arithmetic on contiguous arrays.
"""

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry.symmetric import INDEX_PAIRS, Symmetric, Vector

MONOMIALS = tuple((a, b) for a in range(4) for b in range(a, 4))
"""The ten monomials of a quadratic polynomial in p: pairs of indices into (1, px, py, pz), to multiply."""


def velocity_moments(maps: jax.Array) -> jax.Array:
    """Compute the coefficients (6, 10, ...) of Sigma(p) from velocity maps u = a + B p.

    The maps (a | B) of K samples are (3, 4, K, ...). Angular velocities have no origin: they are (3, 1, K,
    ...), with coefficients (6, 1, ...).
    """
    means = jnp.einsum("iak...,jbk...->iajb...", maps / maps.shape[2], maps, precision="highest")
    one, other = np.array(INDEX_PAIRS).T[:, :, None]
    a, b = np.array([(0, 0)] if maps.shape[1] == 1 else MONOMIALS).T
    same = (a == b).reshape(1, -1, *[1] * (maps.ndim - 3))
    return means[one, a, other, b] + jnp.where(same, 0, means[one, b, other, a])


def add_variance(moments: jax.Array, variance: jax.Array) -> jax.Array:
    """Add a variance (...), equal in all directions, to moments (6, 10, ...) or (6, 1, ...)."""
    return moments.at[np.array([0, 3, 5]), 0].add(variance)


def covariance_at(moments: jax.Array, position: Vector) -> Symmetric:
    """Evaluate the velocity covariance Sigma(p) by Horner's rule.

    Args:
        moments: (6, 10, ...) coefficients, or (6, 1, ...) for angular velocities.
        position: three arrays (...), m, components of p; ignored for angular velocities.

    Returns:
        Six arrays (...): the components xx, xy, xz, yy, yz, zz.
    """
    q = [moments[:, m] for m in range(moments.shape[1])]
    total = q[0]
    if len(q) > 1:
        x, y, z = (p[None] for p in position)
        in_x = q[1] + x * q[4] + y * q[5] + z * q[6]
        in_y = q[2] + y * q[7] + z * q[8]
        total = q[0] + x * in_x + y * in_y + z * (q[3] + z * q[9])
    return tuple(total)

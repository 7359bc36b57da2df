"""Exact compression of a window: the second moments of its affine velocity maps.

Every objective depends on the samples only through the velocity covariance

    Sigma(p) = mean_k u(k; p) u(k; p)^T,      u(k; p) = a(k) + B(k) p,

whose six components are quadratic polynomials in p: 6 x 10 coefficients per window and frame type,
whatever the number of samples. They are stored coefficients first, problems last, so that searching
many problems is elementwise arithmetic on contiguous arrays.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from reframe_jax.symmetric import INDEX_PAIRS, Symmetric, Vector

__all__ = [
    "MONOMIALS",
    "Coefficients",
    "covariance_at",
    "covariance_gradient",
    "pack_moments",
    "velocity_moments",
]

Coefficients = Sequence[Sequence[jax.Array]] | jax.Array
"""Moments by component and monomial: an array (6, 10, ...), or its entries."""

MONOMIALS = tuple((a, b) for a in range(4) for b in range(a, 4))
"""Pairs (a, b) whose product of (1, px, py, pz) is the monomial of each of the ten coefficients."""


def pack_moments(second: jax.Array) -> jax.Array:
    """Polynomial coefficients of Sigma(p) from the second moments of a map's entries.

    Args:
        second: (..., 12, 12) mean of ``m m^T``, m being the row-major 3x4 map (a | B).

    Returns:
        (6, 10, ...): component of Sigma (see :data:`symmetric.INDEX_PAIRS`) by monomial.
    """
    rows = []
    for i, j in INDEX_PAIRS:
        row = []
        for a, b in MONOMIALS:
            entry = second[..., 4 * i + a, 4 * j + b]
            row.append(entry if a == b else entry + second[..., 4 * i + b, 4 * j + a])
        rows.append(jnp.stack(row))
    return jnp.stack(rows)


def velocity_moments(maps: jax.Array, weights: jax.Array | None = None) -> jax.Array:
    """Moments of affine velocity maps.

    Args:
        maps: (..., K, 3, 4), the matrix (a | B) of every sample: u = a + B p.
        weights: optional (..., K), >= 0: the mean over samples becomes a weighted mean.

    Returns:
        (6, 10, ...), coefficients of Sigma(p). For maps of shape (..., K, 3, 1), which have no
        position, (6, 1, ...).
    """
    samples, columns = maps.shape[-3], maps.shape[-1]
    entries = maps.reshape(*maps.shape[:-2], 3 * columns)
    if weights is None:
        weighted = entries / samples
    else:
        weighted = entries * (weights / jnp.sum(weights, axis=-1, keepdims=True))[..., None]
    # tensor cores would round float32 to 10 bits, more than what separates constrained from free axes
    second = jnp.einsum("...km,...kn->...mn", weighted, entries, precision=jax.lax.Precision.HIGHEST)
    if columns == 1:
        return jnp.stack([second[..., i, j] for i, j in INDEX_PAIRS])[:, None]
    return pack_moments(second)


def covariance_at(moments: Coefficients, position: Vector) -> Symmetric:
    """Sigma(p), by Horner's rule.

    Args:
        moments: (6, 10, ...), or (6, 1, ...) for velocities that have no position.
        position: (px, py, pz), arrays over the problems.
    """
    if len(moments[0]) == 1:
        xx, xy, xz, yy, yz, zz = (moments[i][0] for i in range(6))
        return xx, xy, xz, yy, yz, zz
    x, y, z = position

    def component(q: Sequence[jax.Array] | jax.Array) -> jax.Array:
        in_x = q[1] + x * q[4] + y * q[5] + z * q[6]
        in_y = q[2] + y * q[7] + z * q[8]
        return q[0] + x * in_x + y * in_y + z * (q[3] + z * q[9])

    xx, xy, xz, yy, yz, zz = (component(moments[i]) for i in range(6))
    return xx, xy, xz, yy, yz, zz


def covariance_gradient(moments: Coefficients, position: Vector) -> tuple[Symmetric, ...]:
    """Derivatives of Sigma(p) with respect to px, py and pz."""
    x, y, z = position

    def slopes(q: Sequence[jax.Array] | jax.Array) -> Vector:
        return (
            q[1] + 2 * x * q[4] + y * q[5] + z * q[6],
            q[2] + x * q[5] + 2 * y * q[7] + z * q[8],
            q[3] + x * q[6] + y * q[8] + 2 * z * q[9],
        )

    xx, xy, xz, yy, yz, zz = (slopes(moments[i]) for i in range(6))
    return tuple((xx[a], xy[a], xz[a], yy[a], yz[a], zz[a]) for a in range(3))

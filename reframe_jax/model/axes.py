"""Principal axes that several covariances have in common (Flury & Gautschi 1986)."""

import jax
import jax.numpy as jnp
import numpy as np

__all__ = ["common_axes", "principal_axes", "sort_axes"]

_SWEEPS = 5
_PAIRS = ((0, 1), (0, 2), (1, 2))


def common_axes(covariances: jax.Array, weights: jax.Array) -> jax.Array:
    """Rotation that makes sum_s w_s sum_i log (V' C_s V)_ii smallest, by Jacobi's rotations.

    The axes of a single covariance are its eigenvectors. Coordinates that are not correlated at any scale
    stay as they are, and columns are not sorted.

    Args:
        covariances: (S, 3, 3), positive definite.
        weights: (S,).

    Returns:
        (3, 3), whose columns are the axes.
    """
    tiny = jnp.finfo(covariances.dtype).tiny ** 0.5

    def sweep(_: int, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        c, v = carry
        for i, j in _PAIRS:
            di, dj = (jnp.maximum(c[:, k, k], tiny) for k in (i, j))
            w = weights * (di - dj) / (di * dj)
            angle = jnp.arctan2(2 * jnp.sum(w * c[:, i, j]), jnp.sum(w * (di - dj))) / 2
            angle = jnp.mod(angle + np.pi / 4, np.pi / 2) - np.pi / 4
            cos, sin = jnp.cos(angle), jnp.sin(angle)
            both, turn = np.zeros((3, 3)), np.zeros((3, 3))
            both[i, i] = both[j, j] = 1
            turn[j, i], turn[i, j] = 1, -1
            q = np.eye(3) + (cos - 1) * both + sin * turn
            q = q.astype(c.dtype)
            c = jnp.einsum("ba,sbc,cd->sad", q, c, q)
            v = v @ q
        return c, v

    return jax.lax.fori_loop(0, _SWEEPS, sweep, (covariances, jnp.eye(3, dtype=covariances.dtype)))[1]


def sort_axes(axes: jax.Array, covariance: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Columns (3, 3) by their variance, ascending and right-handed, and those variances."""
    size = jnp.einsum("ai,ab,bi->i", axes, covariance, axes)
    order = jnp.argsort(size)
    axes = axes[:, order]
    turned = jnp.sum(axes[:, 0] * jnp.cross(axes[:, 1], axes[:, 2]))
    return axes.at[:, 0].multiply(jnp.where(turned < 0, -1, 1)), size[order]


def principal_axes(covariance: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Eigenvectors of a covariance (3, 3), by eigenvalue, ascending and right-handed; the eigenvalues."""
    lift = 1e-15 * jnp.trace(covariance) * jnp.eye(3, dtype=covariance.dtype)
    axes = common_axes((covariance + lift)[None], jnp.ones(1, covariance.dtype))
    return sort_axes(axes, covariance)

"""Exact compression of a window: the second moments of its affine velocity maps.

Every objective depends on the samples only through the velocity covariance

    Sigma(p) = mean_k u(k; p) u(k; p)^T,      u(k; p) = a(k) + B(k) p,

whose six components are quadratic polynomials in p: 6 x 10 coefficients per window and frame type,
whatever the number of samples. They are stored coefficients first, problems last, so that searching
many problems is elementwise arithmetic on contiguous arrays.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry.symmetric import INDEX_PAIRS, Symmetric, Vector

__all__ = [
    "MONOMIALS",
    "Coefficients",
    "add_covariance",
    "add_variance",
    "covariance_at",
    "covariance_gradient",
    "covariance_hessian",
    "covariance_on_line",
    "velocity_moments",
]

Coefficients = Sequence[Sequence[jax.Array]] | jax.Array
"""Moments by component and monomial: an array (6, 10, ...), or its entries."""

_Polynomial = Callable[[Sequence[jax.Array], Vector], jax.Array]  # of its coefficients and a point

MONOMIALS = tuple((a, b) for a in range(4) for b in range(a, 4))
"""Pairs (a, b) whose product of (1, px, py, pz) is the monomial of each of the ten coefficients."""


def velocity_moments(maps: jax.Array, weights: jax.Array | None = None) -> jax.Array:
    """Moments of affine velocity maps.

    Args:
        maps: (..., K, 3, 4), the matrix (a | B) of every sample: u = a + B p.
        weights: (..., K), >= 0, for a weighted mean over the samples; equal by default.

    Returns:
        (6, 10, ...), coefficients of Sigma(p). For maps of shape (..., K, 3, 1), which have no
        position, (6, 1, ...).
    """
    components = jnp.moveaxis(maps, (-2, -1, -3), (0, 1, 2))
    return component_moments(components, None if weights is None else jnp.moveaxis(weights, -1, 0))


def component_moments(maps: jax.Array, weights: jax.Array | None = None) -> jax.Array:
    """Moments of maps with components first, as :func:`kinematics.velocity_components` returns them.

    Args:
        maps: (3, 4, K, ...) or (3, 1, K, ...).
        weights: (K, ...), >= 0; equal by default.

    Returns:
        (6, 10, ...) or (6, 1, ...).
    """
    columns, samples = maps.shape[1:3]
    entries = maps.reshape(3 * columns, samples, *maps.shape[3:])
    if weights is not None:
        rows = _products(entries, weights / jnp.sum(weights, axis=0, keepdims=True))
    else:
        rows = _products(entries)

    def mean(i: int, a: int, j: int, b: int) -> jax.Array:
        first, second = sorted((columns * i + a, columns * j + b))
        return rows[first][second - first]

    if columns == 1:
        return jnp.stack([mean(i, 0, j, 0) for i, j in INDEX_PAIRS])[:, None]
    packed = []
    for i, j in INDEX_PAIRS:
        row = [mean(i, a, j, b) if a == b else mean(i, a, j, b) + mean(i, b, j, a) for a, b in MONOMIALS]
        packed.append(jnp.stack(row))
    return jnp.stack(packed)


def _products(entries: jax.Array, weights: jax.Array | None = None) -> list[jax.Array]:
    """Row i, (n - i, ...): products of entry i with itself and those after it, averaged over the samples.

    Args:
        entries: (n, K, ...).
        weights: (K, ...), of sum 1, or None for the mean.
    """
    weighted = entries / entries.shape[1] if weights is None else entries * weights[None]
    return [_add_up(weighted[i, None] * entries[i:]) for i in range(len(entries))]


def _add_up(x: jax.Array) -> jax.Array:
    """Sum over the samples, (m, K, ...) to (m, ...), as a few long additions.

    XLA's reduction adds one number after the other on a CPU; whole slices are added a vector at a time.
    """
    while x.shape[1] > 1:
        parts = min(8, x.shape[1])
        size = x.shape[1] // parts
        slices = [x[:, i * size : (i + 1) * size] for i in range(parts)]
        total, rest = (sum(slices[1:], slices[0])), x[:, parts * size :]
        x = jnp.concatenate([total, rest], axis=1) if rest.shape[1] else total
    return x[:, 0]


def add_covariance(moments: jax.Array, covariance: jax.Array) -> jax.Array:
    """Moments (6, columns, ...) of a covariance with a constant one, (6, ...), more."""
    first = (moments[:, 0] + covariance)[:, None]
    return jnp.concatenate([first, moments[:, 1:]], axis=1)


def add_variance(moments: jax.Array, variance: jax.Array) -> jax.Array:
    """Moments (6, columns, ...) of a covariance with a variance (...) more in every direction."""
    unit = jnp.asarray([1, 0, 0, 1, 0, 1], moments.dtype).reshape(6, *[1] * variance.ndim)
    return add_covariance(moments, unit * variance[None])


def covariance_at(moments: Coefficients, position: Vector) -> Symmetric:
    """Sigma(p), by Horner's rule.

    Args:
        moments: (6, 10, ...), or (6, 1, ...) for velocities that have no position.
        position: (px, py, pz), arrays over the problems.
    """
    if len(moments[0]) == 1:
        return _each_component(moments, position, lambda q, _: q[0])

    def value(q: Sequence[jax.Array], p: Vector) -> jax.Array:
        x, y, z = p
        in_x = q[1] + x * q[4] + y * q[5] + z * q[6]
        in_y = q[2] + y * q[7] + z * q[8]
        return q[0] + x * in_x + y * in_y + z * (q[3] + z * q[9])

    return _each_component(moments, position, value)


def covariance_gradient(moments: Coefficients, position: Vector) -> tuple[Symmetric, ...]:
    """Derivatives of Sigma(p) with respect to px, py and pz."""
    slopes: tuple[_Polynomial, ...] = (
        lambda q, p: q[1] + 2 * p[0] * q[4] + p[1] * q[5] + p[2] * q[6],
        lambda q, p: q[2] + p[0] * q[5] + 2 * p[1] * q[7] + p[2] * q[8],
        lambda q, p: q[3] + p[0] * q[6] + p[1] * q[8] + 2 * p[2] * q[9],
    )
    return tuple(_each_component(moments, position, slope) for slope in slopes)


def covariance_hessian(moments: Coefficients) -> tuple[Symmetric, ...]:
    """Second derivatives of Sigma(p), the same everywhere, by :data:`symmetric.INDEX_PAIRS` of p."""
    seconds = []
    for a, b in INDEX_PAIRS:
        monomial, factor = MONOMIALS.index((a + 1, b + 1)), 2.0 if a == b else 1.0
        xx, xy, xz, yy, yz, zz = (factor * moments[i][monomial] for i in range(6))
        seconds.append((xx, xy, xz, yy, yz, zz))
    return tuple(seconds)


def covariance_on_line(moments: Coefficients, direction: Vector) -> Symmetric:
    """The coefficient of l^2 in Sigma(p + l d), the same for every p."""

    def bend(q: Sequence[jax.Array], d: Vector) -> jax.Array:
        x, y, z = d
        return x * (x * q[4] + y * q[5] + z * q[6]) + y * (y * q[7] + z * q[8]) + z * z * q[9]

    return _each_component(moments, direction, bend)


def _each_component(moments: Coefficients, at: Vector, polynomial: _Polynomial) -> Symmetric:
    """Values of a polynomial with the coefficients of each component; of an array, those of all at once."""
    if isinstance(moments, jax.Array | np.ndarray):
        here = at[0][None], at[1][None], at[2][None]
        values = polynomial([moments[:, m] for m in range(moments.shape[1])], here)
        xx, xy, xz, yy, yz, zz = values
    else:
        xx, xy, xz, yy, yz, zz = (polynomial(q, at) for q in moments)
    return xx, xy, xz, yy, yz, zz

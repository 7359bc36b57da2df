"""Rotations: the group SO(3) as rotation vectors, matrices and quaternions.

Every function accepts any leading batch axes, keeps the dtype of its input, and has finite, accurate values
*and* derivatives everywhere, including the zero rotation and half turns. Functions such as sin(x)/x, which
are 0/0 at zero, are computed by a power series in the squared angle below one radian, and by the closed form
above. JAX differentiates both branches of a ``where``, so the unused branch gets an angle at which its
derivative is finite.

Conventions: rotation vectors are axis times angle, in radians; quaternions are (x, y, z, w).
"""

from functools import partial
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np

_CROSS = np.cross(np.eye(3)[:, None], np.eye(3)).transpose(0, 2, 1)  # [k, i, j]: of e_k x e_j along e_i
_TERMS = 10  # terms of each series below one radian; the first omitted term is < 1e-17
_SINC = tuple((-1) ** order / factorial(2 * order + 1) for order in range(_TERMS))
_VERSINE = tuple((-1) ** order / factorial(2 * order + 2) for order in range(_TERMS))
_SLACK = tuple((-1) ** order / factorial(2 * order + 3) for order in range(_TERMS))
_ARCTANGENT = tuple((-1) ** order / (2 * order + 1) for order in range(_TERMS))


def _series(x: jax.Array, coefficients: tuple[float, ...]) -> jax.Array:
    total = jnp.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total = total * x + coefficient
    return total


def _squared_length(vector: jax.Array) -> jax.Array:
    """Squared length (...) of vectors (..., n), term by term, because GPUs reduce three numbers slowly."""
    terms = [vector[..., i] * vector[..., i] for i in range(vector.shape[-1])]
    return sum(terms[1:], terms[0])


def _angle(rotvec: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Squared angle for the series, whether the angle is small, and the angle for the closed form."""
    squared = _squared_length(rotvec)
    small = squared < 1.0
    return jnp.where(small, squared, 0.0), small, jnp.sqrt(jnp.where(small, 1.0, squared))


def hat(vector: jax.Array) -> jax.Array:
    """Return the matrices [w]x (..., 3, 3) of vectors w (..., 3), such that ``hat(w) @ x == cross(w, x)``."""
    return jnp.sum(vector[..., None, None] * jnp.asarray(_CROSS, vector.dtype), axis=-3)


def _polynomial(vector: jax.Array, first: jax.Array, second: jax.Array) -> jax.Array:
    """I + first [v]x + second [v]x^2 by components, because products of many small matrices are slow."""
    unit = jnp.broadcast_to(jnp.eye(3, dtype=vector.dtype), (*vector.shape, 3))
    first, second, square = (x[..., None, None] for x in (first, second, _squared_length(vector)))
    outer = vector[..., :, None] * vector[..., None, :]
    return unit + first * hat(vector) + second * (outer - square * unit)


def vee(matrix: jax.Array) -> jax.Array:
    """Invert :func:`hat`: vectors (..., 3) of the skew-symmetric parts of matrices (..., 3, 3)."""
    skew = (matrix - jnp.swapaxes(matrix, -1, -2)) / 2
    return jnp.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)


_one_program = partial(jax.jit, inline=True)  # instead of one for each of forty operations


@_one_program
def rotation_exp(rotvec: jax.Array) -> jax.Array:
    """Convert rotation vectors (..., 3), rad, to rotation matrices (..., 3, 3): the exponential of SO(3)."""
    squared, small, angle = _angle(rotvec)
    sinc = jnp.where(small, _series(squared, _SINC), jnp.sin(angle) / angle)
    versine = jnp.where(small, _series(squared, _VERSINE), (1 - jnp.cos(angle)) / angle**2)
    return _polynomial(rotvec, sinc, versine)


@_one_program
def rotation_log(rotation: jax.Array) -> jax.Array:
    """Convert rotation matrices (..., 3, 3) to rotation vectors (..., 3), rad: the logarithm of SO(3).

    The length of a vector is at most pi. A half turn has two vectors, with opposite signs; the function
    returns one of them, with finite derivatives.
    """
    quaternion = rotation_to_quaternion(rotation)
    vector, w = quaternion[..., :3], quaternion[..., 3]
    squared = _squared_length(vector)
    small = squared < 1e-2
    length = jnp.sqrt(jnp.where(small, 1.0, squared))
    w_small = jnp.where(small, w, 1.0)
    # angle / sin(angle / 2) = 2 atan2(|vector|, w) / |vector|
    series = 2 / w_small * _series(squared / w_small**2, _ARCTANGENT)
    factor = jnp.where(small, series, 2 * jnp.arctan2(length, w) / length)
    return factor[..., None] * vector


@_one_program
def left_jacobian(rotvec: jax.Array) -> jax.Array:
    """Return the left Jacobians J_l (..., 3, 3) of SO(3) at rotation vectors w (..., 3), rad.

    They map a small change of the vector to a small rotation: ``exp(w + dw) ~ exp(J_l(w) dw) exp(w)``.
    """
    squared, small, angle = _angle(rotvec)
    versine = jnp.where(small, _series(squared, _VERSINE), (1 - jnp.cos(angle)) / angle**2)
    slack = jnp.where(small, _series(squared, _SLACK), (angle - jnp.sin(angle)) / angle**3)
    return _polynomial(rotvec, versine, slack)


@_one_program
def quaternion_to_rotation(quaternion: jax.Array) -> jax.Array:
    """Convert unit quaternions (..., 4), as (x, y, z, w), to rotation matrices (..., 3, 3)."""
    return _polynomial(quaternion[..., :3], 2 * quaternion[..., 3], jnp.full_like(quaternion[..., 3], 2))


@_one_program
def rotation_to_quaternion(rotation: jax.Array) -> jax.Array:
    """Convert rotation matrices (..., 3, 3) to unit quaternions (..., 4), as (x, y, z, w), with w >= 0.

    The matrix ``4 q q^T`` is linear in the rotation matrix. The function normalizes its row with the largest
    diagonal entry, which is at least 1 (Shepperd's method), so it never divides by a small number.
    """
    r = [[rotation[..., i, j] for j in range(3)] for i in range(3)]
    diagonal = xx, yy, zz, ww = (
        1 + r[0][0] - r[1][1] - r[2][2],
        1 - r[0][0] + r[1][1] - r[2][2],
        1 - r[0][0] - r[1][1] + r[2][2],
        1 + r[0][0] + r[1][1] + r[2][2],
    )
    xy, xz, yz = r[0][1] + r[1][0], r[0][2] + r[2][0], r[1][2] + r[2][1]
    xw, yw, zw = r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]
    rows = (xx, xy, xz, xw), (xy, yy, yz, yw), (xz, yz, zz, zw), (xw, yw, zw, ww)
    best, row = diagonal[3], rows[3]
    for entry, candidate in zip(diagonal[:3], rows[:3], strict=True):
        better = entry > best
        best = jnp.where(better, entry, best)
        x, y, z, w = (jnp.where(better, new, old) for new, old in zip(candidate, row, strict=True))
        row = x, y, z, w
    x, y, z, w = row
    length = jnp.sqrt(x * x + y * y + z * z + w * w)
    length = jnp.where(w < 0, -length, length)
    return jnp.stack([x / length, y / length, z / length, w / length], axis=-1)

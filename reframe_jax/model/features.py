"""Features of a pose; every condition that a constraint imposes is linear in these features.

A coordinate of a constraint is w'z with constant weights w and 27 features z of a pose:

    p | R (row by row) | R'p | integral of w_b | integral of v_b | integral of w_g | integral of v_g

with (w_b, v_b) the body twist and (w_g, v_g) the spatial twist. The tip x of a tool along the normal n of a
plane, for instance, is n'(p + R x). Every constraint therefore needs only the second moments of z.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry.rotations import hat
from reframe_jax.geometry.small import cross, normalize, pick, times, total, unit_matrix
from reframe_jax.motion.paths import twist_paths

Array = jax.Array
COUNT = 27
POSITION, ROTATION, IN_BODY = slice(0, 3), slice(3, 12), slice(12, 15)
TURN_BODY, SHIFT_BODY, TURN_GROUND, SHIFT_GROUND = slice(15, 18), slice(18, 21), slice(21, 24), slice(24, 27)

_SENSITIVE = 8  # poses at which the sensitivity of the features to a pose is evaluated


class Features(NamedTuple):
    """Features of N windows.

    Attributes:
        values: (N, 27, P) features of every pose; positions are relative to their mean.
        to_position: (N, M, 27, 3) derivatives by the position, at M poses of the window.
        to_rotation: (N, M, 27, 3) derivatives by a small rotation in {b}, rad, at the same poses.
        mean_matrix: (N, 3, 3) mean of all R.
        mean_rotation: (N, 3, 3) the rotation nearest to it.
    """

    values: Array
    to_position: Array
    to_rotation: Array
    mean_matrix: Array
    mean_rotation: Array


def pose_features(
    rotation: Array, position: Array, steps: Array, count: Array, about_mean: Array | bool = False
) -> Features:
    """Compute the features of the poses of N windows.

    Poses are rotations (3, 3, P, N) and positions (3, P, N), m, relative to the mean, of {b} in {g}. Time
    steps are (1, K) or (N, K), s; ``count`` (N,) is the number of poses before the padding. With
    ``about_mean`` () bool, logarithms relative to the mean pose replace the integrals.
    """
    own = jnp.arange(position.shape[1])[:, None] < count
    matrix = jnp.sum(jnp.where(own, rotation, 0), axis=2) / count.astype(position.dtype)
    mean = nearest_rotation(matrix)
    turns, shifts = twist_paths(rotation, position, steps, count, mean, about_mean)
    rows = [position, rotation.reshape(9, *position.shape[1:]), times(jnp.swapaxes(rotation, 0, 1), position)]
    rows += [turns[:, 0], shifts[:, 0], turns[:, 1], shifts[:, 1]]
    values = jnp.moveaxis(jnp.concatenate(rows), -1, 0)
    chosen = ((count - 1)[:, None] * np.linspace(0, 1, _SENSITIVE)).astype(jnp.int32)
    here = jnp.swapaxes(pick(values, chosen[:, None], 2), 1, 2)
    means = (jnp.moveaxis(each, -1, 0) for each in (matrix, mean))
    return Features(values, *_sensitivity(here), *means)


def nearest_rotation(matrix: Array) -> Array:
    """Return the rotation nearest to matrices (3, 3, ...), by Newton's iteration for the polar factor.

    The nearest rotation of a nearly singular matrix is not unique. The iteration is therefore damped, and
    Gram-Schmidt makes its result orthogonal.
    """

    def step(_: int, x: Array) -> Array:
        cofactors = jnp.stack([cross(x[i - 2], x[i - 1]) for i in range(3)])
        det = total(x[0] * cofactors[0], 0)
        return (x + cofactors / jnp.where(jnp.abs(det) < 1e-9, 1e-9, det)) / 2

    x = jax.lax.fori_loop(0, 14, step, matrix + 1e-9 * unit_matrix(matrix.dtype, matrix.ndim - 2))
    u = normalize(x[:, 0])
    v = normalize(x[:, 1] - u * total(u * x[:, 1], 0))
    return jnp.stack([u, v, cross(u, v)], axis=1)


def _sensitivity(values: Array) -> tuple[Array, Array]:
    """Derivatives of features (..., 27) with respect to the pose, (..., 27, 3) each.

    The integral of a twist up to a pose is differentiated by this pose only.
    """
    p, q = values[..., POSITION], values[..., IN_BODY]
    rotation = values[..., ROTATION].reshape(*values.shape[:-1], 3, 3)
    unit = jnp.broadcast_to(jnp.eye(3, dtype=values.dtype), rotation.shape)
    zero = jnp.zeros_like(unit)
    inverse = jnp.swapaxes(rotation, -1, -2)
    # R exp(d): every row r of R changes by r x d
    turned = hat(rotation).reshape(*values.shape[:-1], 9, 3)
    to_position = jnp.concatenate([unit, jnp.zeros_like(turned), inverse, zero, inverse, zero, unit], axis=-2)
    lever = jnp.cross(p[..., None], rotation, axis=-2)
    return to_position, jnp.concatenate([zero, turned, hat(q), unit, zero, rotation, lever], axis=-2)

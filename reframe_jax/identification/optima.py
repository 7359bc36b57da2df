"""Compute, for the best frame of every type, its axes, the RMS velocities along them, and its norm."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry.symmetric import ascending_eigh
from reframe_jax.model.moments import Moments
from reframe_jax.model.solve import Searched
from reframe_jax.model.table import KINDS, LINEAR_KINDS, ROWS
from reframe_jax.objectives.moments import covariance_at
from reframe_jax.objectives.norms import log_power_mean

Array = jax.Array
TURN_KINDS = np.array([KINDS.index("turn in ground"), KINDS.index("turn in body")])
"""(2,) codes in ``KINDS`` of rotations about axes fixed in the ground and in the body, by ``AngularType``."""


class Types(NamedTuple):
    """The best frames of all types; angular types are G and B, linear types are BB, GB, GG and BG."""

    angular_axes: Array  # (2, 3, 3), columns are the axes
    linear_axes: Array  # (4, 3, 3), columns are the axes
    angular_rms: Array  # (2, 3) rad/s
    linear_rms: Array  # (4, 3) m/s
    angular_norm: Array  # (2,) rad/s
    linear_norm: Array  # (4,) m/s


def smallest_scale(used: Moments) -> Array:
    """Return which of the S scales is the smallest scale that a window uses, (S,) bool."""
    here = used.details > 0
    return here & (jnp.cumsum(here) == 1)


def rms_velocities(weights: Array, used: Moments) -> Array:
    """Compute the RMS velocities (3,), m/s or rad/s, at the smallest scale that the window uses.

    The weights (3, 27) are those of the features in each coordinate. The RMS velocity is the RMS displacement
    over the RMS duration, because displacements in longer steps are larger.
    """
    smallest = smallest_scale(used)
    products = jnp.sum(jnp.where(smallest[:, None, None], used.products, 0), axis=0)
    square = jnp.einsum("if,fg,ig->i", weights, products, weights)
    return jnp.sqrt(jnp.maximum(square, 1e-30) / jnp.sum(jnp.where(smallest, used.durations[:, -1], 0)))


def types_over_scales(searched: Searched, used: Moments) -> Types:
    """Compute the best frames of one window over its time scales."""
    angular, linear, dtype = searched.angular_axes, searched.linear_axes, used.products.dtype
    points = jnp.concatenate([jnp.ones((4, 1), dtype), searched.origins], axis=1)
    rows = jnp.einsum("tiaf,ta->tif", jnp.asarray(ROWS[LINEAR_KINDS], dtype), points)
    rows = jnp.concatenate([jnp.asarray(ROWS[TURN_KINDS][:, :, 0], dtype), rows])
    rows = jnp.einsum("tai,taf->tif", jnp.concatenate([angular, linear]), rows)
    speeds = jax.vmap(partial(rms_velocities, used=used))(rows)
    # log det Sigma, from the covariances along common axes, which are almost independent
    sigma = jnp.einsum("tif,sfg,tjg->ijts", rows, used.products, rows)
    first, second, third = (sigma[i, i] + 1e-30 for i in range(3))
    a, b, c = sigma[0, 1] / first, sigma[1, 2] / second, sigma[2, 0] / third
    rest = 1 - sigma[0, 1] * a / second - sigma[1, 2] * b / third - sigma[2, 0] * c / first + 2 * a * b * c
    logs = jnp.log(first * jnp.maximum(rest, jnp.finfo(dtype).eps)) + jnp.log(second) + jnp.log(third)
    duration = jnp.log(jnp.where(used.details > 0, used.durations[:, -1], 1))
    norm = jnp.exp(jnp.sum(used.details * (logs / 3 - duration), axis=1) / 2 / jnp.sum(used.details))
    return Types(angular, linear, *jnp.split(speeds, [2]), *jnp.split(norm, [2]))


def types_of_steps(moments: tuple[Array, Array], searched: Searched, exponent: float) -> Types:
    """Compute the best frames of N windows by the paper's norm of the velocities of single steps.

    The moments are those of :func:`.step_moments`; of the result of the model, only the origins are used. The
    exponent is that of the power mean over the axes. The result has a leading axis (N,).
    """
    angular, linear = moments
    zero = jnp.zeros_like(angular[0, 0])
    x = jnp.moveaxis(searched.origins, -1, 0)
    of_angular = covariance_at(angular, (zero, zero, zero))
    of_linear = covariance_at(linear, (x[0], x[1], x[2]))
    every = [jnp.concatenate(pair, axis=1) for pair in zip(of_angular, of_linear, strict=True)]
    values, axes = ascending_eigh(tuple(every))
    rms = jnp.sqrt(jnp.maximum(values, jnp.finfo(values.dtype).tiny))
    axes = axes * jnp.where(jnp.arange(3) == 0, jnp.sign(jnp.linalg.det(axes))[..., None, None], 1)
    norm = jnp.exp(log_power_mean(jnp.moveaxis(jnp.log(rms), -1, 0), exponent))
    return Types(*(part for of in (axes, rms, norm) for part in (of[:, :2], of[:, 2:])))

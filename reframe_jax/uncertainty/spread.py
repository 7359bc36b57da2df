"""Covariance of a fit from its likelihood, and normalized distances between two fits."""

import jax
import jax.numpy as jnp

from reframe_jax.calibration.robust import NORMAL_FACTOR, student_factor
from reframe_jax.model.fit import Data, Parameters, coordinates, held_covariance, move
from reframe_jax.model.table import Table

__all__ = ["distances", "information", "posterior", "row_precision", "spread_of_fit", "student_variance"]

Array = jax.Array

_GROUPS = slice(0, 3), slice(3, 6), slice(6, 9)  # angular axes, linear axes, origin
_FEWEST = 2.0  # fewest degrees of freedom of Student's distribution
_KNOWN = 1e-9  # fraction of the largest variance below which a variance counts as zero


def row_precision(parameters: Parameters, data: Data, entry: Table) -> Array:
    """Inverse covariance (S, 2, 6, 6) of constrained coordinates by scale, for rotations and translations."""
    weights = coordinates(parameters, data.mean_rotation, entry)
    covariance = held_covariance(weights, data.products, entry)
    unit = jnp.sqrt(jnp.diagonal(covariance, axis1=2, axis2=3))
    inverse = jnp.linalg.inv(covariance / unit[..., :, None] / unit[..., None, :])
    inverse = inverse / unit[..., :, None] / unit[..., None, :]
    whole = jnp.zeros((len(inverse), 2, 6, 6), inverse.dtype)
    whole = whole.at[:, 0, :3, :3].set(inverse[:, 0]).at[:, 1, 3:, 3:].set(inverse[:, 1])
    return jnp.where(entry.held[:, None] & entry.held[None], whole, 0)


def information(parameters: Parameters, precision: Array, motion: Data, entry: Table) -> Array:
    """Fisher information (S, 2, 9, 9) of the parameters by scale, from rotations and from translations.

    Args:
        parameters: parameters of the constraint.
        precision: (S, 2, 6, 6) inverse covariances of :func:`row_precision`.
        motion: statistics of the motion.
        entry: row of the table of constraints.
    """

    def weights_after(step: Array) -> Array:
        return coordinates(move(parameters, step, motion.box), motion.mean_rotation, entry)

    slopes = jax.jacfwd(weights_after)(jnp.zeros(9, precision.dtype))
    through = jnp.einsum("ifp,sfg,jgq->sipjq", slopes, motion.products, slopes)
    found = jnp.einsum("sipjq,stij->stpq", through, precision)
    return found * motion.details[:, None, None, None]


def posterior(total: Array, prior: Array) -> Array:
    """Covariance (9, 9) of parameters from their information (9, 9) and prior standard deviations (9,)."""
    precision = total + jnp.diag(1 / jnp.square(prior))
    unit = 1 / jnp.sqrt(jnp.diagonal(precision))
    return unit[:, None] * unit[None] * jnp.linalg.inv(precision * unit[:, None] * unit[None])


def student_variance(freedom: Array) -> Array:
    """Variance of the normal distribution with the same 95 % interval as Student's distribution."""
    return jnp.square(student_factor(freedom) / NORMAL_FACTOR)


def spread_of_fit(
    parameters: Parameters, data: Data, slopes: Array, entry: Table, prior: Array
) -> tuple[Array, Array]:
    """Covariance of the nine components, (9, 9), and of the tilt, (2, 2).

    The variances of constrained coordinates are estimates from the independent values of each scale. The
    degrees of freedom follow from Welch and Satterthwaite; each scale has a weight proportional to its
    information.

    Args:
        parameters: fitted parameters.
        data: statistics to which the parameters were fitted.
        slopes: (9, 9) derivative of the components with respect to a step of the parameters.
        entry: row of the table of constraints.
        prior: (9,) prior standard deviations of the parameters.
    """
    each = information(parameters, row_precision(parameters, data, entry), data, entry)
    covariance = posterior(jnp.sum(each, axis=(0, 1)), prior)
    influence = covariance @ slopes.T
    part = (
        jnp.einsum("pn,stpq,qn->nst", influence, each, influence).reshape(3, 3, *each.shape[:2]).sum(axis=1)
    )
    tiny = jnp.finfo(part.dtype).tiny ** 0.5
    part = part / (jnp.sum(part, axis=(1, 2), keepdims=True) + tiny)
    number = 1 / (jnp.sum(jnp.square(part) / jnp.maximum(data.details, 0.5)[:, None], axis=(1, 2)) + 1e-6)
    freedom = jnp.maximum(number - 1, _FEWEST)
    factor = jnp.repeat(jnp.sqrt(student_variance(freedom) * jnp.maximum(number / freedom, 1)), 3)
    return slopes @ influence * factor[:, None] * factor[None], covariance[6:8, 6:8]


def distances(apart: Array, covariance: Array) -> Array:
    """Squared Mahalanobis distances (3,) per dimension, of components (9,) with covariance (9, 9).

    Their mean is 1 for normal errors; a group without dimensions has the value 1.
    """
    found = []
    for rows in _GROUPS:
        square, number, _ = _distance(apart[rows], covariance[rows, rows])
        found.append(jnp.where(number > 0, square / jnp.maximum(number, 1), 1))
    return jnp.stack(found)


def slow_error(apart: Array, covariance: Array) -> Array:
    """Part (9,) of the difference (9,) of two estimates that their covariance (9, 9) does not explain.

    Squared Mahalanobis distances up to 2 d in the d dimensions of a group count as explained.
    """
    found = []
    for rows in _GROUPS:
        square, number, known = _distance(apart[rows], covariance[rows, rows])
        beyond = jnp.maximum(0, 1 - 2 * number / jnp.maximum(square, jnp.finfo(square.dtype).tiny))
        found.append(jnp.sqrt(beyond) * known)
    return jnp.concatenate(found)


def _distance(apart: Array, covariance: Array) -> tuple[Array, Array, Array]:
    """Squared Mahalanobis distance, number of dimensions with a variance, and components in these."""
    values, axes = jnp.linalg.eigh(covariance)
    known = values > _KNOWN * values[-1]
    along = jnp.where(known, axes.T @ apart, 0)
    return jnp.sum(jnp.square(along) / jnp.where(known, values, 1)), jnp.sum(known), axes @ along

"""Covariance of a fit from its likelihood, widened by differences between estimates."""

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.calibration.robust import NORMAL_FACTOR, student_factor
from reframe_jax.geometry.small import invert_symmetric, solve_positive
from reframe_jax.geometry.symmetric import INDEX_PAIRS, ascending_eigh
from reframe_jax.model.fit import held_covariance
from reframe_jax.uncertainty.refit import BLOCKS, SPANS, Refit

Array = jax.Array

_GROUPS = slice(0, 3), slice(3, 6), slice(6, 9)  # angular axes, linear axes, origin
_FEWEST = 2.0  # fewest degrees of freedom of Student's distribution
_FEWEST_POSES = 8  # of a part
_LENGTHS = np.array([1, *(1 / parts for _, parts in SPANS)])  # of the window and of its spans, in windows
_HALVES, _THIRDS = ((1, 2),), ((3, 4), (3, 5), (4, 5))  # pairs of disjoint parts to compare; 0 is the window
_SET = np.repeat(range(3), (1, len(_HALVES), len(_THIRDS)))  # of each pair: redundant axes, halves, thirds
_KNOWN = 1e-9  # fraction of the largest variance below which a variance counts as zero
# mean squared distances (1 by chance) up to which no difference is added, and from which all of it is
_CHANCE, _SIGNIFICANT = 3.0, 4.0
_PRIOR = 0.03  # information of the prior of a part, as a fraction of what a part of its length has on average


def _row_precision(fit: Refit) -> Array:
    """Inverse covariance (S, 2, 6, 6) of constrained coordinates by scale, for rotations and translations."""
    covariance = held_covariance(fit.weights, fit.products, fit.entry)
    inverse, _ = invert_symmetric([covariance[..., i, j] for i, j in INDEX_PAIRS])
    inverse = jnp.moveaxis(inverse, (0, 1), (-2, -1))
    whole = jnp.zeros((len(inverse), 2, 6, 6), inverse.dtype)
    whole = whole.at[:, 0, :3, :3].set(inverse[:, 0]).at[:, 1, 3:, 3:].set(inverse[:, 1])
    return jnp.where(fit.entry.held[:, None] & fit.entry.held[None], whole, 0)


def information(fit: Refit, products: Array, details: Array) -> tuple[Array, Array]:
    """Fisher information and gradient of the negative log-likelihood, from rotations and from translations.

    The result is the information (S, 2, 9, 9) about the parameters from a motion with these moments
    (S, 27, 27) and independent details (S,), and the gradient (S, 2, 9), by scale. Errors are as large as in
    the fit.
    """
    slopes = jnp.concatenate([fit.weight_slopes, fit.weights[:, :, None]], axis=2)
    through = jnp.einsum("ifp,sfg,jgq->sipjq", slopes, products, slopes)
    found = jnp.einsum("sipjq,stij->stpq", through, _row_precision(fit)) * details[:, None, None, None]
    return found[..., :9, :9], found[..., :9, 9]


def _posterior(total: Array, prior: Array) -> Array:
    """Covariance (9, 9) of parameters from their information (9, 9) and prior standard deviations (9,)."""
    precision = total + jnp.diag(1 / jnp.square(prior))
    unit = 1 / jnp.sqrt(jnp.diagonal(precision))
    scaled = precision * unit[:, None] * unit[None]
    return unit[:, None] * unit[None] * solve_positive(scaled[:, :, None], jnp.eye(9, dtype=unit.dtype))


def covariances_of_motions(fit: Refit, products: Array, details: Array, known: Array | float = 0.0) -> Array:
    """Covariances (M, 9, 9) of the components from the moments of M motions, with the errors of one fit.

    The information ``known`` (9, 9) about the parameters is added to that of each motion.
    """

    def of_one(products: Array, details: Array) -> Array:
        total = known + jnp.sum(information(fit, products, details)[0], axis=(0, 1))
        return fit.slopes @ _posterior(total, fit.prior) @ fit.slopes.T

    return jax.vmap(of_one)(products, details)


def combine_parts(refit: Refit, *, parts: str) -> tuple[Array, Array]:
    """Covariance (9, 9) of one window, and its inflation (3,), from the fits of its parts."""
    if parts == "blocks":  # the jackknife
        rest = refit.numbers[1:] - jnp.mean(refit.numbers[1:], axis=0)
        matrix = rest.T @ rest * (BLOCKS - 1) / BLOCKS * _student_variance(jnp.asarray(BLOCKS - 1.0))
        return matrix, jnp.ones(3, matrix.dtype)
    own, redundant, white = jax.vmap(_spread_of_fit)(refit)
    matrix = own[0]
    if parts == "whole":
        return matrix, jnp.ones(3, matrix.dtype)
    # widen by the differences of redundant axes, halves and thirds
    estimates, covariances = _parts_with_prior(refit, own)
    i, j = np.concatenate([_HALVES, _THIRDS]).T
    long = [jnp.all(refit.poses[np.ravel(pairs)] >= _FEWEST_POSES) for pairs in (_HALVES, _THIRDS)]
    used = jnp.stack([jnp.asarray(True), *long])[_SET][:, None, None]
    apart = jnp.concatenate([redundant[0].reshape(1, 3, 3), estimates[i] - estimates[j]])
    chance = jnp.concatenate([_blocks(white[0])[None], covariances[i] + covariances[j]])
    widened = widen(matrix, jnp.where(used, apart, 0), jnp.where(used[..., None], chance, 0), _SET)
    sizes = [jnp.diagonal(of).reshape(3, 3).sum(axis=1) for of in (widened, matrix)]
    return widened, jnp.where(sizes[1] > 0, jnp.sqrt(sizes[0] / sizes[1]), 1)


def _student_variance(freedom: Array) -> Array:
    """Variance of the normal distribution with the same 95 % interval as Student's distribution."""
    return jnp.square(student_factor(freedom) / NORMAL_FACTOR)


def _spread_of_fit(fit: Refit) -> tuple[Array, Array, Array]:
    """Covariance (9, 9) of one part, the difference (9,) of two estimates, and its covariance (9, 9).

    The variances of constrained coordinates are estimates from the independent values of each scale. The
    degrees of freedom follow from Welch and Satterthwaite, with the information of the scales as weights.
    If the constraint has one axis through both bodies, the tilt is the difference between its estimates.
    Otherwise one estimate is from rotations, and the other from translations, each after one scoring step.
    The covariance of the difference is for white errors.
    """
    details, slopes, entry, prior = fit.details, fit.slopes, fit.entry, fit.prior
    each, gradient = information(fit, fit.products, details)
    by_kind = jnp.sum(each, axis=0)
    total, rotations, translations = jax.vmap(_posterior, in_axes=(0, None))(
        jnp.concatenate([jnp.sum(by_kind, axis=0)[None], by_kind]), prior
    )
    influence = total @ slopes.T
    part = jnp.einsum("pn,stpq,qn->nst", influence, each, influence)
    part = part.reshape(3, 3, *each.shape[:2]).sum(axis=1)
    tiny = jnp.finfo(part.dtype).tiny ** 0.5
    part = part / (jnp.sum(part, axis=(1, 2), keepdims=True) + tiny)
    number = 1 / (jnp.sum(jnp.square(part) / jnp.maximum(details, 0.5)[:, None], axis=(1, 2)) + 1e-6)
    freedom = jnp.maximum(number - 1, _FEWEST)
    factor = jnp.repeat(jnp.sqrt(_student_variance(freedom) * jnp.maximum(number / freedom, 1)), 3)
    score = jnp.sum(gradient, axis=0)
    step = translations @ score[1] - rotations @ score[0]
    step = jnp.where(entry.tied, jnp.zeros_like(prior).at[:2].set(fit.tilt), step)
    tilt = jnp.zeros_like(total).at[:2, :2].set(total[6:8, 6:8])
    chance = jnp.where(entry.tied, tilt, rotations + translations)
    covariance = slopes @ influence * factor[:, None] * factor[None]
    return covariance, slopes @ step, slopes @ chance @ slopes.T


def _parts_with_prior(refit: Refit, own: Array) -> tuple[Array, Array]:
    """Estimates of parts, with the estimate of the whole window as a weak prior.

    A part that hardly moves has an arbitrary estimate, and the curvature of its fit is misleading. The weight
    of the prior follows from the motion of the part, with the errors of the whole window. A direction that
    the part does not determine keeps the estimate of the whole window.

    ``own`` (M, 9, 9) are the covariances of the components from the curvature of each fit. The result is the
    components (M, 3, 3) of the estimates, by group, and their covariances (M, 3, 3, 3) for white errors: the
    mean of the covariances from the errors of the part and of the whole window.
    """
    moved = jax.vmap(_blocks)(covariances_of_motions(refit.of_whole(), refit.products, refit.details))
    values, axes, known = _principal(moved[0] + _PRIOR * _LENGTHS[:, None, None, None] * moved)
    inverse = jnp.where(known, 1 / jnp.where(known, values, 1), 0)
    weight = (1 + _PRIOR) * moved[0] @ jnp.einsum("mgij,mgj,mgkj->mgik", axes, inverse, axes)
    estimates = jnp.einsum("mgij,mgj->mgi", weight, refit.numbers.reshape(-1, 3, 3))
    white = (moved + jax.vmap(_blocks)(own)) / 2
    return estimates, weight @ white @ jnp.swapaxes(weight, 2, 3)


def widen(covariance: Array, apart: Array, chance: Array, sets: np.ndarray) -> Array:
    """Covariance (9, 9) with 95 % intervals at least as wide as the differences of P pairs of estimates.

    The covariance is multiplied by the largest mean squared distance of a set, if it exceeds 1. Then, in each
    group, the largest squared differences of parts and of redundant axes are added in all directions, because
    a slow error can have any direction. They are added only beyond chance, by the mean squared distance of
    their set; so is the multiplication by the distance of redundant axes.

    The covariance (9, 9) of the components and those of the differences, ``chance`` (P, 3, 3, 3), are for
    white errors; ``apart`` (P, 3, 3) are the differences by group, and ``sets`` (P,) int has 0 for redundant
    axes, and other numbers for pairs of equally long parts.
    """
    # squared Mahalanobis distances, numbers of dimensions with a variance, and components in these dimensions
    values, axes, known = _principal(chance)
    along = jnp.where(known, jnp.einsum("pgij,pgi->pgj", axes, apart), 0)
    square = jnp.sum(jnp.square(along) / jnp.where(known, values, 1), axis=2)
    number, apart = jnp.sum(known, axis=2), jnp.einsum("pgij,pgj->pgi", axes, along)
    same = sets[:, None] == sets
    mean = same / np.sum(same, axis=1, keepdims=True) @ (square / jnp.maximum(number, 1))
    counted = jnp.clip((mean - _CHANCE) / (_SIGNIFICANT - _CHANCE), 0, 1)
    factor = jnp.where((sets > 0)[:, None], mean, 1 + counted * (mean - 1))
    widened = covariance * jnp.maximum(1, jnp.max(factor))
    variance = counted * jnp.sum(jnp.square(apart), axis=2) / NORMAL_FACTOR**2
    between = jnp.max(variance[sets > 0], axis=0) + jnp.max(variance[sets == 0], axis=0)
    _, axes, known = _principal(_blocks(covariance))
    added = jnp.einsum("g,gij,gj,gkj->gik", between, axes, known, axes)
    return widened + jax.scipy.linalg.block_diag(*added)


def _blocks(covariance: Array) -> Array:
    """Covariances (3, 3, 3) of the three groups of components."""
    return jnp.stack([covariance[rows, rows] for rows in _GROUPS])


def _principal(groups: Array) -> tuple[Array, Array, Array]:
    """Variances (..., 3) and principal axes (..., 3, 3) of covariances; whether a variance exceeds zero."""
    values, axes = ascending_eigh(tuple(groups[..., i, j] for i, j in INDEX_PAIRS))
    return values, axes, values > _KNOWN * values[..., -1:]

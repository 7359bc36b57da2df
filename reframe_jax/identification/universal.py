"""Universal joints: two axes, one fixed in each body, between which the angle never changes.

Such a body turns about three directions, one after the other, and neither body sees a direction about which
it never turns: to a frame it looks like a ball in its socket. The angle between a, fixed in the ground, and
b, fixed in the body, tells them apart: a^T R b is constant. Its variance is a quadratic form of a for every
b, and of b for every a. The path moments of the type GB, whose maps hold R, have all its coefficients.

All arrays have components first and windows last.
"""

from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from reframe_jax.arrays import jnp, lax, linalg
from reframe_jax.compilation import as_one_kernel, update_marked
from reframe_jax.constraints.types import AngularType
from reframe_jax.geometry import symmetric
from reframe_jax.geometry.products import matmul3
from reframe_jax.geometry.symmetric import INDEX_PAIRS, PACKED
from reframe_jax.identification.coupled_axes import universal_probability
from reframe_jax.identification.evidence import IN_BODY, Evidence
from reframe_jax.identification.floored_moments import rounding_of
from reframe_jax.identification.optima import constant_covariance
from reframe_jax.motion.components import product, unit
from reframe_jax.objectives.moments import MONOMIALS, covariance_at

__all__ = ["Universal", "find_universal"]

_MATRICES = 4  # that searches start from, from each of three pairs of axes
_LEAST_NOISE = 1e-3  # square of what noise of one radian does to a matrix, at least
_ROUNDS = 8
_DAMPING = 0.0, 1e-3, 1e-1  # of steps
_LEAST_SINE = 1e-4  # its square
_TIMES = [1 if a == b else 2 for a, b in INDEX_PAIRS]  # that a product of entries is in a quadratic form
_PAIR = np.array(PACKED)
_SIGN = np.array([[0, 1, -1], [-1, 0, 1], [1, -1, 0]])  # of the permutation that begins with two indices
_THIRD = np.array([[0, 2, 1], [2, 0, 0], [1, 0, 0]])  # its last index
_SKEWED = 0.01  # square of the sine of the angle between the axes, at least


class Universal(NamedTuple):
    """The universal joints that N windows would show.

    Attributes:
        probability: (N,) of a universal joint, against a spherical one.
        axes: (N, 2, 3) the axis in {g} and the axis in {b}.
    """

    probability: jax.Array
    axes: jax.Array


def find_universal(
    evidence: Evidence, angular_axes: jax.Array, position: jax.Array, turns: jax.Array
) -> Universal:
    """Find the two axes, and how probable it is that the body turns about them alone.

    Args:
        evidence: of N windows.
        angular_axes: (N, 2, 3, 3) of both angular types; columns, from the slowest to the fastest.
        position: (N, 3) m, the point of {b} that the body turns about.
        turns: (N,) bool, windows that turn about more than one axis, and have no free translation. The others
            have probability 0.
    """
    evidence, angular_axes, position = lax.stop_gradient((evidence, angular_axes, position))
    pairs, mean = _pairs(evidence.linear_spread[..., IN_BODY]), evidence.mean_paths[:, 1:, :, 0]
    none = jnp.zeros((3, len(turns)), pairs.dtype)
    ground, body, change = update_marked(_search, turns, (pairs, mean), (none, none, none[0]))
    probability = as_one_kernel(_judge, evidence, (ground, body), change, angular_axes, position)
    return Universal(jnp.where(turns, probability, 0), jnp.stack([ground.T, body.T], axis=1))


def _pairs(paths: jax.Array) -> jax.Array:
    """How products of entries of R vary together, (6, 6, N), by pairs of rows and of columns."""
    columns = np.array([MONOMIALS.index((a + 1, b + 1)) for a, b in INDEX_PAIRS])
    return paths[:, columns] / jnp.asarray(_TIMES, paths.dtype)[None, :, None]


def _search(window: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The axes in {g} and in {b}, (3, N) each, whose angle changes least, and the variance of its cosine.

    Args:
        window: symmetric parts of the moments, (6, 6, N), and the mean rotation, (3, 3, N).
    """
    covariance = _covariance(*window)
    starts = _stillest_matrices(covariance, window[1])
    return as_one_kernel(_refine, covariance, window[1], starts)


def _covariance(pairs: jax.Array, mean: jax.Array) -> jax.Array:
    """Covariance of the entries of R, (3, 3, 3, 3, N): that of R_ia and R_jb at [i, a, j, b].

    The moments have what E[R_ia R_jb] and E[R_ib R_ja] are together. Their difference is a minor of a
    rotation, which is an entry of it: R_ia R_jb - R_ib R_ja = e_ijk e_abc R_kc.
    """
    i, a, j, b = np.ix_(*[range(3)] * 4)
    minors = jnp.asarray(_SIGN[i, j] * _SIGN[a, b], mean.dtype)[..., None] * mean[_THIRD[i, j], _THIRD[a, b]]
    difference = minors - mean[i, a] * mean[j, b] + mean[i, b] * mean[j, a]
    return pairs[_PAIR[i, j], _PAIR[a, b]] + difference / 2


def _stillest_matrices(covariance: jax.Array, mean: jax.Array) -> jax.Array:
    """Matrices W, (3, 3, S, N), of which tr(W^T R) changes least for what noise does to it.

    If a^T R b is constant, a b^T is one of them, or a part of them. The noise of R counts, because the trace
    of W = R S with a symmetric S hardly changes in any small motion, whatever its constraint.
    """
    squares = jnp.swapaxes(covariance + mean[:, :, None, None] * mean[None, None], 1, 3)
    eye = jnp.eye(9, dtype=mean.dtype)
    form, weight = (jnp.moveaxis(x.reshape(9, 9, -1), -1, 0) for x in (covariance, squares))
    root = jnp.linalg.cholesky((1 + _LEAST_NOISE) * eye[None] - weight)
    solve = partial(linalg.solve_triangular, root, lower=True)
    _, vectors = jnp.linalg.eigh(solve(jnp.swapaxes(solve(form), -1, -2)))
    stillest = solve(vectors[:, :, :_MATRICES], trans=1)
    return jnp.moveaxis(stillest, 0, -1).reshape(3, 3, _MATRICES, -1)


def _refine(
    covariance: jax.Array, mean: jax.Array, matrices: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Gauss-Newton steps of different lengths from all pairs of singular vectors, the best of which count.

    What is minimised is the variance of the cosine over the square of the sine, nearly that of the angle: the
    cosine of a small angle changes little, whatever the body does.
    """
    covariance, mean = covariance[..., None, :], mean[..., None, :]  # an axis for several pairs of axes

    def judge(a: jax.Array, b: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Of pairs (3, S, N): what is minimised, and the variance of the cosine, (S, N) each."""
        variance = _form(_form(covariance, (3, b), (1, b)), (1, a), (0, a))
        cosine = _form(mean, (1, b), (0, a))
        return variance / jnp.maximum(1 - jnp.square(cosine) - variance, _LEAST_SINE), variance

    def step(_: jax.Array, found: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        a, b, least, variance = found
        steps = zip(_steps(covariance, a, b), (a, b), strict=True)
        first, second = (unit(at[:, None] + shift) for shift, at in steps)  # (3, lengths, S, N)
        every = [x.reshape(3, -1, x.shape[-1]) for x in (first, second)]
        values, variances = (x.reshape(first.shape[1:]) for x in judge(*every))
        values = jnp.where(jnp.isfinite(values), values, jnp.inf)
        best, better = _first(values), jnp.min(values, axis=0) < least
        new = _pick(best, first, second, variances)
        a, b, variance = (jnp.where(better, x, old) for x, old in zip(new, (a, b, variance), strict=True))
        return a, b, jnp.minimum(least, jnp.min(values, axis=0)), variance

    transposed = jnp.swapaxes(matrices, 0, 1)
    squares = [
        jnp.stack([sum(w[i, c] * w[j, c] for c in range(3)) for w in (matrices, transposed)])
        for i, j in INDEX_PAIRS
    ]
    _, vectors = symmetric.eigh(tuple(squares))  # type: ignore[arg-type]
    a, b = (jnp.concatenate([jnp.stack(vector)[:, side] for vector in vectors], axis=1) for side in (0, 1))
    a, b, least, variance = lax.fori_loop(0, _ROUNDS, step, (a, b, *judge(a, b)))
    return _pick(_first(least), a, b, variance)


def _steps(covariance: jax.Array, a: jax.Array, b: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Gauss-Newton steps of both axes with several dampings, (3, D, S, N) each: what follows from a^T R b.

    Args:
        covariance: (3, 3, 3, 3, 1, N).
        a: (3, S, N) in {g}.
        b: (3, S, N) in {b}.
    """
    eye = jnp.eye(3, dtype=a.dtype)[:, :, None, None]
    of_a, of_b = _form(covariance, (3, b), (1, b)), _form(covariance, (2, a), (0, a))
    mixed = _form(covariance, (1, b), (1, a))
    size = (jnp.trace(of_a) + jnp.trace(of_b))[None, None]
    across_a, across_b = (eye - x[:, None] * x[None] for x in (a, b))
    slope_a, slope_b = product(across_a, product(of_a, a)), product(across_b, product(of_b, b))
    # along the axes themselves nothing moves
    of_a = product(across_a, product(of_a, across_a)) + size * (eye - across_a)
    of_b = product(across_b, product(of_b, across_b)) + size * (eye - across_b)
    mixed = product(across_a, product(mixed, across_b))
    damping = jnp.asarray(_DAMPING, a.dtype)[None, None, :, None, None] * size[:, :, None]
    of_a, of_b = (x[:, :, None] + damping * eye[:, :, None] for x in (of_a, of_b))  # (3, 3, D, S, N)
    mixed, slope_a, slope_b = (
        jnp.broadcast_to(x[..., None, :, :], (*x.shape[:-2], *of_a.shape[2:]))
        for x in (mixed, slope_a, slope_b)
    )
    follows = _solve(of_a, mixed)
    left = of_b - product(jnp.swapaxes(mixed, 0, 1), follows)
    to_b = _solve(left, (product(jnp.swapaxes(follows, 0, 1), slope_a) - slope_b)[:, None])[:, 0]
    to_a = _solve(of_a, -(slope_a + product(mixed, to_b))[:, None])[:, 0]
    return to_a, to_b


def _form(tensor: jax.Array, *factors: tuple[int, jax.Array]) -> jax.Array:
    """A tensor (3, ..., 3, S, N) times vectors (3, S, N), one axis of it with each."""
    for axis, vector in factors:
        shape = [3 if k == axis else 1 for k in range(tensor.ndim - 2)]
        tensor = jnp.sum(tensor * vector.reshape(*shape, *vector.shape[1:]), axis=axis)
    return tensor


def _solve(matrix: jax.Array, columns: jax.Array) -> jax.Array:
    """Symmetric matrices (3, 3, ...) into (3, n, ...)."""
    entries = tuple(matrix[i, j][None] for i, j in INDEX_PAIRS)
    return jnp.stack(symmetric.solve(entries, (columns[0], columns[1], columns[2])))  # type: ignore[arg-type]


def _first(values: jax.Array) -> jax.Array:
    """Which is the least along the first axis, (n, ...) bool."""
    places = jnp.arange(len(values), dtype=jnp.int32).reshape(-1, *[1] * (values.ndim - 1))
    return jnp.argmin(values, axis=0).astype(jnp.int32)[None] == places


def _pick(
    best: jax.Array, a: jax.Array, b: jax.Array, variance: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """What belongs to the best, (n, ...), of vectors (3, n, ...) and numbers (n, ...)."""
    a, b = (jnp.sum(jnp.where(best[None], x, 0), axis=1) for x in (a, b))
    return a, b, jnp.sum(jnp.where(best, variance, 0), axis=0)


def _judge(
    evidence: Evidence,
    axes: tuple[jax.Array, jax.Array],
    change: jax.Array,
    angular_axes: jax.Array,
    position: jax.Array,
) -> jax.Array:
    """Probability, (N,), that the cosine of an angle, which has the variance ``change``, is constant."""
    ground, body = axes
    paths = evidence.linear_spread[..., IN_BODY]
    of_turning, of_position = (
        jnp.square(evidence.share * noise) for noise in (evidence.noise.rotation, evidence.noise.position)
    )
    rounding = rounding_of(evidence.linear_spread)[:, IN_BODY]
    rounding = jnp.maximum(rounding, float(jnp.finfo(change.dtype).tiny))
    # noise of the orientation changes the angle the less, the smaller it is
    cosine = jnp.sum(ground * product(evidence.mean_paths[:, 1:, :, 0], body), axis=0)
    skew = jnp.maximum(1 - jnp.square(cosine), _SKEWED)
    x = jnp.moveaxis(position, -1, 0)
    spread, lever = covariance_at(paths, (x[0], x[1], x[2])), jnp.sum(jnp.square(x), axis=0)
    turned = symmetric.to_matrix(constant_covariance(evidence.angular_spread))  # (N, 2, 3, 3)
    slowest = angular_axes[..., :1]
    least = jnp.min(jnp.sum(slowest * matmul3(turned, slowest), axis=(-2, -1)), axis=1)
    whole = jnp.trace(turned, axis1=-2, axis2=-1)[:, AngularType.G]

    def in_noises(square: jax.Array, noise: jax.Array) -> jax.Array:
        return jnp.sqrt(jnp.maximum(square, 0) / (noise + rounding))

    return universal_probability(
        in_noises(change, of_turning * skew),
        in_noises(symmetric.trace(spread) / 3, of_position + of_turning * lever * (2 / 3)),
        in_noises(least, of_turning),
        in_noises(whole, of_turning),
        evidence.poses.astype(change.dtype) * jnp.square(evidence.share),
        evidence.share,
    )

"""How the estimates of a window depend on the paths that they are made from.

The origin x minimises log det Sigma(x), where Sigma is the sum over the samples of u u^T and u is the path of
the origin, taken between the ends of chords or about its mean: u = a + B x. The axes are the eigenvectors of
Sigma. With S = Sigma^-1 and b_a = du/dx_a, the derivatives by u at one sample are

    gradient of the objective:  2 S (b_a - Sigma_a S u),      Sigma_a = dSigma/dx_a,
    turn about axis k:          (u_j e_i + u_i e_j) / (Sigma_ii - Sigma_jj),    (k, i, j) cyclic,

and the implicit function theorem gives x by its Hessian. Where the estimate is the likeliest one, of the
constrained axes alone, the log det of the block of the free axes is subtracted, here and in what follows.
What is free has no derivative: turns of two axes that are both free or both constrained, and directions in
which the origin changes nothing. Along the latter the reported origin is moved to the point nearest to the
motion; the axes remain those at the optimum.

Arrays have components first, then samples, then windows.
"""

from dataclasses import dataclass

import jax
import numpy as np

from reframe_jax.arrays import add, jnp
from reframe_jax.compilation import once
from reframe_jax.geometry import symmetric
from reframe_jax.objectives.moments import MONOMIALS
from reframe_jax.objectives.velocity import PositionObjective
from reframe_jax.solvers import Box, ValleySteps
from reframe_jax.uncertainty.shifts import PathNoise, pull_of_noise

__all__ = [
    "FAR",
    "Rows",
    "angular_rows",
    "covariance_at_offset",
    "linear_rows",
    "optimum_near",
    "rms_rows",
    "sums_of_products",
]

_FLAT = 1e-9  # curvature below this share of the largest: the direction is taken for free
_NOTHING = 0.5  # trace of a projector, below which it is rounding
_BACK = ValleySteps(6)  # from the reported origin to the optimum
FAR = 100.0  # m, from the motion; farther than any search goes


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rows:
    """Sensitivities of the linear frame to the samples of its path.

    Attributes:
        turn: (3, 3, K+1, N) of a turn about each axis of the frame; components along the axes.
        still: (2, 3, K+1, N) the same of the first two if the origin stood still.
        position: (3, 3, K+1, N) of each coordinate of the reported origin.
        optimum: (3, 3, K+1, N) of each coordinate of the optimum.
        by_axis: (6, 3, N) of the turns and of the coordinates of the reported origin to the axis that the
            rotations hold in place; components along the axes of the frame.
        offset: (3, N) m, from the reported origin to the optimum.
        turn_shift: (3, N) rad, turn about each axis of the frame that noise makes on average.
        position_shift: (3, N) m, shift of the reported origin that noise makes on average.
        unknown: (3, 3, N) projector onto the directions along which the objective is not curved although they
            are not free.
    """

    turn: jax.Array
    still: jax.Array
    position: jax.Array
    optimum: jax.Array
    by_axis: jax.Array
    offset: jax.Array
    turn_shift: jax.Array
    position_shift: jax.Array
    unknown: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Here:
    """The objective about a point: Sigma (3, 3, N), its derivatives (3, 3, 3, N), and more."""

    sigma: jax.Array
    moved: jax.Array
    inverse: jax.Array  # S; less that of the block of axes that do not count
    weighted: jax.Array  # S Sigma_a S, the same
    hessian: jax.Array


def sums_of_products(a: jax.Array, b: jax.Array) -> jax.Array:
    """Sums over the samples of all products of components, (n, K+1, N) and (m, K+1, N) to (n, m, N)."""
    return jnp.stack([jnp.sum(row[None] * b, axis=1) for row in a])


def angular_rows(samples: jax.Array, dof: jax.Array) -> jax.Array:
    """Sensitivities of a turn about each axis of an angular frame, (3, 3, K+1, N).

    Args:
        samples: (3, K+1, N) along the axes of the frame.
        dof: (3, N), 1 where an axis is free.
    """
    variances = [jnp.sum(jnp.square(axis), axis=0) for axis in samples]
    return jnp.stack([_turn_row(k, samples, variances, dof)[0] for k in range(3)])


def linear_rows(
    samples: jax.Array,
    slopes: jax.Array,
    dof: jax.Array,
    free: jax.Array,
    noise: PathNoise,
    likeliest: jax.Array,
    axis: jax.Array,
    tie: jax.Array,
) -> Rows:
    """Sensitivities of a linear frame.

    Args:
        samples: (3, K+1, N) u along the axes of the frame, at the reported origin.
        slopes: (3, 3, K+1, N) derivatives of these components by the coordinates of the origin.
        dof: (3, N), 1 where an axis is free.
        free: (3, 3, N) projector onto the directions in which the origin is free.
        noise: of the path of the reported origin, as far as the estimate did not allow for it.
        likeliest: (N,) bool, whether the constrained axes alone count.
        axis: (3, N) about which the body turns, along the axes of the frame.
        tie: (N,) by how much the rotations resist a tilt of the free axis from it, in mean squares across it;
            0 where they do not.
    """
    flat = once(jnp.concatenate([samples[:, None], slopes], axis=1).reshape(12, *samples.shape[1:]))
    gram = once(sums_of_products(flat, flat)).reshape(3, 4, 3, 4, -1)
    nowhere = jnp.zeros_like(gram[:, 0, 0, 0])
    across = covariance_at_offset(gram, nowhere)
    stiffness = tie * (across[0, 0] + across[1, 1]) / 2
    stiff = stiffness[None] * axis
    tied = add(gram, np.s_[:, 0, :, 0], stiff[:, None] * axis[None])
    offset = optimum_near(tied, nowhere)
    left_out = likeliest[None] & (dof == 1)
    here, there = once((_about(tied, nowhere, left_out), _about(tied, offset, left_out)))
    held = jnp.broadcast_to(jnp.eye(3, dtype=free.dtype)[:, :, None], free.shape) - free
    solve, unknown = _restricted_inverse(here.hessian, held)
    position = _origin_rows(solve, here, samples, slopes)
    position_by_axis = _origin_by_axis(solve, here, stiff)
    solve, _ = _restricted_inverse(here.hessian - noise.curvature(here.inverse), held)
    shift = -jnp.sum(solve * _pull(here, noise, dof, likeliest)[None], axis=1)
    every = jnp.broadcast_to(jnp.eye(3, dtype=free.dtype)[:, :, None], free.shape)
    solve, _ = _restricted_inverse(there.hessian, every)
    best = once(samples + jnp.sum(slopes * offset[None, :, None], axis=1))
    optimum = _origin_rows(solve, there, best, slopes)
    optimum_by_axis = _origin_by_axis(solve, there, stiff)
    sigma = covariance_at_offset(gram, offset)
    variances, still, turn = [sigma[i, i] for i in range(3)], [], []
    turn_shift, turn_by_axis = [], []
    for k in range(3):
        row, weight = _turn_row(k, best, variances, dof)
        i, j = (k + 1) % 3, (k + 2) % 3
        by_origin = there.moved[:, i, j] * weight[None]
        turn_shift.append(noise.matrix[i, j] * weight + jnp.sum(by_origin * shift, axis=0))
        still.append(row)
        turn.append(row + jnp.sum(by_origin[:, None, None] * optimum, axis=0))
        turn_by_axis.append(jnp.sum(by_origin[:, None] * optimum_by_axis, axis=0))
    return Rows(
        turn=jnp.stack(turn),
        still=jnp.stack(still[:2]),
        position=position,
        optimum=optimum,
        by_axis=jnp.concatenate([jnp.stack(turn_by_axis), position_by_axis]),
        offset=offset,
        turn_shift=jnp.stack(turn_shift),
        position_shift=shift,
        unknown=unknown,
    )


def _pull(here: _Here, noise: PathNoise, dof: jax.Array, likeliest: jax.Array) -> jax.Array:
    """Gradient at the true origin by noise, (3, N)."""
    blocks = _block_inverse(here.sigma, dof == 0), _block_inverse(here.sigma, dof == 1)
    return pull_of_noise(here.moved, blocks, noise, dof, likeliest)


def _turn_row(
    k: int, samples: jax.Array, variances: list[jax.Array], dof: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Of a turn about axis k, (3, K+1, N), and its derivative by Sigma_ij of the other two axes, (N,)."""
    i, j = (k + 1) % 3, (k + 2) % 3
    gap = variances[i] - variances[j]
    differ = (dof[i] != dof[j]) & (gap != 0)
    weight = jnp.where(differ, 1 / jnp.where(differ, gap, 1), 0)
    row = [jnp.zeros_like(samples[0])] * 3
    row[i], row[j] = samples[j] * weight[None], samples[i] * weight[None]
    return jnp.stack(row), weight


def optimum_near(gram: jax.Array, start: jax.Array) -> jax.Array:
    """From the reported origin to the optimum near a point, (3, N) m.

    Args:
        gram: as in :func:`covariance_at_offset`.
        start: (3, N) m, the point, from the reported origin.
    """
    moments = jnp.stack(
        [
            jnp.stack(
                [gram[i, a, j, b] if a == b else gram[i, a, j, b] + gram[i, b, j, a] for a, b in MONOMIALS]
            )
            for i, j in symmetric.INDEX_PAIRS
        ]
    )
    far = jnp.full(3, FAR, gram.dtype)
    return _BACK(PositionObjective(moments), Box(-far, far), start)[0]


def covariance_at_offset(gram: jax.Array, offset: jax.Array) -> jax.Array:
    """Sigma at a point, (3, 3, N).

    Args:
        gram: (3, 4, 3, 4, N) sums of products of (u, b_x, b_y, b_z), component and column twice.
        offset: (3, N) m, of the point, from the reported origin.
    """
    column = _column(gram, offset)
    return column[:, :, 0] + jnp.sum(column[:, :, 1:] * offset[None, None], axis=2)


def _column(gram: jax.Array, offset: jax.Array) -> jax.Array:
    """Sums of products of u at a point and (u, b_x, b_y, b_z) at the reported origin, (3, 3, 4, N)."""
    return gram[:, 0] + jnp.sum(gram[:, 1:] * offset[None, :, None, None], axis=1)


def _about(gram: jax.Array, offset: jax.Array, left_out: jax.Array) -> _Here:
    """The objective about a point, (3, N) m from the reported origin.

    Args:
        gram: (3, 4, 3, 4, N) sums of products of (u, b_x, b_y, b_z), component and column twice.
        offset: of the point.
        left_out: (3, N) bool, axes whose block is subtracted: log det Sigma less that of the block is of the
            variance of the other axes that does not follow from these.
    """
    column = _column(gram, offset)
    sigma = covariance_at_offset(gram, offset)
    mixed = column[:, :, 1:]  # u_i b_ja
    moved = jnp.moveaxis(mixed + jnp.swapaxes(mixed, 0, 1), 2, 0)
    inverse = _inverse(sigma)
    weighted = jnp.stack([_chain(inverse, m, inverse) for m in moved])
    without = _block_inverse(sigma, left_out)
    inverse = inverse - without
    weighted = weighted - jnp.stack([_chain(without, m, without) for m in moved])
    curvature = 2 * jnp.sum(inverse[:, None, :, None] * gram[:, 1:, :, 1:], axis=(0, 2))
    hessian = curvature - jnp.stack(
        [jnp.stack([jnp.sum(w * m, axis=(0, 1)) for m in moved]) for w in weighted]
    )
    return _Here(sigma, moved, inverse, weighted, hessian)


def _block_inverse(sigma: jax.Array, part: jax.Array) -> jax.Array:
    """Inverse of the block of sigma (3, 3, N) of the axes (3, N) that are part of it, zero elsewhere."""
    inside = part[:, None] & part[None]
    apart = jnp.where(jnp.eye(3, dtype=bool)[:, :, None], sigma, 0)
    return jnp.where(inside, _inverse(jnp.where(inside, sigma, apart)), 0)


def _origin_rows(solve: jax.Array, here: _Here, samples: jax.Array, slopes: jax.Array) -> jax.Array:
    """Minus the inverse Hessian (3, 3, N) times the derivative of the gradient by u, (3, 3, K+1, N)."""
    by_slopes = -2 * solve[:, None, :, None] * here.inverse[None, :, None]  # (c, i, a, j, N)
    by_samples = 2 * jnp.sum(solve[:, :, None, None] * here.weighted[None], axis=1)  # (c, i, j, N)
    flat = slopes.swapaxes(0, 1).reshape(9, *slopes.shape[2:])
    rows = []
    by_slopes, by_samples = once((by_slopes, by_samples))
    for c in range(3):
        weights = by_slopes[c].reshape(3, 9, -1)
        rows.append(
            jnp.stack(
                [
                    jnp.sum(weights[i][:, None] * flat, axis=0)
                    + jnp.sum(by_samples[c, i][:, None] * samples, axis=0)
                    for i in range(3)
                ]
            )
        )
    return once(jnp.stack(rows))


def _origin_by_axis(solve: jax.Array, here: _Here, stiff: jax.Array) -> jax.Array:
    """Minus the inverse Hessian (3, 3, N) times the derivative of the gradient by an axis, (3, 3, N).

    Sigma contains k n n^T for the axis n; ``stiff`` (3, N) is k n.
    """
    return 2 * jnp.sum(solve[:, :, None] * jnp.sum(here.weighted * stiff[None, None], axis=2)[None], axis=1)


def _chain(a: jax.Array, b: jax.Array, c: jax.Array) -> jax.Array:
    """Product of matrices (3, 3, N)."""
    ab = jnp.sum(a[:, :, None] * b[None], axis=1)
    return jnp.sum(ab[:, :, None] * c[None], axis=1)


def _inverse(matrix: jax.Array) -> jax.Array:
    """Of symmetric matrices (3, 3, N), scaled by their diagonals first: they differ by many decades."""
    tiny = jnp.finfo(matrix.dtype).tiny
    scale = 1 / jnp.sqrt(jnp.maximum(jnp.stack([matrix[i, i] for i in range(3)]), tiny))
    scaled = matrix * scale[:, None] * scale[None]
    xx, xy, xz, yy, yz, zz = (scaled[i, j] for i, j in symmetric.INDEX_PAIRS)
    unit = xx, xy, xz, yy, yz, zz
    inverse = jnp.moveaxis(symmetric.to_matrix(symmetric.adjugate(unit)), (-2, -1), (0, 1))
    return inverse * (1 / symmetric.determinant(unit))[None, None] * scale[:, None] * scale[None]


def _restricted_inverse(hessian: jax.Array, held: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Inverse of (3, 3, N) in some directions, and the projector onto those of them where it has none.

    It is zero there, and in all other directions.

    Args:
        hessian: to invert.
        held: (3, 3, N) projector onto these directions.
    """
    inside = _chain(held, hessian, held)
    xx, xy, xz, yy, yz, zz = (inside[i, j] for i, j in symmetric.INDEX_PAIRS)
    values, vectors = symmetric.eigh((xx, xy, xz, yy, yz, zz))
    axes = jnp.stack([jnp.stack(vector) for vector in vectors], axis=1)
    strengths = jnp.stack(values)
    largest = jnp.max(jnp.abs(jnp.stack([hessian[i, i] for i in range(3)])), axis=0, keepdims=True)
    stiff = strengths > _FLAT * largest
    reciprocal = jnp.where(stiff, 1 / jnp.where(stiff, strengths, 1), 0)
    inverse = _chain(axes * reciprocal[None], jnp.swapaxes(axes, 0, 1), held)
    flat = jnp.sum(jnp.where(stiff, 0, axes)[:, None] * axes[None], axis=2)
    unknown = flat - (jnp.eye(3, dtype=flat.dtype)[:, :, None] - held)
    none = unknown[0, 0] + unknown[1, 1] + unknown[2, 2] < _NOTHING
    return inverse, jnp.where(none, 0, unknown)


def rms_rows(samples: jax.Array, dof: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Sensitivities of the RMS along each axis of a frame to its own component at every sample, (3, K+1, N).

    The RMS of a constrained axis is that of its noise, whose square is known to two variances over the number
    of samples. The derivative at the noise found counts that twice, hence the square root of one half, which
    comes second, (3, N), and 1 for free axes.

    Args:
        samples: (3, K+1, N) velocities along the axes.
        dof: (3, N), 1 where an axis is free.
    """
    tiny = jnp.finfo(samples.dtype).tiny
    rms = jnp.sqrt(jnp.maximum(jnp.sum(jnp.square(samples), axis=1), tiny))
    share = jnp.where(dof == 1, 1, jnp.sqrt(jnp.asarray(0.5, samples.dtype)))
    return samples * (share / rms)[:, None], share

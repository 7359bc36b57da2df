"""The covariance of an estimate by resampling: a second way, without a model of the noise.

Moments are sums over samples. A window is cut into blocks, whose moments are added up again with random
weights of mean one, exponentially distributed (the Bayesian bootstrap, Rubin 1981). Every such sum has an
optimum of its own, and these scatter as estimates from other recordings of the same kind would. Blocks keep
errors together that belong together. Those of the paths of BB and GG, which are summed up, are longer than
any block: there the bootstrap says too little.

Arrays have components first, then blocks or replicas, then windows.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from reframe_jax.compilation import once
from reframe_jax.constraints.types import AngularType
from reframe_jax.geometry import symmetric
from reframe_jax.uncertainty.estimate import in_bodies, oriented_in_body, shared_axes
from reframe_jax.uncertainty.paths import Estimates, Paths, axes_of, paths_of
from reframe_jax.uncertainty.sensitivity import (
    covariance_at_offset,
    optimum_near,
    sums_of_products,
)

__all__ = ["bootstrap_of_windows"]

_BLOCKS = 48  # in a window
_FITTED = 6  # numbers that are fitted to a window, by which its residuals are too small
_REPLICAS = 256


def bootstrap_of_windows(
    poses: jax.Array, steps: jax.Array, count: jax.Array | None, found: Estimates
) -> jax.Array:
    """Covariance of the estimates of N windows, from blocks of their samples.

    Args:
        poses: (N, K+1, 4, 4), m.
        steps: (K,) or (N, K) s.
        count: (N,) number of poses in each window where the rest is padding, else None.
        found: of these windows.

    Returns:
        (N, 9, 9), the axes and the origin as in :class:`reframe_jax.Covariance`. All windows have the same
        random weights, so that a window has the same covariance in every batch.
    """
    paths = paths_of(poses, steps, count, found)
    sampling = paths.sampling
    number = jnp.full(poses.shape[0], poses.shape[1], jnp.int32) if count is None else count
    length = jnp.maximum(-(-number // _BLOCKS), jnp.where(found.refined, 1, 2 * found.lag))
    block = jnp.arange(poses.shape[1], dtype=jnp.int32)[:, None] // length[None]
    weights = jax.random.exponential(jax.random.key(0), (_REPLICAS, _BLOCKS), poses.dtype)
    weights = weights / jnp.mean(weights, axis=1, keepdims=True)

    def resampled(values: jax.Array) -> jax.Array:
        """Weighted sums over all samples of (m, K+1, N), (m, B, N)."""
        sums = [jnp.sum(jnp.where((block == b)[None], values, 0), axis=1) for b in range(_BLOCKS)]
        return sum(
            (weights[None, :, b, None] * sums[b][:, None] for b in range(1, _BLOCKS)),
            weights[None, :, 0, None] * sums[0][:, None],
        )

    def gram(path: jax.Array, about_mean: jax.Array) -> jax.Array:
        """Moments of paths (m, K+1, N) as they are sampled, (m, m, B, N)."""
        chords = sampling.chords(path)
        values = jnp.where(about_mean[None, None], jnp.sqrt(sampling.shares)[None] * path, chords)
        counts = jnp.where(about_mean[None], sampling.shares, _shares(sampling.scales))
        total = resampled(counts[None])[0]
        size = len(path)
        pairs = [(i, j) for i in range(size) for j in range(i, size)]
        products = resampled(jnp.stack([values[i] * values[j] for i, j in pairs])) / total[None]
        mean = resampled(sampling.shares[None] * path) / total[None]
        mean = jnp.where(about_mean[None, None], mean, 0)
        table = {pair: products[n] - mean[pair[0]] * mean[pair[1]] for n, pair in enumerate(pairs)}
        return jnp.stack([jnp.stack([table[min(i, j), max(i, j)] for j in range(size)]) for i in range(size)])

    flat = jnp.concatenate([paths.along_linear[:, None], paths.slopes], axis=1)
    flat = flat.reshape(12, *flat.shape[2:])
    shape = (3, 4, 3, 4, _REPLICAS * poses.shape[0])
    moments = once(gram(flat, found.refined).reshape(shape))
    offset = optimum_near(moments, jnp.zeros_like(moments[:, 0, 0, 0]))
    sigma = covariance_at_offset(moments, offset).reshape(3, 3, _REPLICAS, -1)
    linear_dof, angular_dof = found.linear_dof.T, found.angular_dof.T
    own = _turns(sigma, linear_dof)
    turned = gram(paths.along_angular, found.refined)
    angular = _turns(turned, angular_dof)
    angular, own = _with_single_axis(paths, found, resampled, angular, own)
    offset = offset.reshape(3, _REPLICAS, -1)
    free = jnp.moveaxis(found.free_position, 0, -1)
    origin = offset - jnp.sum(free[:, :, None] * offset[None], axis=1)
    changes = jnp.concatenate([angular, own, origin])
    changes = changes - jnp.mean(changes, axis=1, keepdims=True)
    # weights of fixed sum vary a little less than samples do
    share = (_BLOCKS + 1) / (_BLOCKS - _FITTED) / (_REPLICAS - 1)
    matrix = sums_of_products(changes, changes) * share
    matrix = in_bodies(matrix, axes_of(found.angular_rotvec), axes_of(found.linear_rotvec))
    return jnp.moveaxis(matrix, -1, 0)


def _shares(scales: jax.Array) -> jax.Array:
    """Shares of chords that count, (K+1, N), of sum 1."""
    counted = (scales > 0).astype(scales.dtype)
    return counted / jnp.maximum(jnp.sum(counted, axis=0, keepdims=True), 1)


def _turns(sigma: jax.Array, dof: jax.Array) -> jax.Array:
    """Turn about each axis of the frame that takes it to the eigenvectors of (3, 3, B, N), (3, B, N) rad."""
    turns = []
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        angle = jnp.arctan2(2 * sigma[i, j], jnp.abs(sigma[i, i] - sigma[j, j])) / 2
        angle = jnp.where(sigma[i, i] > sigma[j, j], angle, -angle)
        turns.append(jnp.where((dof[i] != dof[j])[None], angle, 0))
    return jnp.stack(turns)


def _with_single_axis(
    paths: Paths,
    found: Estimates,
    resampled: Callable[[jax.Array], jax.Array],
    angular: jax.Array,
    linear: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Turns (3, B, N) of both frames where the body turns about a single axis, from the mean rotation."""
    entries = paths.tilted.reshape(9, *paths.tilted.shape[2:]) * paths.sampling.shares[None]
    mean = resampled(entries)
    mean = mean.reshape(3, 3, *mean.shape[1:])
    sides = {}
    for body, matrix in ((AngularType.G, mean), (AngularType.B, jnp.swapaxes(mean, 0, 1))):
        gram = [jnp.sum(matrix[i] * matrix[j], axis=0) for i, j in symmetric.INDEX_PAIRS]
        xx, xy, xz, yy, yz, zz = gram
        _, (_, _, axis) = symmetric.eigh((xx, xy, xz, yy, yz, zz))
        sides[body] = jnp.stack(axis)

    def tilts(axes: jax.Array, odd: jax.Array, on_body: jax.Array) -> jax.Array:
        """Turns (3, B, N) about the axes (3, 3, N) of a frame that take its odd axis to that of rotation."""
        axis = jnp.where(on_body[None, None], sides[AngularType.B], sides[AngularType.G])
        axis = axis * jnp.sign(jnp.sum(axis * odd[:, None], axis=0))[None]
        turn = jnp.cross(jnp.broadcast_to(odd[:, None], axis.shape), axis, axis=0)
        return jnp.sum(axes[:, :, None] * turn[:, None], axis=0)

    angular_axes, linear_axes = axes_of(found.angular_rotvec), axes_of(found.linear_rotvec)
    turns_once, odd, shared = shared_axes(paths, found)
    alone = tilts(angular_axes, angular_axes[:, 2], found.angular_type == int(AngularType.B))
    angular = jnp.where(turns_once[None, None], alone, angular)
    rotation = tilts(linear_axes, odd, oriented_in_body(found))
    scatter = [jnp.var(each, axis=1, keepdims=True) for each in (linear, rotation)]
    total = scatter[0] + scatter[1]
    weight = jnp.where(total > 0, scatter[0] / jnp.where(total > 0, total, 1), 0)
    return angular, jnp.where(shared[:, None], linear + weight * (rotation - linear), linear)

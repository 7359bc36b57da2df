"""The covariance of an estimate by resampling: a second way, without a model of the noise.

Moments are sums over samples. A window is cut into blocks, whose moments are added up again with random
weights of mean one, exponentially distributed (the Bayesian bootstrap, Rubin 1981). Every such sum has an
optimum of its own, and these scatter as estimates from other recordings of the same kind would. Blocks keep
errors together that belong together.

The errors of the paths of BB and GG are longer than any block, because these paths are summed up, and the
estimate takes most of them in: what is left over says too little. Where displacements from the mean were
used, these windows are estimated again from poses that are disturbed by their noise.

Arrays have components first, then blocks or replicas, then windows.
"""

import jax
import numpy as np

from reframe_jax.arrays import add, jnp, lax, put, random
from reframe_jax.compilation import once
from reframe_jax.constraints.types import AngularType
from reframe_jax.geometry import symmetric
from reframe_jax.geometry.products import matmul3
from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.motion.single_axis import tilt_to_plane
from reframe_jax.uncertainty.estimate import in_bodies
from reframe_jax.uncertainty.paths import (
    Estimates,
    Paths,
    axes_of,
    is_summed,
    oriented_in_body,
    paths_of,
)
from reframe_jax.uncertainty.sensitivity import (
    covariance_at_offset,
    optimum_near,
    sums_of_products,
)
from reframe_jax.uncertainty.shared_axis import shared_axes, with_tilt

__all__ = ["bootstrap_of_windows"]

_BLOCKS = 48  # in a window
_FITTED = 6  # numbers that are fitted to a window, by which its residuals are too small
_REPLICAS = 256
_DISTURBED = 128  # replicas of the poses


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
    weights = random.exponential(random.key(0), (_REPLICAS, _BLOCKS), poses.dtype)
    weights = weights / jnp.mean(weights, axis=1, keepdims=True)

    def resampled(values: jax.Array) -> jax.Array:
        """Weighted sums over all samples of (m, K+1, N), (m, B, N)."""
        values = once(values)

        def add_block(b: jax.Array, total: jax.Array) -> jax.Array:
            of_block = jnp.sum(jnp.where((block == b)[None], values, 0), axis=1)
            return total + weights[None, :, b, None] * of_block[:, None]

        nothing = jnp.zeros((len(values), _REPLICAS, values.shape[2]), values.dtype)
        return lax.fori_loop(0, _BLOCKS, add_block, nothing)

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
    free = jnp.tile(jnp.moveaxis(found.free_position, 0, -1), _REPLICAS)
    sigma, offset = _optimum(moments, free)
    sigma = sigma.reshape(3, 3, _REPLICAS, -1)
    linear_dof, angular_dof = found.linear_dof.T, found.angular_dof.T
    turned = gram(paths.along_angular, found.refined)
    positions = gram(paths.shift, jnp.ones_like(found.refined))
    changes = _turns(turned, angular_dof), _turns(sigma, linear_dof), offset.reshape(3, _REPLICAS, -1)
    # weights of fixed sum vary a little less than samples do
    share = (_BLOCKS + 1) / (_BLOCKS - _FITTED)
    matrix = share * _scatter(paths, found, changes, (resampled(_mean_entries(paths)), _packed(positions)))
    summed = found.refined & is_summed(found)

    def again(matrix: jax.Array) -> jax.Array:
        return jnp.where(summed[None, None], _of_disturbed(poses, steps, count, found, paths), matrix)

    matrix = lax.cond(jnp.any(summed), again, lambda matrix: matrix, matrix)
    matrix = in_bodies(matrix, axes_of(found.angular_rotvec), axes_of(found.linear_rotvec))
    return jnp.moveaxis(matrix, -1, 0)


def _of_disturbed(
    poses: jax.Array, steps: jax.Array, count: jax.Array | None, found: Estimates, paths: Paths
) -> jax.Array:
    """Covariance (9, 9, N) of estimates from poses that are disturbed by their noise once more."""
    linear_dof, angular_dof = found.linear_dof.T, found.angular_dof.T

    def estimate(key: jax.Array) -> tuple[jax.Array, ...]:
        turn, shift = (random.normal(each, (1, poses.shape[1], 3), poses.dtype) for each in random.split(key))
        turned = rotation_exp(turn * found.rotation_noise[:, None, None])
        noisy = put(poses, np.s_[:, :, :3, :3], matmul3(poses[:, :, :3, :3], turned))
        noisy = add(noisy, np.s_[:, :, :3, 3], shift * found.position_noise[:, None, None])
        seen = paths_of(noisy, steps, count, found)
        take = seen.sampling.take
        flat = jnp.concatenate([seen.along_linear[:, None], seen.slopes], axis=1)
        flat = take(flat.reshape(12, *flat.shape[2:]))
        moments = once(sums_of_products(flat, flat).reshape(3, 4, 3, 4, -1))
        sigma, offset = _optimum(moments, jnp.moveaxis(found.free_position, 0, -1))
        of_turns = take(seen.along_angular)
        angular = _turns(sums_of_products(of_turns, of_turns)[:, :, None], angular_dof)[:, 0]
        own = _turns(sigma[:, :, None], linear_dof)[:, 0]
        about = seen.shift - jnp.sum(seen.sampling.shares[None] * seen.shift, axis=1, keepdims=True)
        spread = sums_of_products(seen.sampling.shares[None] * about, about)
        return angular, own, offset, jnp.sum(_mean_entries(seen), axis=1), _packed(spread)

    stacked = lax.map(estimate, random.split(random.key(1), _DISTURBED))
    angular, own, offset, mean, spread = (jnp.swapaxes(each, 0, 1) for each in stacked)
    return _scatter(paths, found, (angular, own, offset), (mean, spread))


def _optimum(moments: jax.Array, free: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Covariance along the axes at the optimum, (3, 3, N), and how far the optimum is off, (3, N) m.

    The axes are those of the optimum wherever it is. The origin is held along the free directions, of the
    projectors (3, 3, N): the objective is flat there, and a search would not come to an end.

    Args:
        moments: (3, 4, 3, 4, N).
        free: (3, 3, N).
    """
    start = jnp.zeros_like(moments[:, 0, 0, 0])
    size = jnp.sum(jnp.stack([moments[i, a, i, a] for i in range(3) for a in range(1, 4)]), axis=0)
    held = jnp.eye(3, dtype=free.dtype)[:, None, :, None, None] * (free * size[None, None])[None, :, None]
    origin = optimum_near(add(moments, np.s_[:, 1:, :, 1:], held), start)
    return covariance_at_offset(moments, optimum_near(moments, start)), origin


def _scatter(
    paths: Paths,
    found: Estimates,
    changes: tuple[jax.Array, jax.Array, jax.Array],
    seen: tuple[jax.Array, jax.Array],
) -> jax.Array:
    """Covariance (9, 9, N) of replicas.

    Args:
        paths: of the windows.
        found: of them.
        changes: turns of the angular axes and of the linear axes, and shifts of the origin, (3, B, N) each.
        seen: (9, B, N) entries of the mean rotation, and (6, B, N) m^2, covariance of the positions.
    """
    angular, own = _with_single_axis(paths, found, seen, *changes[:2])
    free = jnp.moveaxis(found.free_position, 0, -1)
    origin = changes[2] - jnp.sum(free[:, :, None] * changes[2][None], axis=1)
    every = jnp.concatenate([angular, own, origin])
    every = every - jnp.mean(every, axis=1, keepdims=True)
    return sums_of_products(every, every) / (every.shape[1] - 1)


def _packed(matrix: jax.Array) -> jax.Array:
    """The six entries of symmetric matrices (3, 3, ...)."""
    return jnp.stack([matrix[i, j] for i, j in symmetric.INDEX_PAIRS])


def _mean_entries(paths: Paths) -> jax.Array:
    """What every sample adds to the entries of the mean rotation, (9, K+1, N)."""
    return paths.tilted.reshape(9, *paths.tilted.shape[2:]) * paths.sampling.shares[None]


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
    seen: tuple[jax.Array, jax.Array],
    angular: jax.Array,
    linear: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Turns (3, B, N) of both frames where the body turns about a single axis.

    Args:
        paths: of the windows.
        found: of them.
        seen: (9, B, N) entries of the mean rotation, and (6, B, N) m^2, covariance of the positions.
        angular: (3, B, N) turns of the angular axes by their own samples.
        linear: (3, B, N) likewise.
    """
    mean, spread = seen[0].reshape(3, 3, *seen[0].shape[1:]), seen[1]
    xx, xy, xz, yy, yz, zz = (jnp.sum(mean[i] * mean[j], axis=0) for i, j in symmetric.INDEX_PAIRS)
    _, (_, _, kept) = symmetric.eigh((xx, xy, xz, yy, yz, zz))
    axis = jnp.stack(kept)
    stiffness = jnp.broadcast_to(paths.single.stiffness[None], xx.shape)
    xx, xy, xz, yy, yz, zz = spread
    normal = tilt_to_plane(axis, (xx, xy, xz, yy, yz, zz), stiffness)
    axis = jnp.where(paths.single.planar[None, None], normal, axis)

    def carried(axis: jax.Array, to_body: jax.Array, to_ground: jax.Array) -> jax.Array:
        """The axis (3, B, N) as the other body sees it, by the mean rotation."""
        in_body, in_ground = jnp.sum(mean * axis[:, None], axis=0), jnp.sum(mean * axis[None], axis=1)
        moved = jnp.where(to_body[None, None], in_body, axis)
        moved = jnp.where(to_ground[None, None], in_ground, moved)
        return moved / jnp.sqrt(jnp.sum(jnp.square(moved), axis=0, keepdims=True))

    def tilts(axes: jax.Array, odd: jax.Array, axis: jax.Array) -> jax.Array:
        """Turns (3, B, N) about the axes (3, 3, N) of a frame that take its odd axis to another."""
        axis = axis * jnp.sign(jnp.sum(axis * odd[:, None], axis=0))[None]
        turn = jnp.cross(jnp.broadcast_to(odd[:, None], axis.shape), axis, axis=0)
        return jnp.sum(axes[:, :, None] * turn[:, None], axis=0)

    angular_axes, linear_axes = axes_of(found.angular_rotvec), axes_of(found.linear_rotvec)
    angular_on_body, on_body = found.angular_type == int(AngularType.B), oriented_in_body(found)
    shared, nowhere = shared_axes(paths, found), jnp.zeros_like(on_body)
    here = carried(axis, on_body, nowhere)
    alone = tilts(angular_axes, angular_axes[:, 2], carried(axis, angular_on_body, nowhere))
    odd = jnp.where(shared.faces[None], linear_axes[:, 0], linear_axes[:, 2])
    rotation = tilts(linear_axes, odd, here)
    scatter = [jnp.var(each, axis=1, keepdims=True) for each in (linear, rotation)]
    total = scatter[0] + scatter[1]
    weight = jnp.where(total > 0, scatter[0] / jnp.where(total > 0, total, 1), 0)
    weight = jnp.where(shared.faces[None, None], 1, weight)
    mixed = shared.slides | shared.faces
    of_third = jnp.zeros_like(linear[:1])
    fused = jnp.where(mixed[None, None], linear + weight * (rotation - linear), linear)
    fused = jnp.where(shared.slides[None, None], jnp.concatenate([fused[:2], of_third]), fused)
    third = linear_axes[:, 2][:, None] + fused[1][None] * linear_axes[:, 0][:, None]
    third = third - fused[0][None] * linear_axes[:, 1][:, None]
    third = carried(third, angular_on_body & ~on_body, on_body & ~angular_on_body)
    both = tilts(angular_axes, angular_axes[:, 2], third)
    angular = jnp.where(shared.alone[None, None], alone, angular)
    angular = jnp.where(shared.slides[None, None], both, angular)
    held = jnp.where(on_body[None], paths.single.in_body, paths.single.in_ground)
    same = here * jnp.sign(jnp.sum(here * held[:, None], axis=0))[None]
    tilt = -jnp.sum(same * linear_axes[:, 2][:, None], axis=0)
    aside = with_tilt(fused, tilt, jnp.sum(linear_axes[:, :2] * held[:, None], axis=0))
    return angular, jnp.where(shared.aside[None, None], aside, fused)

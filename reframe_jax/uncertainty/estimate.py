"""Covariance of identified frames: from checked arrays, all windows at once."""

import jax
import numpy as np

from reframe_jax.arrays import add, jnp, lax, put
from reframe_jax.compilation import once
from reframe_jax.uncertainty.paths import Estimates, Paths, axes_of, is_summed, oriented_in_body, paths_of
from reframe_jax.uncertainty.propagation import apply_to_rows, position_to_poses, turn_to_poses
from reframe_jax.uncertainty.rivals import twin_probability, type_probability
from reframe_jax.uncertainty.sampling import Sampling
from reframe_jax.uncertainty.sandwich import inflation, long_run_variance, noise_covariance, noise_variances
from reframe_jax.uncertainty.sensitivity import (
    FAR,
    angular_rows,
    linear_rows,
    optimum_near,
    rms_rows,
    sums_of_products,
)
from reframe_jax.uncertainty.shared_axis import rows_with_axis, shared_axes
from reframe_jax.uncertainty.shifts import noise_of_path
from reframe_jax.uncertainty.turning import axis_moves, kept_rows

__all__ = ["covariance_of_windows", "in_bodies"]

_BLOCKS = 8  # in a window, of which the long-run variance is taken
_SMALL = 1 / 8  # of the slowest free axis, up to which noise along constrained axes is small
_FLOOR = 16  # noise that is always there, in units of rounding


def covariance_of_windows(
    poses: jax.Array, steps: jax.Array, count: jax.Array | None, found: Estimates, measured: bool
) -> tuple[jax.Array, ...]:
    """Covariance of the estimates of N windows.

    Args:
        poses: (N, K+1, 4, 4), m.
        steps: (K,) or (N, K) s.
        count: (N,) number of poses in each window where the rest is padding, else None.
        found: of these windows.
        measured: whether to inflate it by what is left over.

    Returns:
        What :class:`reframe_jax.Covariance` holds, in its order.
    """
    paths = paths_of(poses, steps, count, found)
    sampling = paths.sampling
    angular_dof, linear_dof = found.angular_dof.T, found.linear_dof.T
    free = jnp.moveaxis(found.free_position, 0, -1)
    angular_axes, linear_axes = axes_of(found.angular_rotvec), axes_of(found.linear_rotvec)
    rounding = _FLOOR * float(jnp.finfo(poses.dtype).eps)
    noise = (
        jnp.maximum(found.position_noise, rounding * jnp.sqrt(jnp.max(jnp.sum(paths.shift**2, 0), 0))),
        jnp.maximum(found.rotation_noise, rounding),
    )
    turned = once(sampling.take(paths.along_angular))
    moved = once(sampling.take(paths.along_linear))
    flat = paths.slopes.reshape(9, *paths.slopes.shape[2:])
    slopes = once(sampling.take(flat).reshape(paths.slopes.shape))
    angular = once(angular_rows(turned, angular_dof))
    axis = jnp.where(oriented_in_body(found)[None], paths.single.in_body, paths.single.in_ground)
    # the likelihood of GB and BG takes its moments without the noise of the orientation
    left = ~sampling.about_mean | paths.kept | is_summed(found)
    of_rotation = jnp.where(left, paths.share * noise[1], 0)
    added = noise_of_path(
        found.linear_type,
        paths.rotation,
        paths.shift,
        paths.origin,
        linear_axes,
        (axis, paths.kept),
        sampling.pose_weights(),
        (paths.share * noise[0], of_rotation),
    )
    slides = shared_axes(paths, found).slides & ~found.on_screw
    seen = jnp.where(slides, paths.share * found.seen.rotation, 1)
    tie = jnp.where(slides, paths.single.spread / jnp.square(seen), 0)
    along = jnp.sum(linear_axes * axis[:, None], axis=0)
    linear = once(linear_rows(moved, slopes, linear_dof, free, added, sampling.about_mean, along, tie))
    linear_path = _to_path(sampling, jnp.concatenate([linear.turn, linear.position]))
    angular_rms = _rms_path(paths.along_angular, None, sampling, angular_dof, None)
    best = once(paths.along_linear + jnp.sum(paths.slopes * linear.offset[None, :, None], axis=1))
    optimum = _to_path(sampling, linear.optimum)
    linear_rms = _rms_path(best, paths.slopes, sampling, linear_dof, optimum)
    of_turn = once(jnp.concatenate([_to_path(sampling, angular), angular_rms]))
    of_turn = apply_to_rows(angular_axes[:, :, None], of_turn)
    of_shift = once(jnp.concatenate([linear_path, linear_rms]))
    first = turn_to_poses(once(of_turn), found.angular_type, paths.rotation, paths.turns)
    second, shift = once(_to_poses(paths, found, of_shift))

    def with_tilt(rows: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        directions = apply_to_rows(linear_axes, linear.by_axis)
        directions = directions - axis[None] * jnp.sum(directions * axis[None], axis=1, keepdims=True)
        tilts = axis_moves(paths, directions, axis, oriented_in_body(found))
        turn, shift = (add(rows, np.s_[:6], more) for rows, more in zip(rows, tilts, strict=True))
        return turn, shift

    second, shift = once(lax.cond(jnp.any(slides), with_tilt, lambda rows: rows, (second, shift)))
    zero = jnp.zeros_like(first[:3])
    of_angular, of_linear = (first[:3], zero), (second[:3], shift[:3])
    explained = noise_variances(
        jnp.concatenate([first[:3], second[:6]]), jnp.concatenate([zero, shift[:6]]), noise
    )

    def with_axis(_: None) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array], jax.Array]:
        def still() -> jax.Array:
            return noise_variances(*_to_poses(paths, found, _to_path(sampling, linear.still)), noise)

        return rows_with_axis(paths, found, of_angular, of_linear, still, noise, linear.turn_shift)

    as_found = of_angular, of_linear, linear.turn_shift
    of_angular, of_linear, turn_shift = once(
        lax.cond(jnp.any(paths.single.found), with_axis, lambda _: as_found, None)
    )
    # angular turn, linear turn, origin, angular rms, linear rms
    turn = jnp.concatenate([of_angular[0], of_linear[0], second[3:6], first[3:], second[6:9]])
    shift = jnp.concatenate([of_angular[1], of_linear[1], shift[3:6], zero, shift[6:9]])
    matrix = noise_covariance(turn, shift, noise)
    grown = jnp.ones((3, poses.shape[0]), poses.dtype)
    number = poses.shape[1] if count is None else count
    if measured:
        rows = angular, linear.turn, linear.position
        grown = _inflations(explained, rows, (turned, moved, moved), sampling, found, number)
    matrix = in_bodies(matrix, angular_axes, linear_axes)
    factors = jnp.concatenate([jnp.repeat(grown, 3, axis=0), jnp.ones((6, *grown.shape[1:]), grown.dtype)])
    matrix = matrix * factors[:, None] * factors[None]
    tilt = jnp.sum(linear_axes * turn_shift[None], axis=1)
    none = jnp.zeros_like(tilt)
    bias = jnp.concatenate([none, tilt, linear.position_shift, none, none])
    matrix = matrix + bias[:, None] * bias[None]
    matrix = add(matrix, np.s_[6:9, 6:9], jnp.square(FAR) * linear.unknown)
    small = _stand_apart(turned, angular_dof) & _stand_apart(moved, linear_dof)

    block = _block(sampling, number)

    def compare(_: None) -> jax.Array:
        flat = jnp.concatenate([moved[:, None], slopes], axis=1).reshape(12, *moved.shape[1:])
        gram = sums_of_products(flat, flat).reshape(3, 4, 3, 4, -1)
        twin = optimum_near(gram, (found.twin - found.position).T)
        return jnp.where(found.has_twin, twin_probability(moved, slopes, twin, linear_dof, block), 0)

    probability = lax.cond(jnp.any(found.has_twin), compare, lambda _: jnp.zeros_like(noise[0]), None)
    of_types = type_probability(once(paths.rivals), sampling, found.linear_type, linear_dof, block)
    determined = jnp.all(linear.unknown == 0, axis=(0, 1))
    return jnp.moveaxis(matrix, -1, 0), bias.T, grown.T, determined, small, probability, of_types


def _stand_apart(samples: jax.Array, dof: jax.Array) -> jax.Array:
    """Whether what constrained axes show is small, (N,), against the motion along free ones (3, K+1, N)."""
    squares = jnp.sum(jnp.square(samples), axis=1)
    held = jnp.max(jnp.where(dof == 0, squares, 0), axis=0)
    return held <= jnp.square(_SMALL) * jnp.min(jnp.where(dof == 1, squares, jnp.inf), axis=0)


def _to_poses(paths: Paths, found: Estimates, rows: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Sensitivities to the poses, from those to the path along the axes of the linear frame."""
    rows = apply_to_rows(axes_of(found.linear_rotvec)[:, :, None], rows)
    turn, shift = position_to_poses(once(rows), found.linear_type, paths.rotation, paths.shift, paths.origin)

    def keep(rows: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        return kept_rows(*rows, paths)

    turn, shift = lax.cond(jnp.any(paths.kept), keep, lambda rows: rows, (turn, shift))
    return turn, shift


def _to_path(sampling: Sampling, rows: jax.Array) -> jax.Array:
    """Sensitivities to the path, from those to its samples, (m, 3, K+1, N)."""
    flat = rows.reshape(-1, *rows.shape[2:])
    return sampling.give_back(flat).reshape(rows.shape)


def _rms_path(
    path: jax.Array, slopes: jax.Array | None, sampling: Sampling, dof: jax.Array, position: jax.Array | None
) -> jax.Array:
    """Sensitivities of the RMS velocities to the path, (3, 3, K+1, N)."""
    own, share = rms_rows(sampling.chords(path), dof)
    back = once(sampling.from_chords(own))
    rows = jnp.stack([put(jnp.zeros_like(back), i, back[i]) for i in range(3)])
    if slopes is None or position is None:
        return rows
    by_origin = once(jnp.sum(back[:, None] * slopes, axis=2) / share[:, None])
    return rows + jnp.stack([jnp.sum(by_origin[i][:, None, None] * position, axis=0) for i in range(3)])


def _block(sampling: Sampling, count: jax.Array | int) -> jax.Array:
    """Samples of which sums are taken for a long-run variance, (N,)."""
    block = jnp.maximum(-(-count // _BLOCKS), jnp.where(sampling.about_mean, 1, 2 * sampling.lag))
    return block.astype(jnp.int32)


def _inflations(
    variances: jax.Array,
    rows: tuple[jax.Array, jax.Array, jax.Array],
    samples: tuple[jax.Array, jax.Array, jax.Array],
    sampling: Sampling,
    found: Estimates,
    count: jax.Array | int,
) -> jax.Array:
    """Of the angular axes, the linear axes and the origin, (3, N)."""
    dofs = found.angular_dof, found.linear_dof, found.linear_dof
    scores = []
    for group, dof, values in zip(rows, dofs, samples, strict=True):
        left_over = jnp.where((dof == 0).T[:, None], values, 0)
        scores.append(jnp.sum(group * left_over[None], axis=1))
    long_run = long_run_variance(once(jnp.concatenate(scores)), _block(sampling, count))
    return jnp.stack(
        [inflation(long_run[i : i + 3], variances[i : i + 3]) for i in range(0, len(long_run), 3)]
    )


def in_bodies(matrix: jax.Array, angular_axes: jax.Array, linear_axes: jax.Array) -> jax.Array:
    """Turns about the axes of the frames become rotation vectors in the bodies of their types."""

    def left(m: jax.Array) -> jax.Array:
        turned = [
            jnp.sum(axes[:, :, None] * m[None, start : start + 3], axis=1)
            for axes, start in ((angular_axes, 0), (linear_axes, 3))
        ]
        return jnp.concatenate([*turned, m[6:]])

    return jnp.swapaxes(left(jnp.swapaxes(left(matrix), 0, 1)), 0, 1)

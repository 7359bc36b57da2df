"""Covariance of identified frames: from checked arrays, all windows at once."""

from dataclasses import dataclass, replace
from math import cos, radians
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.compilation import once, traced
from reframe_jax.constraints.located import ground_offset, parts_on_body
from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.identification.results import Identification, PoseNoise
from reframe_jax.motion import kinematics
from reframe_jax.motion.chords import moving_chords
from reframe_jax.motion.outliers import repair_poses
from reframe_jax.motion.single_axis import find_single_axis
from reframe_jax.uncertainty.propagation import apply_to_rows, position_to_poses, turn_to_poses
from reframe_jax.uncertainty.sampling import Sampling
from reframe_jax.uncertainty.sandwich import inflation, long_run_variance, noise_covariance
from reframe_jax.uncertainty.sensitivity import angular_rows, linear_rows, rms_rows
from reframe_jax.uncertainty.turning import axis_rows, combine_rows

__all__ = ["Estimates", "Paths", "covariance_of_windows", "estimates_of", "paths_of"]

_IN_BODY = int(LinearType.GB)
_BLOCKS = 8  # in a window, of which the long-run variance is taken
_PARALLEL = cos(radians(15.0))  # as in the names of the classes
_FLOOR = 16  # noise that is always there, in units of rounding


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Estimates:
    """What the covariance needs of N identifications.

    Attributes:
        angular_type, linear_type: (N,) codes.
        angular_rotvec, linear_rotvec, position: (N, 3) rad, rad and m.
        angular_dof, linear_dof: (N, 3).
        free_position: (N, 3, 3).
        refined: (N,) bool.
        lag: (N,) samples.
        counted: (N, K+1) bool.
        position_noise, rotation_noise: (N,) m and rad.
    """

    angular_type: jax.Array
    linear_type: jax.Array
    angular_rotvec: jax.Array
    linear_rotvec: jax.Array
    position: jax.Array
    angular_dof: jax.Array
    linear_dof: jax.Array
    free_position: jax.Array
    refined: jax.Array
    lag: jax.Array
    counted: jax.Array
    position_noise: jax.Array
    rotation_noise: jax.Array

    def padded(self, size: int) -> "Estimates":
        """Those of one window on the host, whose poses are padded to a number of them."""
        counted: Any = np.zeros(size, bool)
        counted[: len(self.counted)] = self.counted
        return replace(self, counted=counted)


def estimates_of(found: Identification, noise: PoseNoise | None, dtype: np.dtype) -> Estimates:
    """What the covariance needs of an identification, in the precision of the poses."""
    batch = np.shape(found.status_code)
    given = found.noise if noise is None else noise
    angular, linear = found.angular, found.linear
    estimates = Estimates(
        angular_type=angular.type_code,
        linear_type=linear.type_code,
        angular_rotvec=angular.rotvec,
        linear_rotvec=linear.rotvec,
        position=linear.position,
        angular_dof=angular.dof,
        linear_dof=linear.dof,
        free_position=linear.free_position,
        refined=found.refined,
        lag=found.lag,
        counted=found.counted,
        position_noise=jnp.broadcast_to(jnp.asarray(given.position), batch),
        rotation_noise=jnp.broadcast_to(jnp.asarray(given.rotation), batch),
    )
    if not traced(estimates):
        estimates = jax.device_get(estimates)  # NumPy takes views where JAX would run programs

    def convert(leaf: Any) -> Any:
        return leaf.astype(dtype) if np.issubdtype(leaf.dtype, np.floating) else leaf

    return jax.tree.map(convert, estimates)


@dataclass(frozen=True)
class Paths:
    """Paths of a window's frames: components first, then samples, then windows.

    Attributes:
        rotation: (3, 3, K+1, N), and ``shift``: (3, K+1, N) m, of {b} in {g}, from the centre.
        turns: (3, K+1, N) rad, summed steps of rotation in the body of the angular type.
        along_angular: (3, K+1, N) the same along the axes of the angular frame.
        along_linear: (3, K+1, N) m, path of the origin along the axes of the linear frame.
        slopes: (3, 3, K+1, N) its derivatives by the coordinates of the origin.
        origin: (3, N) m, in the body it is fixed in, from the centre for types in the ground.
    """

    rotation: jax.Array
    shift: jax.Array
    turns: jax.Array
    along_angular: jax.Array
    along_linear: jax.Array
    slopes: jax.Array
    origin: jax.Array
    sampling: Sampling


def covariance_of_windows(
    poses: jax.Array, steps: jax.Array, count: jax.Array | None, found: Estimates, measured: bool
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Covariance of the estimates of N windows.

    Args:
        poses: (N, K+1, 4, 4), m.
        steps: (K,) or (N, K) s.
        count: (N,) number of poses in each window where the rest is padding, else None.
        found: of these windows.
        measured: whether to inflate it by what is left over.

    Returns:
        (N, 15, 15) of the turn of the angular axes, of the linear axes (rad, rotation vectors in the bodies
        of the types), the origin (m), the RMS along the angular (rad/s) and the linear axes (m/s); (N, 3) how
        much the standard deviations of the first three were inflated; (N,) bool, whether the objective is
        curved along all directions that are determined.
    """
    paths = paths_of(poses, steps, count, found)
    sampling = paths.sampling
    angular_dof, linear_dof = found.angular_dof.T, found.linear_dof.T
    free = jnp.moveaxis(found.free_position, 0, -1)
    turned = once(sampling.take(paths.along_angular))
    moved = once(sampling.take(paths.along_linear))
    flat = paths.slopes.reshape(9, *paths.slopes.shape[2:])
    slopes = once(sampling.take(flat).reshape(paths.slopes.shape))
    angular = once(angular_rows(turned, angular_dof))
    linear = once(linear_rows(moved, slopes, linear_dof, free))
    linear_path = _to_path(sampling, jnp.concatenate([linear.turn, linear.position]))
    angular_rms = _rms_path(paths.along_angular, None, sampling, angular_dof, None)
    best = paths.along_linear + jnp.sum(paths.slopes * linear.offset[None, :, None], axis=1)
    optimum = _to_path(sampling, linear.optimum)
    linear_rms = _rms_path(best, paths.slopes, sampling, linear_dof, optimum)
    angular_axes, linear_axes = _axes(found.angular_rotvec), _axes(found.linear_rotvec)
    of_turn = jnp.concatenate([_to_path(sampling, angular), angular_rms])
    of_turn = apply_to_rows(angular_axes[:, :, None], of_turn)
    still = _to_path(sampling, linear.still)
    of_shift = apply_to_rows(linear_axes[:, :, None], jnp.concatenate([linear_path, linear_rms, still]))
    first = turn_to_poses(once(of_turn), found.angular_type, paths.rotation, paths.turns)
    second, shift = position_to_poses(
        once(of_shift), found.linear_type, paths.rotation, paths.shift, paths.origin
    )
    rounding = _FLOOR * float(jnp.finfo(poses.dtype).eps)
    noise = (
        jnp.maximum(found.position_noise, rounding * jnp.sqrt(jnp.max(jnp.sum(paths.shift**2, 0), 0))),
        jnp.maximum(found.rotation_noise, rounding),
    )
    zero = jnp.zeros_like(first[:3])
    of_angular, of_linear = (first[:3], zero), (second[:3], shift[:3])
    explained = noise_covariance(
        jnp.concatenate([first[:3], second[:6]]), jnp.concatenate([zero, shift[:6]]), noise
    )
    of_still = (second[9:], shift[9:])
    of_angular, of_linear = _with_single_axis(paths, found, of_angular, of_linear, of_still, noise)
    # angular turn, linear turn, origin, angular rms, linear rms
    turn = jnp.concatenate([of_angular[0], of_linear[0], second[3:6], first[3:], second[6:9]])
    shift = jnp.concatenate([of_angular[1], of_linear[1], shift[3:6], zero, shift[6:9]])
    matrix = noise_covariance(turn, shift, noise)
    grown = jnp.ones((3, poses.shape[0]), poses.dtype)
    if measured:
        number = poses.shape[1] if count is None else count
        rows = angular, linear.turn, linear.position
        grown = _inflations(explained, rows, (turned, moved, moved), sampling, found, number)
    matrix = _to_body(matrix, angular_axes, linear_axes)
    factors = jnp.concatenate([jnp.repeat(grown, 3, axis=0), jnp.ones((6, *grown.shape[1:]), grown.dtype)])
    matrix = matrix * factors[:, None] * factors[None]
    return jnp.moveaxis(matrix, -1, 0), grown.T, linear.determined


def paths_of(poses: jax.Array, steps: jax.Array, count: jax.Array | None, found: Estimates) -> Paths:
    """Paths of the frames of N windows; arguments as in :func:`covariance_of_windows`."""
    windows, samples = poses.shape[0], poses.shape[1] - 1
    # a failed window computes with harmless poses
    failed = ~jnp.isfinite(found.position[:, 0])
    poses = jnp.where(failed[:, None, None, None], jnp.eye(4, dtype=poses.dtype)[None, None], poses)
    number = jnp.full(windows, samples + 1, jnp.int32) if count is None else count
    own = jnp.arange(samples + 1, dtype=jnp.int32)[None] < number[:, None]
    total = jnp.sum(jnp.where(own[:, :, None], poses[:, :, :3, 3], 0), axis=1)
    centre = total / number.astype(poses.dtype)[:, None]
    poses = poses.at[:, :, :3, 3].add(-centre[:, None])
    shared = jnp.broadcast_to(steps, (1, samples)) if steps.ndim == 1 else steps
    times = jnp.concatenate([jnp.zeros_like(shared[:, :1]), jnp.cumsum(shared, axis=1)], axis=1)
    times = jnp.broadcast_to(times, (windows, samples + 1))
    out = own & ~found.counted

    def mend(poses: jax.Array) -> jax.Array:
        return jnp.where(out[:, :, None, None], repair_poses(poses, times, number)[0], poses)

    poses = once(jax.lax.cond(jnp.any(out), mend, lambda poses: poses, poses))
    _, paths = once(kinematics.velocity_paths(poses, steps, count))
    top = jnp.moveaxis(poses[:, :, :3], (2, 3), (0, 1)).swapaxes(2, 3)
    rotation, shift = top[:, :3], top[:, 3]
    turns = _of_type(kinematics.rates_of(paths)[:, 0], found.angular_type)
    maps = _of_type(paths, found.linear_type)
    offset = jnp.take_along_axis(ground_offset(centre), found.linear_type[:, None, None], axis=1)[:, 0]
    origin = (found.position - offset).T
    path = maps[:, 0] + jnp.sum(maps[:, 1:] * origin[None, :, None], axis=1)
    back = jnp.swapaxes(_axes(found.linear_rotvec), 0, 1)[:, :, None]
    slopes = jnp.stack([apply_to_rows(back, maps[None, :, a])[0] for a in (1, 2, 3)], axis=1)
    angular_back = jnp.swapaxes(_axes(found.angular_rotvec), 0, 1)[:, :, None]
    return Paths(
        rotation=rotation,
        shift=shift,
        turns=turns,
        along_angular=apply_to_rows(angular_back, turns[None])[0],
        along_linear=apply_to_rows(back, path[None])[0],
        slopes=slopes,
        origin=origin,
        sampling=_sampling(paths, times, found),
    )


def _sampling(paths: jax.Array, times: jax.Array, found: Estimates) -> Sampling:
    counted = found.counted.T
    rotation, position = paths[:, 1:, :, _IN_BODY], paths[:, 0, :, _IN_BODY]
    noise = found.position_noise, found.rotation_noise
    weights = moving_chords(rotation, position, counted, found.lag, noise)
    weights = jnp.concatenate([weights, jnp.zeros_like(weights[:1])])
    last = times.shape[1] - 1
    end = jnp.minimum(jnp.arange(last + 1, dtype=jnp.int32)[:, None] + found.lag[None], last)
    span = jnp.take_along_axis(times.T, end, axis=0) - times.T
    number = jnp.maximum(jnp.sum(weights, axis=0), 1)
    scales = jnp.where(weights > 0, jnp.sqrt(weights / number[None]) / jnp.where(weights > 0, span, 1), 0)
    shares = counted.astype(paths.dtype)
    shares = shares / jnp.maximum(jnp.sum(shares, axis=0, keepdims=True), 1)
    return Sampling(found.refined, shares, found.lag, scales)


def _with_single_axis(
    paths: Paths,
    found: Estimates,
    angular: tuple[jax.Array, jax.Array],
    linear: tuple[jax.Array, jax.Array],
    still: tuple[jax.Array, jax.Array],
    noise: tuple[jax.Array, jax.Array],
) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
    """Sensitivities of turns to rotations and positions where the body turns about a single axis.

    The axis is then the one that the rotations keep in place; a linear frame whose odd axis is parallel to it
    takes the mean of its own and that, weighted as if the origin stood ``still``.
    """
    shares = paths.sampling.shares
    single = find_single_axis(paths.rotation, found.counted.T, found.rotation_noise)
    turns_once = single.found & found.refined & (jnp.sum(found.angular_dof, axis=1) == 1)
    angular_axes, linear_axes = _axes(found.angular_rotvec), _axes(found.linear_rotvec)
    in_body = found.angular_type == int(AngularType.B)
    rows = axis_rows(paths.rotation, shares, angular_axes, angular_axes[:, 2], in_body)
    angular = (jnp.where(turns_once[None, None, None], rows, angular[0]), angular[1])
    slides = jnp.sum(found.linear_dof, axis=1)
    last = slides == 1
    odd = jnp.where(last[None], linear_axes[:, 2], linear_axes[:, 0])
    on_body = parts_on_body(found.angular_type, found.linear_type)[:, 1]
    axis = jnp.where(on_body[None], single.in_body, single.in_ground)
    parallel = jnp.abs(jnp.sum(axis * odd, axis=0)) > _PARALLEL
    shared = turns_once & parallel & (last | (slides == 2))
    rows = axis_rows(paths.rotation, shares, linear_axes, odd, on_body)
    tilts = jnp.stack([last, jnp.ones_like(last), ~last]) & shared[None]  # about all axes but the odd one
    return angular, combine_rows(linear, still, (rows, jnp.zeros_like(rows)), tilts, noise)


def _of_type(array: jax.Array, kind: jax.Array) -> jax.Array:
    """From (..., K+1, T, N) what belongs to one type each, (..., K+1, N)."""
    index = kind.reshape(*[1] * (array.ndim - 1), -1)
    return jnp.take_along_axis(array, index, axis=-2)[..., 0, :]


def _axes(rotvec: jax.Array) -> jax.Array:
    """(3, 3, N) of (N, 3)."""
    return jnp.moveaxis(rotation_exp(rotvec), 0, -1)


def _to_path(sampling: Sampling, rows: jax.Array) -> jax.Array:
    """Sensitivities to the path, from those to its samples, (m, 3, K+1, N)."""
    flat = rows.reshape(-1, *rows.shape[2:])
    return sampling.give_back(flat).reshape(rows.shape)


def _rms_path(
    path: jax.Array, slopes: jax.Array | None, sampling: Sampling, dof: jax.Array, position: jax.Array | None
) -> jax.Array:
    """Sensitivities of the RMS velocities to the path, (3, 3, K+1, N)."""
    velocities = sampling.chords(path)
    steep = None
    if slopes is not None:
        steep = sampling.chords(slopes.reshape(9, *slopes.shape[2:])).reshape(slopes.shape)
    own, by_origin = rms_rows(velocities, steep, dof)
    back = sampling.from_chords(own)
    rows = jnp.stack([jnp.zeros_like(back).at[i].set(back[i]) for i in range(3)])
    if position is None:
        return rows
    return rows + jnp.stack([jnp.sum(by_origin[i][:, None, None] * position, axis=0) for i in range(3)])


def _inflations(
    matrix: jax.Array,
    rows: tuple[jax.Array, jax.Array, jax.Array],
    samples: tuple[jax.Array, jax.Array, jax.Array],
    sampling: Sampling,
    found: Estimates,
    count: jax.Array | int,
) -> jax.Array:
    """Of the angular axes, the linear axes and the origin, (3, N)."""
    block = -(-count // _BLOCKS)
    block = jnp.maximum(block, jnp.where(sampling.about_mean, 1, 2 * sampling.lag)).astype(jnp.int32)
    grown = []
    for group, dof in enumerate((found.angular_dof, found.linear_dof, found.linear_dof)):
        left_over = jnp.where((dof == 0).T[:, None], samples[group], 0)
        scores = jnp.sum(rows[group] * left_over[None], axis=1)
        explained = jnp.stack([matrix[i, i] for i in range(3 * group, 3 * group + 3)])
        grown.append(inflation(long_run_variance(scores, block), explained))
    return jnp.stack(grown)


def _to_body(matrix: jax.Array, angular_axes: jax.Array, linear_axes: jax.Array) -> jax.Array:
    """Turns about the axes of the frames become rotation vectors in the bodies of their types."""

    def left(m: jax.Array) -> jax.Array:
        turned = [
            jnp.sum(axes[:, :, None] * m[None, start : start + 3], axis=1)
            for axes, start in ((angular_axes, 0), (linear_axes, 3))
        ]
        return jnp.concatenate([*turned, m[6:]])

    return jnp.swapaxes(left(jnp.swapaxes(left(matrix), 0, 1)), 0, 1)

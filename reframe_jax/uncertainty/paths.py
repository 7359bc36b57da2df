"""The paths that frames were estimated from: repaired, averaged and sampled as they were identified."""

from dataclasses import dataclass, replace
from typing import Any, cast

import jax
import numpy as np

from reframe_jax.arrays import add, jnp, lax
from reframe_jax.compilation import once, traced
from reframe_jax.constraints.located import ground_offset, parts_on_body
from reframe_jax.constraints.types import LinearType
from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.identification.results import Identification, PoseNoise
from reframe_jax.motion import kinematics
from reframe_jax.motion.chords import moving_chords
from reframe_jax.motion.outliers import repair_poses
from reframe_jax.motion.single_axis import SingleAxis, find_single_axis, keep_axis
from reframe_jax.motion.smoothing import noise_share, smooth_noise
from reframe_jax.uncertainty.propagation import apply_to_rows
from reframe_jax.uncertainty.sampling import Sampling

__all__ = ["Estimates", "Paths", "axes_of", "estimates_of", "is_summed", "oriented_in_body", "paths_of"]

_IN_BODY = int(LinearType.GB)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Estimates:
    """What the covariance needs of N identifications.

    Attributes:
        angular_type, linear_type: (N,) codes.
        angular_rotvec, linear_rotvec, position: (N, 3) rad, rad and m.
        candidates: (N, 4, 3) m, origins of all linear types.
        twin: (N, 3) m, and ``has_twin``: (N,) bool.
        angular_dof, linear_dof: (N, 3).
        free_position: (N, 3, 3).
        refined: (N,) bool.
        on_screw: (N,) bool, whether the frames are those of a screw.
        lag: (N,) samples.
        counted: (N, K+1) bool.
        seen: noise that the recordings show, by which they were identified.
        position_noise, rotation_noise: (N,) m and rad, noise that the covariance is of.
    """

    angular_type: jax.Array
    linear_type: jax.Array
    angular_rotvec: jax.Array
    linear_rotvec: jax.Array
    position: jax.Array
    candidates: jax.Array
    twin: jax.Array
    has_twin: jax.Array
    angular_dof: jax.Array
    linear_dof: jax.Array
    free_position: jax.Array
    refined: jax.Array
    on_screw: jax.Array
    lag: jax.Array
    counted: jax.Array
    seen: PoseNoise
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
        candidates=cast(jax.Array, found.candidates.linear.position),
        twin=linear.twin,
        has_twin=linear.has_twin,
        angular_dof=angular.dof,
        linear_dof=linear.dof,
        free_position=linear.free_position,
        refined=found.refined,
        on_screw=found.screw_probability > 0,
        lag=found.lag,
        counted=found.counted,
        seen=found.noise,
        position_noise=given.position,
        rotation_noise=given.rotation,
    )
    xp: Any = jnp
    if not traced(estimates):
        xp, estimates = np, jax.device_get(estimates)  # NumPy takes views where JAX would run programs
    position, rotation = (
        xp.broadcast_to(xp.asarray(size), batch)
        for size in (estimates.position_noise, estimates.rotation_noise)
    )
    estimates = replace(estimates, position_noise=position, rotation_noise=rotation)

    def convert(leaf: Any) -> Any:
        return leaf.astype(dtype) if np.issubdtype(leaf.dtype, np.floating) else leaf

    return jax.tree.map(convert, estimates)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Paths:
    """Paths of a window's frames, as they were identified: components first, then samples, then windows.

    Attributes:
        rotation: (3, 3, K+1, N), and ``shift``: (3, K+1, N) m, of {b} in {g}, from the centre.
        turns: (3, K+1, N) rad, summed steps of rotation in the body of the angular type.
        along_angular: (3, K+1, N) the same along the axes of the angular frame.
        along_linear: (3, K+1, N) m, path of the origin along the axes of the linear frame.
        slopes: (3, 3, K+1, N) its derivatives by the coordinates of the origin.
        origin: (3, N) m, in the body it is fixed in, from the centre for types in the ground.
        rivals: (3, K+1, 4, N) m, paths of the origins of all linear types.
        single: axis about which the body turns, and ``kept``: (N,) bool, whether noise that leads away from
            it was taken out of the rotations; ``tilted``: the rotations with it.
        share: (N,) of the noise that averaging neighbours has left.
    """

    rotation: jax.Array
    shift: jax.Array
    turns: jax.Array
    along_angular: jax.Array
    along_linear: jax.Array
    slopes: jax.Array
    origin: jax.Array
    rivals: jax.Array
    single: SingleAxis
    kept: jax.Array
    tilted: jax.Array
    share: jax.Array
    sampling: Sampling

    @property
    def mean_rotation(self) -> jax.Array:
        """(3, 3, N)."""
        return jnp.sum(self.sampling.shares[None, None] * self.rotation, axis=2)


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
    poses = add(poses, np.s_[:, :, :3, 3], -centre[:, None])
    shared = jnp.broadcast_to(steps, (1, samples)) if steps.ndim == 1 else steps
    times = jnp.concatenate([jnp.zeros_like(shared[:, :1]), jnp.cumsum(shared, axis=1)], axis=1)
    times = jnp.broadcast_to(times, (windows, samples + 1))
    out = own & ~found.counted

    def mend(poses: jax.Array) -> jax.Array:
        return jnp.where(out[:, :, None, None], repair_poses(poses, times, number)[0], poses)

    poses = once(lax.cond(jnp.any(out), mend, lambda poses: poses, poses))
    rotation, shift, share = _averaged(poses, times, number, found)
    noise = share * found.seen.position, share * found.seen.rotation
    single = find_single_axis(rotation, shift, found.counted.T, noise)
    kept = single.found & found.refined & (found.lag > 1)

    straight = once(
        lax.cond(jnp.any(kept), keep_axis, lambda same, _: same, rotation, single._replace(found=kept))
    )
    paths = once(kinematics.paths_of(straight, shift, shared, count)[1])
    turns = lax.cond(
        jnp.any(kept),
        lambda: kinematics.turn_paths(kinematics.turn_rates(rotation, shared, count), shared),
        lambda: kinematics.rates_of(paths)[:, 0],
    )
    turns = once(_of_type(turns, found.angular_type))
    maps = _of_type(paths, found.linear_type)
    offsets = ground_offset(centre)
    offset = jnp.take_along_axis(offsets, found.linear_type[:, None, None], axis=1)[:, 0]
    origin = (found.position - offset).T
    origins = jnp.moveaxis(found.candidates - offsets, (0, 1), (2, 1))
    path = maps[:, 0] + jnp.sum(maps[:, 1:] * origin[None, :, None], axis=1)
    back = jnp.swapaxes(axes_of(found.linear_rotvec), 0, 1)[:, :, None]
    slopes = jnp.stack([apply_to_rows(back, maps[None, :, a])[0] for a in (1, 2, 3)], axis=1)
    angular_back = jnp.swapaxes(axes_of(found.angular_rotvec), 0, 1)[:, :, None]
    return once(
        Paths(
            rotation=straight,
            shift=shift,
            turns=turns,
            along_angular=apply_to_rows(angular_back, turns[None])[0],
            along_linear=apply_to_rows(back, path[None])[0],
            slopes=slopes,
            origin=origin,
            rivals=paths[:, 0] + jnp.sum(paths[:, 1:] * origins[None, :, None], axis=1),
            single=single,
            kept=kept,
            tilted=rotation,
            share=share,
            sampling=_sampling(paths, times, found),
        )
    )


def _averaged(
    poses: jax.Array, times: jax.Array, number: jax.Array, found: Estimates
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Rotations (3, 3, K+1, N) and positions (3, K+1, N) as they were identified, and the noise left in them.

    Where the noise was not found to be white, it is not known whether neighbours were averaged.
    """
    rotation, position = kinematics.split_poses(poses)
    seen, lag = (found.seen.position, found.seen.rotation), jnp.where(found.refined, found.lag, 0)
    rotation, position, width = once(
        smooth_noise(rotation, position, times.T, found.counted.T, number, seen, lag)
    )
    return rotation, position, noise_share(width, poses.dtype)


def _sampling(paths: jax.Array, times: jax.Array, found: Estimates) -> Sampling:
    counted = found.counted.T
    rotation, position = paths[:, 1:, :, _IN_BODY], paths[:, 0, :, _IN_BODY]
    noise = found.seen.position, found.seen.rotation
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


def _of_type(array: jax.Array, kind: jax.Array) -> jax.Array:
    """From (..., K+1, T, N) what belongs to one type each, (..., K+1, N)."""
    chosen = array[..., 0, :]
    for code in range(1, array.shape[-2]):
        chosen = jnp.where(kind == code, array[..., code, :], chosen)  # a gather takes each number by itself
    return chosen


def axes_of(rotvec: jax.Array) -> jax.Array:
    """(3, 3, N) of (N, 3)."""
    return jnp.moveaxis(rotation_exp(rotvec), 0, -1)


def oriented_in_body(found: Estimates) -> jax.Array:
    """Whether the axes of the linear frame are fixed in {b}, (N,)."""
    return parts_on_body(found.angular_type, found.linear_type)[:, 1]


def is_summed(found: Estimates) -> jax.Array:
    """Whether the path of the origin is summed up along the motion, (N,): in BB and GG."""
    on_body = parts_on_body(found.angular_type, found.linear_type)
    return on_body[:, 1] == on_body[:, 2]

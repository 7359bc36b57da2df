"""How far the motion went along every axis, in noises, and what that says about its freedom."""

import jax
import numpy as np

from reframe_jax.arrays import jnp
from reframe_jax.compilation import apply_each
from reframe_jax.constraints.types import ORIENTATION_BODIES, POSITION_BODIES
from reframe_jax.geometry import symmetric
from reframe_jax.geometry.products import matmul3
from reframe_jax.identification.evidence import IN_BODY, Evidence
from reframe_jax.identification.floored_moments import rounding_of
from reframe_jax.identification.freedom import Slide, freedom_patterns
from reframe_jax.identification.levers import lever_moments
from reframe_jax.identification.optima import Frames, constant_covariance, pick_type
from reframe_jax.objectives.moments import covariance_at, covariance_gradient, covariance_hessian

__all__ = [
    "distances_at_rest",
    "free_probabilities",
    "is_white",
    "likeliest_pattern",
    "noise_along",
    "pattern_probabilities",
    "share_of_turn",
]

_SQUARINGS = 4  # of a covariance, after which its largest eigenvalue is 16 times as far from the others
_WHITE = 2.0  # noises that constrained axes show at most where the noise is white


def is_white(distance: jax.Array, dof: tuple[jax.Array, jax.Array], winner: jax.Array) -> jax.Array:
    """Whether the constrained axes show white noise and nothing else, (N,).

    Args:
        distance: (6, N) in noises, along the axes of the winner.
        dof: as :func:`likeliest_pattern` returns it.
        winner: (N,) linear type.
    """
    held = jnp.concatenate([dof[0][:, 0], pick_type(dof[1], winner)], axis=1) == 0
    quiet = jnp.all(~held.T | (distance < _WHITE), axis=0)
    return quiet & jnp.any(held, axis=1)


def pattern_probabilities(
    evidence: Evidence,
    kind: jax.Array,
    frames: Frames,
    resting: tuple[jax.Array, jax.Array],
    helical: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Probability of every pattern of degrees of freedom for each linear type, and what it comes from.

    Args:
        evidence: of the windows.
        kind: (N,) the best angular type.
        frames: of all types.
        resting: of :func:`distances_at_rest`.
        helical: (N,) see :class:`.Slide`, of third linear axes that are the axis of rotation. An error in the
            scale of the turn does nothing there.

    Returns:
        (4, 4, N, 4), and (6, N, 4): how far each axis moved, in noises of single poses; linear axes as any
        point of the body did where the likeliest pattern has no rotation.
    """
    position, axes = frames.position, frames.axes
    tiny = float(jnp.finfo(axes.dtype).tiny)
    turned = pick_type(symmetric.to_matrix(constant_covariance(evidence.angular_spread)), kind)
    angular_axes = pick_type(frames.angular_axes, kind)
    squares = jnp.sum(angular_axes * matmul3(turned, angular_axes), axis=-2)
    whole = jnp.trace(turned, axis1=-2, axis2=-1)
    rounding = pick_type(rounding_of(evidence.angular_spread), kind)
    noise = (jnp.square(evidence.share * evidence.noise.rotation) + rounding)[:, None]
    # a body that does not turn at all, to the last digit, has no noise either
    angular = jnp.sqrt(jnp.maximum(squares, 0) / jnp.maximum(noise, tiny))
    x = jnp.moveaxis(position, -1, 0)
    spread = symmetric.to_matrix(covariance_at(evidence.linear_spread, (x[0], x[1], x[2])))
    squares = jnp.sum(axes * matmul3(spread, axes), axis=-2)
    variance, lever = noise_along(evidence, position, axes)
    variance = jnp.maximum(variance + rounding_of(evidence.linear_spread)[..., None], tiny)
    linear = jnp.sqrt(jnp.maximum(squares, 0) / variance)
    # at the end of a lever the body moves, and an error of the rotation does not move it further
    gone = symmetric.trace(tuple(evidence.positions))[:, None, None]
    gain = jnp.sqrt(jnp.minimum(lever * whole[:, None, None], gone) / variance)
    angular = jnp.broadcast_to(angular[:, None], linear.shape)
    turning = jnp.broadcast_to(jnp.sqrt(noise)[:, None], linear.shape)
    distance, sizes = (
        jnp.moveaxis(jnp.concatenate(pair, axis=-1), -1, 0)
        for pair in ((angular, linear), (turning, jnp.sqrt(variance)))
    )
    share = evidence.share[:, None]
    samples = evidence.poses.astype(axes.dtype)[:, None] * jnp.square(share)
    of_turn = share_of_turn(evidence.linear_spread, position, axes)
    slide = None
    if helical is not None:
        helical = helical[:, None]
        of_turn = jnp.where((helical < 0)[..., None] & (np.arange(3) == 2)[None, None], 0, of_turn)
        # noise of the rotation, over the turn, is the tilt; times how far the body went
        tilt = gone[..., 0] * (noise / jnp.maximum(whole[:, None], tiny))
        tilted = jnp.sqrt(jnp.maximum(squares[..., 2], 0) / (variance[..., 2] + tilt))
        slide = Slide(helical, tilted, resting[0][0])
    gain, of_turn = (jnp.moveaxis(array, -1, 0) for array in (gain, of_turn))
    patterns = freedom_patterns(distance, sizes, gain, of_turn, samples, share, resting, slide)
    turns = jnp.argmax(patterns.reshape(16, *patterns.shape[2:]), axis=0) // 4 > 0
    linear = jnp.where(turns[None], distance[3:], resting[0])
    return patterns, jnp.concatenate([distance[:3], linear]) * share[None]


def distances_at_rest(evidence: Evidence) -> tuple[jax.Array, jax.Array]:
    """How far a body that does not turn went, see :func:`.freedom_patterns`: (3, N, 1) each.

    In noises, along the principal axes of its path, and those noises in m.
    """
    variance = jnp.square(evidence.share * evidence.noise.position)
    variance = jnp.maximum(
        variance + rounding_of(evidence.linear_spread)[:, IN_BODY], float(jnp.finfo(variance.dtype).tiny)
    )
    squares, _ = symmetric.eigh(tuple(evidence.positions))
    distance = jnp.sqrt(jnp.maximum(jnp.stack(squares), 0) / variance[None])
    return distance[..., None], jnp.broadcast_to(jnp.sqrt(variance)[None], distance.shape)[..., None]


def share_of_turn(moments: jax.Array, position: jax.Array, axes: jax.Array) -> jax.Array:
    """Share of the motion along each linear axis that is proportional to the rotation, (N, 4, 3), 0 to 1.

    The rotation is seen as the motion, along the same axis, of the end of a lever that it moves most.

    Args:
        moments: (6, 10, N, 4) of the paths.
        position: (N, 4, 3) m, origins of all types.
        axes: (N, 4, 3, 3).
    """
    e = axes[..., 0, :], axes[..., 1, :], axes[..., 2, :]
    x = jnp.moveaxis(position, -1, 0)

    def along(covariance: symmetric.Symmetric) -> jax.Array:
        xx, xy, xz, yy, yz, zz = (entry[..., None] for entry in covariance)
        return symmetric.quadratic_form(e, (xx, xy, xz, yy, yz, zz), e)

    at_origin = x[0], x[1], x[2]
    slopes, bends = covariance_gradient(moments, at_origin), covariance_hessian(moments)
    whole, *squares = apply_each(along, [covariance_at(moments, at_origin), *slopes, *bends])
    # of a square, derivatives have a factor of two
    with_origin = jnp.stack(squares[:3], axis=-1) / 2
    xx, xy, xz, yy, yz, zz = (bend / 2 for bend in squares[3:])
    levers = symmetric.to_matrix((xx, xy, xz, yy, yz, zz))
    lever = _main_direction(levers)
    longest = jnp.sum(lever * matmul3(levers, lever[..., None])[..., 0], axis=-1)
    common = jnp.square(jnp.sum(lever * with_origin, axis=-1))
    # along the axis of rotation no lever moves, and nothing but rounding is left of it
    moves = longest > rounding_of(moments)[..., None]
    share = common / jnp.maximum(longest * whole, float(jnp.finfo(axes.dtype).tiny))
    return jnp.where(moves, jnp.clip(share, 0, 1), 0)


def _main_direction(matrix: jax.Array) -> jax.Array:
    """The direction of the largest eigenvalue of covariances (..., 3, 3), nearly: (..., 3), of any length."""
    for _ in range(_SQUARINGS):
        trace = jnp.trace(matrix, axis1=-2, axis2=-1)[..., None, None]
        matrix = matrix / jnp.where(trace > 0, trace, 1)
        matrix = matmul3(matrix, matrix)
    largest = jnp.argmax(jnp.diagonal(matrix, axis1=-2, axis2=-1), axis=-1)[..., None, None]
    return jnp.take_along_axis(matrix, largest, axis=-2)[..., 0, :]


def noise_along(evidence: Evidence, position: jax.Array, axes: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Noise of a frame's origin along its axes, (N, 4, 3) m^2, and the square of the lever it acts through.

    Noise in orientation acts through the lever from the origin of {b} to that of the frame, as far as the
    lever is perpendicular to the axis; in the types whose path is summed up along the motion (BB and GG) the
    noise of the steps adds up as well.

    Args:
        evidence: of the windows.
        position: (N, 4, 3) m, origins of all types.
        axes: (N, 4, 3, 3).
    """
    x = jnp.moveaxis(position, -1, 0)
    second = symmetric.to_matrix(covariance_at(lever_moments(evidence), (x[0], x[1], x[2])))
    along = jnp.sum(axes * matmul3(second, axes), axis=-2)
    lever = jnp.maximum(jnp.trace(second, axis1=-2, axis2=-1)[..., None] - along, 0)
    # of noise that leads away from a single axis nothing is left: the lever acts across that axis
    axis = jnp.stack([evidence.axis.in_ground, evidence.axis.in_body])
    axis = jnp.moveaxis(axis[ORIENTATION_BODIES], -1, 0)  # (N, 4, 3)
    across = jnp.cross(axes, axis[..., None], axis=-2)
    about = jnp.maximum(jnp.sum(across * matmul3(second, across), axis=-2), 0)
    lever = jnp.where(evidence.alone[:, None, None], about, lever)
    of_position = jnp.square(evidence.noise.position)[:, None, None]
    of_rotation = jnp.square(evidence.noise.rotation)[:, None, None]
    variance = of_position + of_rotation * lever
    left = jnp.square(evidence.share)[:, None, None]
    summed = (ORIENTATION_BODIES == POSITION_BODIES)[None, :, None]
    turns, shifts = (square[:, None, None] / 2 for square in evidence.travel)
    # steps add up to the same whether their noise was averaged before or not
    return left * variance + jnp.where(summed, turns * variance + shifts * of_rotation, 0), lever


def likeliest_pattern(patterns: jax.Array, winner: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Degrees of freedom of both angular types, (N, 2, 3), and of all linear ones, (N, 4, 3)."""
    best = jnp.argmax(patterns.reshape(16, *patterns.shape[2:]), axis=0).astype(jnp.int32)  # (N, 4)
    rotations_free = jnp.take_along_axis(best, winner[:, None], axis=1) // 4
    ranks = jnp.arange(3, dtype=jnp.int32)[None, None]
    angular = (ranks >= 3 - rotations_free[..., None]).astype(jnp.int32)
    linear = (ranks >= 3 - (best % 4)[..., None]).astype(jnp.int32)
    return jnp.broadcast_to(angular, (len(winner), 2, 3)), linear


def free_probabilities(number: jax.Array) -> jax.Array:
    """Probability that each axis is free, (N, 3), from that of every number of free axes, (N, 4)."""
    return jnp.cumsum(number[:, :0:-1], axis=1)

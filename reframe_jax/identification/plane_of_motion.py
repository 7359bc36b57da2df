"""The axis of a hinge from the plane in which the body moves.

A body that turns about one axis and does not slide along it moves in a plane, and the axis is its normal.
Trackers measure positions far better than orientations: where their errors are slow ones, the plane through
the positions knows the axis better than the rotations do, the more so the further the body went across it.
"""

from dataclasses import replace
from functools import partial

import jax

from reframe_jax.arrays import jnp
from reframe_jax.constraints.types import PARALLEL_COSINE, AngularType
from reframe_jax.geometry import symmetric
from reframe_jax.geometry.products import matmul3
from reframe_jax.identification.evidence import Evidence
from reframe_jax.identification.optima import Frames, constant_covariance, follow_where, put_third_axis

__all__ = ["use_plane"]


def use_plane(evidence: Evidence, frames: Frames, dof: jax.Array, chosen: jax.Array) -> Frames:
    """Put the single axis of rotation where it agrees best with the rotations and with the plane.

    Its tilt along each side of the plane is the mean of both, with weights s^2 / r^2: s is how far the body
    turned, or went along that side, and r what is left across, of the rotations or of the positions.

    Args:
        evidence: of N windows.
        frames: of all types.
        dof: (N, 2, 3) degrees of freedom of the angular types.
        chosen: (N,) bool, the windows that this is for; the frames of others stay as they are.
    """
    axes = frames.angular_axes
    in_ground = axes[:, AngularType.G, :, 2]
    (left, *went), directions = symmetric.eigh(tuple(evidence.positions))  # type: ignore[arg-type]
    normal, *sides = (jnp.stack(direction, axis=-1) for direction in directions)
    along = jnp.sum(normal * in_ground, axis=-1, keepdims=True)
    normal = jnp.where(along < 0, -normal, normal)
    left = jnp.maximum(left, jnp.square(evidence.share * evidence.noise.position))

    turned = symmetric.to_matrix(constant_covariance(evidence.angular_spread))[:, AngularType.G]
    squares = jnp.sum(axes[:, AngularType.G] * matmul3(turned, axes[:, AngularType.G]), axis=-2)
    single = chosen & (jnp.sum(dof[:, 0], axis=-1) == 1) & (jnp.abs(along[:, 0]) > PARALLEL_COSINE)
    mean = jnp.moveaxis(evidence.mean_paths[:, 1:, :, 0], 2, 0)
    # a body that does not turn, or stays on a line, divides by squares of zero
    of_single = in_ground, normal, sides, left, went, squares, mean
    in_ground, normal, sides, left, went, squares, mean = jax.tree.map(
        partial(follow_where, single), of_single
    )
    tiny = float(jnp.finfo(axes.dtype).tiny)
    by_rotation = squares[:, 2] / jnp.maximum((squares[:, 0] + squares[:, 1]) / 2, tiny)
    fused = normal
    for side, square in zip(sides, went, strict=True):
        by_plane = (square - left) / jnp.maximum(left, tiny)
        weight = by_rotation / jnp.maximum(by_rotation + jnp.maximum(by_plane, 0), tiny)
        fused = fused + (weight * jnp.sum(side * in_ground, axis=-1))[:, None] * side
    fused = fused / jnp.linalg.norm(fused, axis=-1, keepdims=True)
    tilt = matmul3((fused - in_ground)[:, None], mean)[:, 0]
    thirds = {AngularType.G: fused, AngularType.B: axes[:, AngularType.B, :, 2] + tilt}
    third = follow_where(single, jnp.stack([thirds[kind] for kind in AngularType], axis=1))
    third = third / jnp.linalg.norm(third, axis=-1, keepdims=True)
    return replace(frames, angular_axes=put_third_axis(axes, third, single))

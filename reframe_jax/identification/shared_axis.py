"""One axis instead of two: where a body turns about the odd axis of its linear frame.

In a cylinder joint the free rotation and the free translation have one axis, and in a plane-plane contact the
free rotation is about the normal. Both groups then measure the same axis. Together they know it better than
either: the rotation where it turned far, the translation where it went far.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp

from reframe_jax.constraints.types import PARALLEL_COSINE, LinearType
from reframe_jax.geometry import symmetric
from reframe_jax.geometry.products import matmul3
from reframe_jax.identification.distances import noise_along
from reframe_jax.identification.evidence import Evidence
from reframe_jax.identification.optima import Frames
from reframe_jax.objectives.moments import covariance_at

__all__ = ["share_axis"]


def share_axis(
    evidence: Evidence, frames: Frames, dof: tuple[jax.Array, jax.Array], white: jax.Array
) -> Frames:
    """Put the odd axis of each linear frame where it agrees best with a parallel axis of rotation.

    The two tilts are averaged with weights n s^2 / noise^2, the information of n samples that spread by s
    along the direction of the tilt.

    Args:
        evidence: of N windows.
        frames: of all types.
        dof: degrees of freedom, (N, 2, 3) and (N, 4, 3).
        white: (N,) bool, whether the noise is known; the frames of other windows stay as they are.
    """
    free = jnp.sum(dof[1], axis=-1)
    last = (free == 1)[
        ..., None
    ]  # the odd axis is the free one, the last; else the constrained one, the first
    odd = jnp.where(last, frames.axes[..., 2], frames.axes[..., 0])
    sides = frames.axes[..., 1], jnp.where(last, frames.axes[..., 0], frames.axes[..., 2])
    both = jnp.stack([evidence.axis.in_ground, evidence.axis.in_body])
    rotation = jnp.stack([both[int(kind.orientation_body)].T for kind in LinearType], axis=1)
    along = jnp.sum(rotation * odd, axis=-1, keepdims=True)
    rotation = jnp.where(along < 0, -rotation, rotation)

    squares, noise = _spread_and_noise(evidence, frames)
    of_odd = jnp.where(last[..., 0], squares[..., 2], squares[..., 0])
    of_rotation = evidence.axis.spread / jnp.square(evidence.share * evidence.noise.rotation)
    fused = odd
    for number, side in enumerate(sides):
        other = jnp.where(last[..., 0], squares[..., 1 - number], squares[..., 1 + number])
        held = jnp.where(last[..., 0], noise[..., 1 - number], noise[..., 0])
        weight = of_rotation[:, None] / (of_rotation[:, None] + jnp.abs(of_odd - other) / held)
        fused = fused + (weight * jnp.sum(rotation * side, axis=-1))[..., None] * side
    fused = _unit(fused)
    remaining = sides[1] - fused * jnp.sum(fused * sides[1], axis=-1, keepdims=True)
    first, third = (
        _unit(jnp.where(last, one, other)) for one, other in ((remaining, fused), (fused, remaining))
    )
    axes = jnp.stack([first, jnp.cross(third, first), third], axis=-1)
    single = evidence.axis.found & white & (jnp.sum(dof[0][:, 0], axis=-1) == 1)
    parallel = (jnp.abs(along[..., 0]) > PARALLEL_COSINE) & ((free == 1) | (free == 2))
    chosen = (single[:, None] & parallel)[..., None, None]
    return replace(
        frames,
        axes=jnp.where(chosen, axes, frames.axes),
        local_axes=jnp.where(chosen, axes, frames.local_axes),
    )


def _spread_and_noise(evidence: Evidence, frames: Frames) -> tuple[jax.Array, jax.Array]:
    """Mean squares about the mean path along the axes of all types, and the noise in them, (N, 4, 3) m^2."""
    x = jnp.moveaxis(frames.position, -1, 0)
    spread = symmetric.to_matrix(covariance_at(evidence.linear_spread, (x[0], x[1], x[2])))
    squares = jnp.sum(frames.axes * matmul3(spread, frames.axes), axis=-2)
    noise, _ = noise_along(evidence, frames.position, frames.axes)
    return squares, jnp.maximum(noise, jnp.finfo(noise.dtype).tiny)


def _unit(vector: jax.Array) -> jax.Array:
    return vector / jnp.sqrt(jnp.sum(jnp.square(vector), axis=-1, keepdims=True))

"""One axis instead of two: where a body turns about the odd axis of its linear frame.

In a cylinder joint the free rotation and the free translation have one axis, and in a plane-plane contact the
free rotation is about the normal. Both groups then measure the same axis. Together they know it better than
either: the rotation where it turned far, the translation where it went far.
"""

from dataclasses import replace

import jax

from reframe_jax.arrays import jnp
from reframe_jax.constraints.types import (
    ORIENTATION_BODIES,
    PARALLEL_COSINE,
    SQUARE_COSINE,
    AngularType,
    LinearType,
)
from reframe_jax.geometry import symmetric
from reframe_jax.geometry.products import matmul3
from reframe_jax.identification.distances import noise_along
from reframe_jax.identification.evidence import Evidence
from reframe_jax.identification.optima import Frames, follow_where, put_third_axis
from reframe_jax.objectives.moments import covariance_at

__all__ = ["axis_of_rotation", "share_axis", "slides_along_axis"]


def share_axis(
    evidence: Evidence,
    frames: Frames,
    dof: tuple[jax.Array, jax.Array],
    winner: jax.Array,
    white: jax.Array,
) -> Frames:
    """Give the frames of a body that turns about a single axis one axis where the constraint has one.

    - A body that slides along the axis: the free axes of both frames are the mean of both estimates. Their
      tilts are weighted with n s^2 / noise^2, the information of n samples that spread by s along the
      direction of the tilt. What the best linear type says holds for all, in the other body by the mean
      rotation.
    - A body that moves in a plane: its axis of rotation is known from both already. The normal of a plane of
      contact is that axis; a single free translation is perpendicular to it.

    Args:
        evidence: of N windows.
        frames: of all types.
        dof: degrees of freedom, (N, 2, 3) and (N, 4, 3).
        winner: (N,) best linear type.
        white: (N,) bool, whether the noise is known; the frames of other windows stay as they are.
    """
    free = jnp.sum(dof[1], axis=-1)
    rotation = axis_of_rotation(evidence)
    planar = (_turns_once(evidence, dof, white) & evidence.axis.planar)[:, None]
    first, _, third = (frames.axes[..., n] for n in range(3))

    along, across = _dot(rotation, third), _dot(rotation, first)
    slides = slides_along_axis(evidence, frames, dof, white)
    faces = planar & (free == 2) & (jnp.abs(across) > PARALLEL_COSINE)
    aside = planar & (free == 1) & (jnp.abs(along) < SQUARE_COSINE)
    fused = _mean_axis(evidence, frames, jnp.where(along < 0, -1, 1)[..., None] * rotation, slides)
    shared = jnp.all(slides, axis=1)
    turning = _in_both_bodies(evidence, fused, winner, shared)
    same = turning[:, ORIENTATION_BODIES]
    same = jnp.where(_dot(same, fused)[..., None] < 0, -same, same)
    fused = jnp.where(shared[:, None, None], same, fused)
    # elsewhere the third axis may be the axis of rotation, with nothing beside it
    beside = _unit(follow_where(faces | aside, third - along[..., None] * rotation))
    third = jnp.where((faces | aside)[..., None], beside, jnp.where(slides[..., None], fused, third))
    first = jnp.where(faces[..., None], jnp.where(across < 0, -1, 1)[..., None] * rotation, first)
    first = _unit(first - third * _dot(first, third)[..., None])
    turned = jnp.stack([first, jnp.cross(third, first), third], axis=-1)
    chosen = (slides | faces | aside)[..., None, None]
    return replace(
        frames,
        angular_axes=put_third_axis(frames.angular_axes, turning, shared),
        axes=jnp.where(chosen, turned, frames.axes),
        local_axes=jnp.where(chosen, turned, frames.local_axes),
    )


def _in_both_bodies(evidence: Evidence, axes: jax.Array, winner: jax.Array, chosen: jax.Array) -> jax.Array:
    """One of the axes (N, 4, 3), in the body that the best type is oriented in and in the other, (N, 2, 3).

    It is taken from the type whose origin has a path: the noise of a path that is summed up is larger.
    """
    on_body = (jnp.asarray(ORIENTATION_BODIES)[winner] == AngularType.B)[:, None]
    mean = jnp.moveaxis(evidence.mean_paths[:, 1:, :, 0], 2, 0)
    # a body that does not turn divides by zero
    axes, mean = follow_where(chosen, axes), follow_where(chosen, mean)
    in_ground, in_body = axes[:, LinearType.GB], axes[:, LinearType.BG]
    carried = _unit(matmul3(mean, in_body[..., None])[..., 0]), _unit(matmul3(in_ground[:, None], mean)[:, 0])
    return jnp.stack(
        [jnp.where(on_body, carried[0], in_ground), jnp.where(on_body, in_body, carried[1])], axis=1
    )


def slides_along_axis(
    evidence: Evidence, frames: Frames, dof: tuple[jax.Array, jax.Array], white: jax.Array
) -> jax.Array:
    """Whether a body slides along the single axis it turns about, (N, 4); arguments as above."""
    single = _turns_once(evidence, dof, white) & ~evidence.axis.planar
    along = _dot(axis_of_rotation(evidence), frames.axes[..., 2])
    return single[:, None] & (jnp.sum(dof[1], axis=-1) == 1) & (jnp.abs(along) > PARALLEL_COSINE)


def _turns_once(evidence: Evidence, dof: tuple[jax.Array, jax.Array], white: jax.Array) -> jax.Array:
    """Windows (N,) with white noise whose body turns about a single axis."""
    return evidence.axis.found & white & (jnp.sum(dof[0][:, 0], axis=-1) == 1)


def axis_of_rotation(evidence: Evidence) -> jax.Array:
    """The axis about which the body turns, in the bodies of the linear types' orientations, (N, 4, 3)."""
    axis = evidence.axis
    return jnp.stack([axis.in_ground.T, axis.in_body.T], axis=1)[:, ORIENTATION_BODIES]


def _mean_axis(evidence: Evidence, frames: Frames, rotation: jax.Array, chosen: jax.Array) -> jax.Array:
    """Mean of the free axes of the linear frames and the axes of rotation, both (N, 4, 3), where chosen.

    A body that does not turn has no such mean: its rotations have neither spread nor noise.
    """
    spread = follow_where(jnp.any(chosen, axis=1), evidence.axis.spread)
    of_rotation = spread / jnp.square(evidence.share * evidence.noise.rotation)
    inputs = *_spread_and_noise(evidence, frames), frames.axes, rotation, of_rotation[:, None]
    squares, noise, axes, rotation, of_rotation = (follow_where(chosen, array) for array in inputs)
    fused = axes[..., 2]
    for n in (0, 1):
        information = jnp.abs(squares[..., 2] - squares[..., n]) / noise[..., n]
        weight = of_rotation / (of_rotation + information)
        side = axes[..., n]
        fused = fused + (weight * _dot(rotation, side))[..., None] * side
    return _unit(fused)


def _spread_and_noise(evidence: Evidence, frames: Frames) -> tuple[jax.Array, jax.Array]:
    """Mean squares about the mean path along the axes of all types, and the noise in them, (N, 4, 3) m^2."""
    x = jnp.moveaxis(frames.position, -1, 0)
    spread = symmetric.to_matrix(covariance_at(evidence.linear_spread, (x[0], x[1], x[2])))
    squares = jnp.sum(frames.axes * matmul3(spread, frames.axes), axis=-2)
    noise, _ = noise_along(evidence, frames.position, frames.axes)
    return squares, jnp.maximum(noise, jnp.finfo(noise.dtype).tiny)


def _unit(vector: jax.Array) -> jax.Array:
    return vector / jnp.sqrt(jnp.sum(jnp.square(vector), axis=-1, keepdims=True))


def _dot(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.sum(a * b, axis=-1)

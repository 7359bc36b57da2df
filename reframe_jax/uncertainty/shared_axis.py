"""How the frames of a body that turns about a single axis depend on the poses.

Such frames have axes in common, see :mod:`reframe_jax.identification.shared_axis`. Their errors are those of
the axis, of the linear frame, or of a mean of both.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax

from reframe_jax.arrays import jnp, lax
from reframe_jax.compilation import once
from reframe_jax.constraints.types import PARALLEL_COSINE, SQUARE_COSINE, AngularType
from reframe_jax.uncertainty.paths import Estimates, Paths, axes_of, oriented_in_body
from reframe_jax.uncertainty.propagation import apply_to_rows, cross_rows
from reframe_jax.uncertainty.turning import axis_moves, axis_rows, carried_rows, combine_rows

__all__ = ["SharedAxes", "rows_with_axis", "shared_axes", "with_tilt"]


_Rows = tuple[jax.Array, jax.Array]  # sensitivities to rotations and to positions
_Parts = tuple[_Rows, _Rows, jax.Array]  # of the angular and the linear frame; bias of the latter


class SharedAxes(NamedTuple):
    """In which windows the linear frame shares the axis about which the body turns.

    Attributes:
        alone: (N,) bool, whether the angular axis is that of :mod:`reframe_jax.motion.single_axis`.
        slides: (N,) bool, whether the third axes of both frames are the mean of both estimates.
        faces: (N,) bool, whether its first axis is the axis of rotation.
        aside: (N,) bool, whether its third axis is perpendicular to it.
    """

    alone: jax.Array
    slides: jax.Array
    faces: jax.Array
    aside: jax.Array


def shared_axes(paths: Paths, found: Estimates) -> SharedAxes:
    """Compute which axes are shared, as :mod:`reframe_jax.identification.shared_axis` does."""
    single, linear_axes = paths.single, axes_of(found.linear_rotvec)
    alone = single.found & found.refined & (jnp.sum(found.angular_dof, axis=1) == 1)
    planar = alone & single.planar
    slides = jnp.sum(found.linear_dof, axis=1)
    axis = jnp.where(oriented_in_body(found)[None], single.in_body, single.in_ground)
    first, _, third = jnp.abs(jnp.sum(linear_axes * axis[:, None], axis=0))
    return SharedAxes(
        alone=alone,
        slides=alone & ~planar & (slides == 1) & (third > PARALLEL_COSINE),
        faces=planar & (slides == 2) & (first > PARALLEL_COSINE),
        aside=planar & (slides == 1) & (third < SQUARE_COSINE),
    )


def rows_with_axis(
    paths: Paths,
    found: Estimates,
    angular: _Rows,
    linear: _Rows,
    still: Callable[[], jax.Array],
    noise: tuple[jax.Array, jax.Array],
    bias: jax.Array,
) -> _Parts:
    """Sensitivities of turns to rotations and positions where the body turns about a single axis.

    The axis is then the one of :mod:`reframe_jax.motion.single_axis`, and the linear frame has it in common
    with the angular one, see :mod:`reframe_jax.identification.shared_axis`. The mean of two estimates is
    weighted by the variances (2, N) of turns about the first two axes if the origin stood ``still``. The
    ``bias`` (3, N) of the turns of the linear frame, which the axis does not have, comes last.
    """
    angular_axes, linear_axes = axes_of(found.angular_rotvec), axes_of(found.linear_rotvec)
    shared, on_body = shared_axes(paths, found), oriented_in_body(found)
    angular_on_body = found.angular_type == int(AngularType.B)
    own = axis_rows(paths, angular_axes, angular_axes[:, 2], angular_on_body)
    angular = _choose(shared.alone, own, angular)

    def with_odd(_: None) -> _Parts:
        """Where it is the odd axis of the linear frame."""
        odd = jnp.where(shared.faces[None], linear_axes[:, 0], linear_axes[:, 2])
        rotation = once(axis_rows(paths, linear_axes, odd, on_body))
        # a turn about the third axis does not move it
        variances = jnp.concatenate([still(), jnp.zeros_like(bias[:1])])
        *mean, weight = combine_rows(linear, variances, rotation, shared.slides, noise)
        rows = once(_choose(shared.faces, rotation, (mean[0], mean[1])))
        weight = jnp.where(shared.faces[None], 1, weight)
        carried = _to_angular(paths, angular_axes, linear_axes, rows, (angular_on_body, on_body))
        return _choose(shared.slides, carried, angular), rows, (1 - weight) * bias

    def with_side(parts: _Parts) -> _Parts:
        """Where the free axis of the linear frame is perpendicular to it."""
        angular, (turn, shift), bias = parts
        axis = jnp.where(on_body[None], paths.single.in_body, paths.single.in_ground)
        tilt, drift = axis_moves(paths, -linear_axes[None, :, 2], axis, on_body)
        inside = jnp.sum(linear_axes[:, :2] * axis[:, None], axis=0)
        aside = with_tilt(turn, tilt[0], inside), with_tilt(shift, drift[0], inside)
        turned = with_tilt(bias, jnp.zeros_like(bias[0]), inside)
        return (
            angular,
            _choose(shared.aside, aside, (turn, shift)),
            jnp.where(shared.aside[None], turned, bias),
        )

    parts = angular, linear, bias
    odd_somewhere = jnp.any(shared.slides | shared.faces)
    parts = lax.cond(odd_somewhere, with_odd, lambda _: parts, None)
    parts = lax.cond(jnp.any(shared.aside), with_side, lambda parts: parts, parts)
    return parts


def _choose(here: jax.Array, new: _Rows, old: _Rows) -> _Rows:
    """Sensitivities to rotations and positions of the windows (N,) chosen."""
    turn, shift = (jnp.where(here[None, None, None], a, b) for a, b in zip(new, old, strict=True))
    return turn, shift


def with_tilt(turns: jax.Array, tilt: jax.Array, inside: jax.Array) -> jax.Array:
    """Turns (3, ..., N) about the axes of a frame whose third axis tilts by so much, (..., N), along another.

    Args:
        turns: the turns of the frame by its own samples.
        tilt: along an axis that is perpendicular to the third.
        inside: (2, N) that axis, in the first two axes of the frame.
    """
    x, y = (c.reshape(*[1] * (tilt.ndim - 1), -1) for c in inside)
    across = -y * turns[1] - x * turns[0]
    return jnp.stack([-(tilt * y + across * x), tilt * x - across * y, turns[2]])


def _to_angular(
    paths: Paths,
    angular_axes: jax.Array,
    linear_axes: jax.Array,
    rows: _Rows,
    on_body: tuple[jax.Array, jax.Array],
) -> _Rows:
    """Sensitivities of turns of the angular frame whose third axis is that of the linear frame.

    Args:
        paths: of the windows.
        angular_axes: (3, 3, N).
        linear_axes: (3, 3, N).
        rows: of turns about the linear axes.
        on_body: (N,) bool, whether the angular and the linear frame are oriented in {b}.
    """
    mean = paths.mean_rotation
    odd = angular_axes[:, 2]
    directions = cross_rows(jnp.swapaxes(angular_axes, 0, 1), odd[None])
    to_body, to_ground = on_body[0] & ~on_body[1], on_body[1] & ~on_body[0]
    there = jnp.where(to_body[None, None], apply_to_rows(mean, directions), directions)
    there = jnp.where(to_ground[None, None], apply_to_rows(jnp.swapaxes(mean, 0, 1), directions), there)
    axis = jnp.where(to_body[None], apply_to_rows(mean, odd[None])[0], odd)
    axis = jnp.where(to_ground[None], apply_to_rows(jnp.swapaxes(mean, 0, 1), odd[None])[0], axis)
    same = jnp.sign(jnp.sum(axis * linear_axes[:, 2], axis=0))
    first, second = (jnp.sum(there * linear_axes[None, :, n], axis=1) * same[None] for n in (0, 1))

    def moved(turns: jax.Array) -> jax.Array:
        return jnp.stack(
            [turns[1] * a[None, None] - turns[0] * b[None, None] for a, b in zip(first, second, strict=True)]
        )

    def to_body_too(turn: jax.Array) -> jax.Array:
        return turn + carried_rows(paths, directions, axis, to_body)

    def to_ground_too(turn: jax.Array) -> jax.Array:
        shares = jnp.where(to_ground[None], paths.sampling.shares, 0)
        return turn - shares[None, None] * cross_rows(directions[:, :, None], odd[None, :, None])

    turn, shift = (moved(part) for part in rows)
    turn = lax.cond(jnp.any(to_body), to_body_too, lambda turn: turn, turn)
    return lax.cond(jnp.any(to_ground), to_ground_too, lambda turn: turn, turn), shift

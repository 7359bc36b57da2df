"""Bodies on a screw: they slide along the axis of rotation in proportion to the turn.

On a screw of pitch h about a line with direction e through c, a point p of the body has the velocity
w (h e + e x (p - c)). Seen from one of the bodies it has the same direction at all times, whatever p is: two
axes are still, and the determinant cannot tell the origin. Origins on the line are those that move along e.

All arrays have components first and windows last, but for frames and results.
"""

from dataclasses import replace
from functools import partial
from typing import NamedTuple, cast

import jax

from reframe_jax.arrays import jnp, lax
from reframe_jax.constraints.types import ORIENTATION_BODIES, POSITION_BODIES, AngularType
from reframe_jax.geometry import symmetric
from reframe_jax.geometry.products import matmul3
from reframe_jax.geometry.symmetric import INDEX_PAIRS, Symmetric, Vector
from reframe_jax.identification.coupled_axes import screw_probabilities
from reframe_jax.identification.evidence import IN_BODY, IN_GROUND, Evidence
from reframe_jax.identification.floored_moments import FLOOR
from reframe_jax.identification.optima import Frames, follow_last, put_third_axis
from reframe_jax.motion.components import product, transpose, unit
from reframe_jax.motion.single_axis import across_axis
from reframe_jax.objectives.moments import MONOMIALS, covariance_at
from reframe_jax.solvers import Box

__all__ = ["Screw", "find_screw"]

_LIKELY = 0.5
_SURE = 1e-3  # of the noise, what is left of a slide at least
_TRUSTED = 4.0  # squares of noises that are left of a slide that tells the axis
_QUIET = 2.0  # noises that a point of the axis moves across it at most where the noise is white
_SEEN = 3.5  # noises that a slide goes at least


class Screw(NamedTuple):
    """The screws that N windows would be on.

    Attributes:
        pitch: (N,) m/rad.
        likely: (N,) bool, whether the slide is likely to be proportional to the turn, or made by a tilt of
            the axis. The frames are right then, though a cylinder joint that was turned and pushed evenly
            moves like that as well.
        probability: (N,) of a screw, against a cylinder joint.
        rest: (N,) logarithm of what the turn does not explain of the slide, as a share of the slide.
        frames: of all types, on the axis.
    """

    pitch: jax.Array
    likely: jax.Array
    probability: jax.Array
    rest: jax.Array
    frames: Frames


class _Seen(NamedTuple):
    """What is differentiated of the evidence, in windows that turn about a single axis.

    Attributes:
        in_ground, in_body: (3, N) the axis.
        mean: (3, 4, N) mean path of the type GB.
        paths: (6, 10, N) moments of the paths of that type.
        positions: (6, N) m^2.
        with_angle: (3, 4, N) covariance of the paths with the angle.
        variance: (N,) rad^2, of the angle; ``turned`` without its noise.
        stiffness: (N,) m^2, see :class:`SingleAxis`.
    """

    in_ground: jax.Array
    in_body: jax.Array
    mean: jax.Array
    paths: jax.Array
    positions: jax.Array
    with_angle: jax.Array
    variance: jax.Array
    turned: jax.Array
    stiffness: jax.Array


def find_screw(
    evidence: Evidence, frames: Frames, box: Box, single: jax.Array, across_plane: jax.Array
) -> Screw:
    """Find the axis and the pitch of bodies on a screw, and how probable it is that they are on one.

    The pitch is the slope of the slide over the turn. The axis and a point on it are where the squares of all
    errors are least: of the rotations, which resist a tilt of the axis, and of the path of that point, along
    the axis and across it. This is linear in the point and in a small tilt. Where errors are larger than the
    noise, the axis stays, and the point is the origin of a type whose origin has a path: GB or BG.

    Args:
        evidence: of N windows.
        frames: of all types.
        box: where origins were searched, m; those on the axis must lie in it.
        single: (N,) bool, whether the body turns about a single axis.
        across_plane: (N,) motion of the body across the plane nearest to its path, in noises.
    """
    usable = single & (evidence.turning.variance > 0)
    of_turning = jnp.square(evidence.share * evidence.noise.rotation)
    of_position = jnp.square(evidence.share * evidence.noise.position)
    seen = _look(evidence, frames, usable, of_turning)
    known = evidence.axis.found & (evidence.noise.rotation > 0) & (evidence.noise.position > 0)
    # a slide with a motion of its own says nothing about a tilt
    left, _, pitch = _left_of_slide(seen, seen.in_ground)
    expected = of_position + jnp.square(pitch) * of_turning
    trust = jnp.where(left > _TRUSTED * expected, _TRUSTED * expected / jnp.where(left > 0, left, 1), 1)
    tilt, point = _tilt_and_point(seen, pitch, known, lax.stop_gradient(trust))
    across = _moves_across(seen, pitch, tilt, point)
    in_ground = unit(seen.in_ground + tilt)
    in_body = unit(seen.in_body + product(transpose(seen.mean[:, 1:]), tilt))
    left, slid, pitch = _left_of_slide(seen, in_ground)

    rounding = FLOOR * float(jnp.finfo(pitch.dtype).eps)
    size = slid + jnp.square(pitch) * seen.variance
    noise = of_position + jnp.square(pitch) * of_turning + rounding * size
    noise = jnp.maximum(noise, float(jnp.finfo(pitch.dtype).tiny))
    lever = _dot(point, point)
    # moments have a floor of a few roundings of all their entries
    entries = [seen.paths[i, MONOMIALS.index((a, a))] for i in (0, 3, 5) for a in range(4)]
    beside = 2 * of_position + of_turning * lever + 4 * rounding * sum(entries, jnp.zeros_like(lever))
    quiet = across < _QUIET**2 * beside

    def in_noises(square: jax.Array, noise: jax.Array) -> jax.Array:
        ratio = lax.stop_gradient((jnp.maximum(square, 0), noise))
        return jnp.sqrt(ratio[0] / ratio[1])

    uneven = jnp.square(pitch) * (evidence.turning.unsteady - of_turning)
    likely, probability = screw_probabilities(
        in_noises(left, noise),
        in_noises(across, jnp.maximum(beside, float(jnp.finfo(pitch.dtype).tiny))),
        (in_noises(slid, noise), in_noises(uneven, noise)),
        in_noises((jnp.square(pitch) + lever) * seen.turned, noise),
        evidence.poses.astype(pitch.dtype) * jnp.square(evidence.share),
        evidence.share,
    )
    # in a plane nobody slides: the axis that is seen is tilted, by errors that look like a motion
    tilted = (across_plane < _QUIET) & (in_noises(slid, noise) > _SEEN)
    origins = _origins(seen, frames, quiet, point, (in_ground, in_body))
    inside = ~jnp.any(box.at_face(origins), axis=(-2, -1))
    chosen = usable & ((likely > _LIKELY) | tilted) & inside & jnp.isfinite(pitch)
    axes = jnp.stack([in_ground.T, in_body.T], axis=1)
    rest = jnp.log(jnp.minimum(lax.stop_gradient(jnp.maximum(left, noise * _SURE) / size), _LIKELY))
    return Screw(pitch, chosen, probability, rest / 2, _on_axis(frames, axes, origins, chosen))


def _look(evidence: Evidence, frames: Frames, usable: jax.Array, of_turning: jax.Array) -> _Seen:
    """What the screw is found from; without derivatives in windows where it divides by zero."""
    turning = evidence.turning
    in_ground, in_body = (frames.angular_axes[:, kind, :, 2].T for kind in AngularType)
    mean, paths = evidence.mean_paths[..., 0], evidence.linear_spread[..., IN_BODY]
    given = in_ground, in_body, mean, paths, evidence.positions, turning.with_paths, turning.variance
    followed = jax.tree.map(partial(follow_last, usable), (*given, evidence.axis.stiffness))
    in_ground, in_body, mean, paths, positions, with_angle, variance, stiffness = followed
    # the angle is measured about this axis
    in_ground = jnp.where(_dot(in_ground, evidence.axis.in_ground)[None] < 0, -in_ground, in_ground)
    same = _dot(in_body, product(transpose(mean[:, 1:]), in_ground))
    in_body = jnp.where(same[None] < 0, -in_body, in_body)
    variance = jnp.where(usable, variance, 1)
    turned = jnp.maximum(variance - of_turning, variance / 2)
    return _Seen(in_ground, in_body, mean, paths, positions, with_angle, variance, turned, stiffness)


def _left_of_slide(seen: _Seen, axis: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Mean squares (N,) m^2 of the slide along an axis (3, N): what the turn leaves of it, all; the pitch."""
    along = _dot(axis, seen.with_angle[:, 0])
    pitch = along / seen.turned
    slid = _square_along(tuple(seen.positions), axis)
    return slid - 2 * pitch * along + jnp.square(pitch) * seen.variance, slid, pitch


def _tilt_and_point(
    seen: _Seen, pitch: jax.Array, known: jax.Array, trust: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """How far the axis is tilted, (3, N) in {g}, and the point of {b} on it nearest to its origin, (3, N) m.

    Of a point q and a tilt d of the axis e with the projector Q across it, they minimise the mean square of
    Q (a + B q) - h t d, the path of the point across the axis at the angle t, plus that of (e + d) . a - h t,
    plus s d^2, where s is the stiffness. The point is eliminated. The second of these counts as much as
    ``trust``, (N,), says.
    """
    e, y, angle = seen.in_ground, seen.in_body, seen.with_angle
    across = jnp.stack([(1 if i == j else 2) * ((1 if i == j else 0) - e[i] * e[j]) for i, j in INDEX_PAIRS])
    bends = jnp.sum(across[:, None] * seen.paths, axis=0)  # traces of Q and every coefficient

    def bend(a: int, b: int) -> jax.Array:
        return bends[MONOMIALS.index((a, b))] / (1 if a == b else 2)

    pull = jnp.stack([bend(0, a) for a in (1, 2, 3)])
    levers = [bend(a + 1, b + 1) for a, b in INDEX_PAIRS]
    # along the axis a point may be anywhere
    size = symmetric.trace(levers)
    free = [size * y[a] * y[b] for a, b in INDEX_PAIRS]
    matrix = cast(Symmetric, tuple(lever + one for lever, one in zip(levers, free, strict=True)))

    def solve(v: jax.Array) -> jax.Array:
        return jnp.stack(symmetric.solve(matrix, (v[0], v[1], v[2])))

    still = solve(pull)
    turned = [solve(angle[i, 1:]) for i in range(3)]
    left = [
        jnp.square(pitch) * ((seen.turned if i == j else 0) - _dot(angle[i, 1:], turned[j]))
        for i, j in INDEX_PAIRS
    ]
    partial_ = [
        trust * (seen.positions[k] - angle[i, 0] * angle[j, 0] / seen.turned)
        for k, (i, j) in enumerate(INDEX_PAIRS)
    ]
    along, slope = across_axis(e, cast(Symmetric, tuple(partial_)), seen.stiffness)
    beside, _ = across_axis(e, cast(Symmetric, tuple(left)), jnp.zeros_like(pitch))
    stiff = cast(Symmetric, tuple(a + b for a, b in zip(along, beside, strict=True)))
    drift = pitch[None] * (angle[:, 0] - product(angle[:, 1:], still))
    drift = drift - e * _dot(e, drift)[None] - jnp.stack(slope)
    tilt = jnp.where(known[None], jnp.stack(symmetric.solve(stiff, (drift[0], drift[1], drift[2]))), 0)
    moved = tilt[0][None] * turned[0] + tilt[1][None] * turned[1] + tilt[2][None] * turned[2]
    point = pitch[None] * moved - still
    return tilt, point


def _moves_across(seen: _Seen, pitch: jax.Array, tilt: jax.Array, point: jax.Array) -> jax.Array:
    """Mean square of the path of a point of the axis across the axis, (N,) m^2."""
    e = seen.in_ground
    covariance = covariance_at(seen.paths, (point[0], point[1], point[2]))
    whole = symmetric.trace(covariance) - _square_along(covariance, e)
    with_angle = seen.with_angle[:, 0] + product(seen.with_angle[:, 1:], point)
    return whole + pitch * (pitch * seen.variance * _dot(tilt, tilt) - 2 * _dot(tilt, with_angle))


def _origins(
    seen: _Seen, frames: Frames, quiet: jax.Array, point: jax.Array, axes: tuple[jax.Array, jax.Array]
) -> jax.Array:
    """Origins of all types on the axis, (N, 4, 3) m, nearest to the origin of {b} or to the centre."""
    on_body = jnp.where(quiet[None], point, frames.position[:, IN_BODY].T)
    passed = seen.mean[:, 0] + product(seen.mean[:, 1:], on_body)
    on_ground = jnp.where(quiet[None], passed, frames.position[:, IN_GROUND].T)
    places = [p - e * _dot(e, p)[None] for p, e in zip((on_ground, on_body), axes, strict=True)]
    return jnp.stack([place.T for place in places], axis=1)[:, POSITION_BODIES]


def _on_axis(frames: Frames, third: jax.Array, origins: jax.Array, chosen: jax.Array) -> Frames:
    """The frames of the chosen windows (N,) with the axis, (N, 2, 3), and the origins, (N, 4, 3) m."""
    angular = put_third_axis(frames.angular_axes, third, chosen)
    axes = jnp.where(chosen[:, None, None, None], angular[:, ORIENTATION_BODIES], frames.axes)
    turn = matmul3(jnp.swapaxes(frames.axes, -1, -2), axes)
    local = jnp.where(chosen[:, None, None, None], matmul3(frames.local_axes, turn), frames.local_axes)
    position = jnp.where(chosen[:, None, None], origins, frames.position)
    return replace(frames, angular_axes=angular, position=position, axes=axes, local_axes=local)


def _square_along(matrix: tuple[jax.Array, ...], axis: jax.Array) -> jax.Array:
    """The square along an axis (3, N)."""
    e: Vector = (axis[0], axis[1], axis[2])
    return symmetric.quadratic_form(e, cast(Symmetric, matrix), e)


def _dot(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.sum(a * b, axis=0)

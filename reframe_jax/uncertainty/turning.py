"""Sensitivities of an axis that the rotations keep in place.

Where a body turns about a single axis, that axis is taken from the mean rotation M: y, in the body, belongs
to its largest singular value, and x = M y is the axis in the ground (:mod:`reframe_jax.motion.single_axis`).
With errors e of the rotations, in the ground, and s the other singular values, the axis moves along m,
perpendicular to it, by the mean over the poses of

    e . ((R - M) m x x) / (1 - s^2)  in the body,      e . ((R M^T - 1) m x x) / (1 - s^2)  in the ground.

A body that moves in a plane has the axis where |n - x|^2 s + n.P.n is least, P being the covariance of its
positions p and s the stiffness. With A = Q P Q + s, where Q takes n out, it moves along m by s A^-1 m of the
above, and with errors d of the positions by minus the mean of (p . A^-1 m) (d . n). In the body it is M^T n.

Rotations that are brought back to that axis keep of their errors those about it, (e . x) x, and those of the
axis itself, x x (dx - R dy).
"""

import jax

from reframe_jax.arrays import jnp, lax
from reframe_jax.geometry import symmetric
from reframe_jax.motion.single_axis import across_axis
from reframe_jax.uncertainty.paths import Paths
from reframe_jax.uncertainty.propagation import apply_to_rows, cross_rows
from reframe_jax.uncertainty.sandwich import noise_variances

__all__ = ["axis_moves", "axis_rows", "carried_rows", "combine_rows", "kept_rows"]


def axis_rows(
    paths: Paths, axes: jax.Array, odd: jax.Array, on_body: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Sensitivities to pose errors of the turns that take the axis along with a frame, (3, 3, K+1, N) each.

    Args:
        paths: of the windows.
        axes: (3, 3, N) of the frame, columns; a turn about each of them is a row.
        odd: (3, N) the one that lies along the axis of rotation.
        on_body: (N,) bool, whether the frame is oriented in {b}; else in {g}.
    """
    # a turn about k moves the axis along k x a, by minus that along a x k
    return axis_moves(paths, cross_rows(jnp.swapaxes(axes, 0, 1), odd[None]), odd, on_body)


def axis_moves(
    paths: Paths, directions: jax.Array, odd: jax.Array, on_body: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Sensitivities to pose errors of how far the axis moves along directions perpendicular to it.

    Args:
        paths: of the windows.
        directions: (m, 3, N), in {b} or {g}.
        odd: (3, N) the axis there, either way round.
        on_body: (N,) bool, whether that is {b}.

    Returns:
        Those to rotations and to positions, (m, 3, K+1, N) each.
    """
    mean = paths.mean_rotation
    in_ground = jnp.where(on_body[None], apply_to_rows(mean, odd[None])[0], odd)
    along = jnp.where(on_body[None, None], apply_to_rows(mean, directions), directions)
    of_body, of_ground, shift = _axis_pulls(paths, along, in_ground)
    carried = jnp.where(on_body[None, None], directions, 0)
    return _axis_rows(paths, of_body + carried, of_ground, in_ground), shift


def carried_rows(paths: Paths, directions: jax.Array, in_ground: jax.Array, to_body: jax.Array) -> jax.Array:
    """Sensitivities to rotation errors of an axis of the ground as it is seen in the body, (m, 3, K+1, N).

    Args:
        paths: of the windows.
        directions: (m, 3, N) along which the axis moves in the body.
        in_ground: (3, N) the axis.
        to_body: (N,) bool, the windows that this is for; zero in others.
    """
    directions = jnp.where(to_body[None, None], directions, 0)
    return _axis_rows(paths, directions, jnp.zeros_like(directions), in_ground)


def kept_rows(turn: jax.Array, shift: jax.Array, paths: Paths) -> tuple[jax.Array, jax.Array]:
    """Sensitivities to measured poses, from those to poses whose rotations were kept about an axis.

    Args:
        turn: (m, 3, K+1, N) sensitivities to errors of the rotations, in the ground.
        shift: (m, 3, K+1, N) likewise, of the positions.
        paths: of the windows.

    Returns:
        Both, the same for windows that were not kept about an axis.
    """
    in_ground = paths.single.in_ground
    axis = in_ground[None, :, None]
    tilts = cross_rows(turn, axis)
    at_ground = jnp.sum(tilts, axis=2)
    at_body = jnp.sum(apply_to_rows(jnp.swapaxes(paths.rotation, 0, 1), tilts), axis=2)
    along = at_ground - apply_to_rows(paths.mean_rotation, at_body)
    of_body, of_ground, drift = _axis_pulls(paths, along, in_ground)
    kept = jnp.sum(turn * axis, axis=1, keepdims=True) * axis
    kept = kept + _axis_rows(paths, of_body - at_body, of_ground, in_ground)
    chosen = paths.kept[None, None, None]
    return jnp.where(chosen, kept, turn), shift + jnp.where(chosen, drift, 0)


def _axis_pulls(
    paths: Paths, along: jax.Array, in_ground: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """What moves the axis of the ground along directions (m, 3, N).

    Returns:
        What :func:`_axis_rows` takes, (m, 3, N) in the body and in the ground, for the rotations; and the
        sensitivities to positions, (m, 3, K+1, N).
    """
    shares, single, mean = paths.sampling.shares, paths.single, paths.mean_rotation

    def with_plane(_: None) -> tuple[jax.Array, jax.Array]:
        about = paths.shift - jnp.sum(shares[None] * paths.shift, axis=1, keepdims=True)
        spread = [jnp.sum(shares * about[i] * about[j], axis=0) for i, j in symmetric.INDEX_PAIRS]
        xx, xy, xz, yy, yz, zz = spread
        matrix = across_axis(in_ground, (xx, xy, xz, yy, yz, zz), single.stiffness)[0]
        solved = jnp.stack([jnp.stack(symmetric.solve(matrix, (v[0], v[1], v[2]))) for v in along])
        weight = jnp.where(single.planar, jnp.sum(solved[:, :, None] * about[None], axis=1) * shares[None], 0)
        pulled = jnp.where(single.planar[None, None], solved * single.stiffness[None, None], along)
        return pulled, -weight[:, None] * in_ground[None, :, None]

    def without(_: None) -> tuple[jax.Array, jax.Array]:
        return along, jnp.zeros((*along.shape[:2], *shares.shape), along.dtype)

    pulled, drift = lax.cond(jnp.any(single.planar), with_plane, without, None)
    left = 1 - _middle_singular_value(mean)
    pulled = pulled / jnp.where(left > 0, left, 1)[None, None]
    return apply_to_rows(jnp.swapaxes(mean, 0, 1), pulled), pulled, drift


def _axis_rows(paths: Paths, of_body: jax.Array, of_ground: jax.Array, axis: jax.Array) -> jax.Array:
    """The mean over the poses of e . ((R b - g) x axis), b and g in the body and the ground, by e.

    Args:
        paths: of the windows.
        of_body: (m, 3, N), b.
        of_ground: (m, 3, N), g.
        axis: (3, N) in the ground.

    Returns:
        (m, 3, K+1, N).
    """
    apart = apply_to_rows(paths.rotation, of_body[:, :, None]) - of_ground[:, :, None]
    return paths.sampling.shares[None, None] * cross_rows(apart, axis[None, :, None])


def _middle_singular_value(mean: jax.Array) -> jax.Array:
    """Square of the singular values across the axis, (N,), which are equal for turns about one axis."""
    return (jnp.sum(jnp.square(mean), axis=(0, 1)) - 1) / 2


def combine_rows(
    own: tuple[jax.Array, jax.Array],
    first: jax.Array,
    other: tuple[jax.Array, jax.Array],
    both: jax.Array,
    noise: tuple[jax.Array, jax.Array],
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Sensitivities of the mean of two estimates of the same numbers, weighted by their information.

    Args:
        own: sensitivities of one to rotations and positions, (m, 3, K+1, N) each.
        first: (m, N) variances that its weight is taken from; 0 for numbers that are its own alone.
        other: of the other.
        both: (N,) bool, windows whose numbers are the mean of both; in the rest they are ``own``.
        noise: (N,) m and (N,) rad.

    Returns:
        Those to rotations and positions, and the weight of the other estimate, (m, N).
    """
    second = noise_variances(*other, noise)
    total = first + second
    weight = jnp.where(both[None] & (second > 0), first / jnp.where(total > 0, total, 1), 0)
    share = weight[:, None, None]
    turn, shift = ((1 - share) * a + share * b for a, b in zip(own, other, strict=True))
    return turn, shift, weight

"""From poses to velocities: twists, and the affine velocity maps in which frames are searched.

The velocity of a constraint frame's origin is affine in the unknown position p of that origin,

    u(k; p) = a(k) + B(k) p,

for each of the four linear frame types (section 4 and Table 3 of the paper, with p the *location* of
the origin, so v + w x p). This module computes (a, B).

Inside, arrays are laid out components first, then samples, then windows: a rotation is (3, 3, K, ...).
Every operation is then elementwise on long rows of windows and needs no kernels for small matrices, which are
slow in XLA. The public functions take and return samples and components last.
"""

from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.compilation import once
from reframe_jax.geometry import rotations

__all__ = [
    "Discretization",
    "angular_velocities",
    "body_twists",
    "linear_velocity_maps",
    "paths_of",
    "rates_of",
    "spatial_twists",
    "split_poses",
    "turns_of",
    "velocity_components",
    "velocity_paths",
]

Discretization = Literal["chord", "left"]

_STENCIL = 7  # samples in the derivative of the twist
_EVEN = 5  # longest over shortest step, above which derivatives across them amplify noise


def _step_times(dt: jax.Array | float, poses: jax.Array) -> jax.Array:
    """Sample time of every step, (..., K): of size 1 along axes in which the windows do not differ."""
    dt = jnp.asarray(dt, dtype=poses.dtype)
    dt = dt.reshape((1,) * (poses.ndim - 2 - dt.ndim) + dt.shape)
    return jnp.broadcast_to(dt, (*dt.shape[:-1], poses.shape[-3] - 1))


def _inside_out(array: jax.Array, components: int) -> jax.Array:
    """(..., K, components) to (components, K, ...), for a number of component axes."""
    axes = range(-components, 0)
    return jnp.moveaxis(array, (*axes, -components - 1), tuple(range(components + 1)))


def _outside_in(array: jax.Array, components: int) -> jax.Array:
    """Inverse of :func:`_inside_out`."""
    axes = range(-components, 0)
    return jnp.moveaxis(array, tuple(range(components + 1)), (*axes, -components - 1))


def _product(a: jax.Array, b: jax.Array) -> jax.Array:
    """Matrix product (3, 3, ...) (3, n, ...) or matrix times vector (3, 3, ...) (3, ...)."""
    if b.ndim == a.ndim:
        return a[:, 0, None] * b[0, None] + a[:, 1, None] * b[1, None] + a[:, 2, None] * b[2, None]
    return a[:, 0] * b[0, None] + a[:, 1] * b[1, None] + a[:, 2] * b[2, None]


def _cross(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _hat(w: jax.Array) -> jax.Array:
    """(3, ...) to (3, 3, ...): see :func:`reframe_jax.geometry.rotations.hat`."""
    zero = jnp.zeros_like(w[0])
    rows = ([zero, -w[2], w[1]], [w[2], zero, -w[0]], [-w[1], w[0], zero])
    return jnp.stack([jnp.stack(row) for row in rows])


def _transpose(matrix: jax.Array) -> jax.Array:
    return jnp.swapaxes(matrix, 0, 1)


def split_poses(poses: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Rotations (3, 3, K+1, ...) and positions (3, K+1, ...) of poses (..., K+1, 4, 4)."""
    top = once(_inside_out(poses[..., :3, :], 2))
    return top[:, :3], top[:, 3]


def _log_of_step(rotation: jax.Array, shift: jax.Array) -> jax.Array:
    """Twist (6,) whose exponential is the step (3, 3), (3,)."""
    w = rotations.rotation_log(rotation)
    return jnp.concatenate([w, _product(rotations.left_jacobian_inverse(w), shift)])


def _body_twists(rotation: jax.Array, position: jax.Array, step: jax.Array) -> jax.Array:
    """(6, K, ...)."""
    back = _transpose(rotation[:, :, :-1])
    turn, shift = _product(back, rotation[:, :, 1:]), _product(back, jnp.diff(position, axis=1))
    log = _log_of_step
    for _ in range(shift.ndim - 1):
        log = jax.vmap(log, in_axes=-1, out_axes=-1)
    return log(turn, shift) / step[None]


def _spatial_twists(rotation: jax.Array, position: jax.Array, body: jax.Array) -> jax.Array:
    """Body twists taken to {g}, (6, K, ...)."""
    rotation, position = rotation[:, :, :-1], position[:, :-1]
    w = _product(rotation, body[:3])
    return jnp.concatenate([w, _product(rotation, body[3:]) + _cross(position, w)])


def body_twists(poses: jax.Array, dt: jax.Array | float) -> jax.Array:
    """Mean body twist over every step: ``log(T(k)^-1 T(k+1)) / dt``.

    This is Eq. 9 of the paper solved for the twist, with the product in the order that makes it a
    twist in the body frame.

    Args:
        poses: (..., K+1, 4, 4), of {b} in {g}; m.
        dt: sample time in s: a scalar, or (..., K) for irregular sampling.

    Returns:
        (..., K, 6) as (w, v) in {b}; rad/s, m/s.
    """
    return _outside_in(_mean_twists(*split_poses(poses), _step_times(dt, poses))[0], 1)


def spatial_twists(poses: jax.Array, dt: jax.Array | float) -> jax.Array:
    """Mean spatial twist over every step: the body twist taken to {g} by the adjoint (Eq. 2).

    Arguments and shapes as in :func:`body_twists`; the result is in {g}.
    """
    return _outside_in(_mean_twists(*split_poses(poses), _step_times(dt, poses))[1], 1)


def _mean_twists(rotation: jax.Array, position: jax.Array, steps: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Body and spatial twists, (6, K, ...); the sample times are (..., K)."""
    body = once(_body_twists(rotation, position, _inside_out(steps, 0)))
    return body, once(_spatial_twists(rotation, position, body))


def _derivative_weights(dt: jax.Array, count: jax.Array | None = None) -> jax.Array:
    """Finite-difference weights on irregular nodes: exact for polynomials of degree 6.

    The nodes are the middles of the steps; each derivative uses the seven nearest.

    Args:
        dt: (..., K) s.
        count: (...) how many of the steps count, 7 or more; the others are padding. All by default.

    Returns:
        (..., K, n) in 1/s, for the derivative at each node: the weights of n consecutive nodes, or with a
        ``count`` those of the nodes from 6 before it to 6 after it.
    """
    steps = dt.shape[-1]
    n = min(_STENCIL, steps)
    each = np.arange(steps, dtype=np.int32)
    nth = np.arange(n, dtype=np.int32)
    if count is None:
        first = jnp.asarray(np.clip(each - n // 2, 0, steps - n))
        spans = dt[..., first[:, None] + nth[None]]
    else:
        each = each.reshape(*[1] * count.ndim, -1)
        first = jnp.clip(each - n // 2, 0, count[..., None] - n)
        dt = jnp.broadcast_to(dt, first.shape)
        nth = nth.reshape(*[1] * first.ndim, -1)
        nodes = first[..., None] + nth
        spans = jnp.take_along_axis(dt, nodes.reshape(*first.shape[:-1], -1), axis=-1).reshape(nodes.shape)
    time = jnp.cumsum(spans, axis=-1) - spans / 2
    # Lagrange's polynomial of node i has the derivative (c_h / c_i) / (t_h - t_i) at node h, c_i being
    # the product of t_i - t_j over the other nodes j; those of all nodes add up to zero
    gaps = time[..., :, None] - time[..., None, :]
    products = jnp.prod(jnp.where(jnp.broadcast_to(np.eye(n, dtype=bool), gaps.shape), 1, gaps), axis=-1)
    own_place = (each - first)[..., None]
    here = jnp.broadcast_to(nth.reshape(*[1] * (own_place.ndim - 1), -1) == own_place, time.shape)
    inside = jnp.any(here, axis=-1, keepdims=True)  # everywhere but in padding
    gap = jnp.where(inside, jnp.sum(jnp.where(here[..., None], gaps, 0), axis=-2), 1)
    own = jnp.sum(jnp.where(here, products, 0), axis=-1, keepdims=True)
    others = jnp.where(here, 0, own / (products * jnp.where(here, 1, gap)))
    weights = jnp.where(here, -jnp.sum(others, axis=-1, keepdims=True), others)
    if count is None:
        return weights
    place = first - each + (n - 1)  # of the first node, counted from 6 before
    offsets = np.arange(2 * n - 1, dtype=np.int32).reshape((*nth.shape[:-1], -1))
    rows = [jnp.where(place[..., None] + i == offsets, weights[..., i, None], 0) for i in range(n)]
    return sum(rows[1:], rows[0])


def _derivative(weights: jax.Array, x: jax.Array) -> jax.Array:
    """Derivative of samples (m, K, ...) with weights (n, K, ...), see :func:`_derivative_weights`."""
    n, steps = weights.shape[:2]
    if n > _STENCIL:  # centred
        margin = n // 2
        padded = jnp.pad(x, ((0, 0), (margin, margin), *[(0, 0)] * (x.ndim - 2)))
        shifted = [weights[j, None] * padded[:, j : steps + j] for j in range(n)]
        return sum(shifted[1:], shifted[0])
    margin = n // 2
    ends = [
        jnp.sum(weights[None, :, rows] * x[:, nodes, None], axis=1)
        for rows, nodes in (
            (slice(margin), slice(n)),
            (slice(steps - n + 1 + margin, None), slice(steps - n, None)),
        )
    ]
    inner = weights[:, margin : steps - n + 1 + margin]
    shifted = [inner[j, None] * x[:, j : steps - n + 1 + j] for j in range(n)]
    return jnp.concatenate([ends[0], sum(shifted[1:], shifted[0]), ends[1]], axis=1)


def _bracket(a: jax.Array, b: jax.Array) -> jax.Array:
    """Lie bracket of twists (w, v): [a, b] = (wa x wb, wa x vb - wb x va)."""
    wa, va, wb, vb = a[:3], a[3:], b[:3], b[3:]
    return jnp.concatenate([_cross(wa, wb), _cross(wa, vb) - _cross(wb, va)])


def _without_brackets(
    means: jax.Array, dt: jax.Array, spatial: bool, count: jax.Array | None = None
) -> jax.Array:
    """Mean twists of the steps with the brackets of the Magnus expansion removed, to sixth order in dt.

    With a1 = h V, a2 = h^2 V', a3 = h^3 V''/2, a4 = h^4 V'''/6 at the middle of a step of length h, the
    logarithm of the step is, for the spatial twist V (Blanes, Casas, Oteo & Ros 2009),

        a1 + a3/12 - [a1,a2]/12 - [a1,a4]/80 + [a2,a3]/240 + [a1,[a1,a3]]/360 - [a2,[a1,a2]]/240
           + [a1,[a1,[a1,a2]]]/720,

    and for the body twist the same with every bracket turned round. The terms without brackets average
    V over the step: a component that is always zero stays zero. The brackets mix components: left in,
    they are an error along constrained axes that no amount of data removes (0.1 degrees and 0.3 mm for
    lively motion at dt = 0.1 s). In a window whose steps differ widely, as across a gap in the recording,
    they are left in: the derivatives would make far more of the noise.

    Args:
        means: (6, K, ...) mean twists.
        dt: (..., K) s.
        spatial: whether they are spatial or body twists.
        count: see :func:`_derivative_weights`.
    """
    # constants are multiplied with, as in h * (1 / 24): in float64 a division takes a GPU far longer
    weights, h = once(_inside_out(_derivative_weights(dt, count), 1)), _inside_out(dt, 0)[None]
    first = once(_derivative(weights, means))
    second = once(_derivative(weights, first))
    turn = 1.0 if spatial else -1.0
    # from the mean to the middle of the step; steps of unequal length jump in this, so no derivative
    # may be taken of anything that still has a factor h in it
    middle = means - h**2 * (1 / 24) * second + h**2 * (turn / 12) * _bracket(means, first)
    a1, a2 = h * middle, h**2 * _derivative(weights, middle)
    a3, a4 = h**3 * (1 / 2) * second, h**4 * (1 / 6) * _derivative(weights, second)
    a1, a2, a3, a4 = once((a1, a2, a3, a4))
    a12 = once(_bracket(a1, a2))
    # the terms above, grouped by their outer factor
    in_first = (turn / 720) * a12 + (1 / 360) * a3
    first_bracket = _bracket(a1, _bracket(a1, in_first) - (turn / 12) * a2 - (turn / 80) * a4)
    second_bracket = _bracket(a2, (turn / 240) * a3 - (1 / 240) * a12)
    even = _inside_out(jnp.max(dt, axis=-1, keepdims=True) <= _EVEN * jnp.min(dt, axis=-1, keepdims=True), 0)
    return means - jnp.where(even[None], (first_bracket + second_bracket) * once(1 / h), 0)


def velocity_components(
    poses: jax.Array, dt: jax.Array | float, discretization: Discretization = "chord"
) -> tuple[jax.Array, jax.Array]:
    """Angular velocities and linear velocity maps, components first: what moments are made of.

    Arguments as in :func:`linear_velocity_maps`.

    Returns:
        (3, 1, K, 2, ...) rad/s and (3, 4, K, 4, ...) m/s and 1/s; the axis after the samples is over
        frame types, the order within as in :func:`angular_velocities` and :func:`linear_velocity_maps`.

    Raises:
        ValueError: for an unknown discretization.
    """
    if discretization not in ("chord", "left"):
        raise ValueError(f"discretization must be 'chord' or 'left', not {discretization!r}.")
    rotation, position = split_poses(poses)
    steps = _step_times(dt, poses)
    step = _inside_out(steps, 0)[None, None]
    body, spatial = _mean_twists(rotation, position, steps)
    if discretization == "chord":
        body, spatial = _without_brackets(body, steps, False), _without_brackets(spatial, steps, True)
    bb, gg = (_twist_map(twist) for twist in (body, spatial))
    if discretization == "left":
        gb, bg = _product(rotation[:, :, :-1], bb), _product(_transpose(rotation)[:, :, :-1], gg)
    else:
        in_ground, in_body = _point_maps(rotation, position)
        rate = once(1 / step)
        gb, bg = jnp.diff(in_ground, axis=2) * rate, jnp.diff(in_body, axis=2) * rate
    rates = jnp.stack([spatial[:3], body[:3]], axis=2)
    return rates[:, None], jnp.stack([bb, gb, gg, bg], axis=3)


def velocity_paths(
    poses: jax.Array, dt: jax.Array | float, count: jax.Array | None = None
) -> tuple[jax.Array, jax.Array]:
    """Compute the velocity maps of single steps and the paths whose derivatives they are, components first.

    A path is the integral of the velocity of a frame's origin in the axes of its type, affine in the
    origin like the velocity: s(k; p) = a(k) + B(k) p. For GB and BG it is the origin's position in the
    body it moves in; for BB and GG it is summed along the measured motion, step by step.

    Args:
        poses: (..., K+1, 4, 4), of {b} in {g}; m.
        dt: sample time in s: a scalar, or (..., K) for irregular sampling.
        count: (...) number of poses, 8 or more, if the rest of the window is padding; all by default.

    Returns:
        (3, 4, K, 4, ...) m/s and 1/s, and (3, 4, K+1, 4, ...) m and 1.
    """
    return paths_of(*split_poses(poses), _step_times(dt, poses), count)


def paths_of(
    rotation: jax.Array, position: jax.Array, steps: jax.Array, count: jax.Array | None = None
) -> tuple[jax.Array, jax.Array]:
    """Compute what :func:`velocity_paths` does, from rotations (3, 3, K+1, ...) and positions (3, K+1, ...).

    Args:
        rotation: (3, 3, K+1, ...), as :func:`split_poses` returns it.
        position: (3, K+1, ...) m.
        steps: (..., K) sample times, s; of size 1 along axes in which the windows do not differ.
        count: as there.
    """
    step = _inside_out(steps, 0)[None, None]
    body, spatial = _mean_twists(rotation, position, steps)
    used = None if count is None else count - 1
    bb = _twist_map(_without_brackets(body, steps, False, used))
    gg = _twist_map(_without_brackets(spatial, steps, True, used))
    in_ground, in_body = _point_maps(rotation, position)
    rate = once(1 / step)
    maps = jnp.stack([bb, jnp.diff(in_ground, axis=2) * rate, gg, jnp.diff(in_body, axis=2) * rate], axis=3)
    paths = jnp.stack([_sum_up(bb * step), in_ground, _sum_up(gg * step), in_body], axis=3)
    return maps, paths


def turns_of(rotation: jax.Array) -> jax.Array:
    """Axis times sine of the angle of every step, (3, K, ...), from rotations (3, 3, K+1, ...)."""
    turn = _product(_transpose(rotation[:, :, :-1]), rotation[:, :, 1:])
    return jnp.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2


def rates_of(maps: jax.Array) -> jax.Array:
    """Angular velocities (3, 1, K, 2, ...) in {g} and {b}, from the maps (3, 4, K, 4, ...): B p = w x p."""
    return jnp.stack([maps[2, 2], maps[0, 3], maps[1, 1]])[:, None, :, 2::-2]


def _twist_map(twist: jax.Array) -> jax.Array:
    """(3, 4, ...): velocity v + w x p of a point p, for twists (6, ...)."""
    return jnp.concatenate([twist[3:, None], _hat(twist[:3])], axis=1)


def _point_maps(rotation: jax.Array, position: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Where points of the body are in the ground, and points of the ground in the body: (3, 4, K+1, ...)."""
    inverse = _transpose(rotation)
    in_ground = jnp.concatenate([position[:, None], rotation], axis=1)
    # a point p of the ground is R^T (p - x) in the body; the body moves against it
    return in_ground, jnp.concatenate([_product(inverse, position)[:, None], -inverse], axis=1)


def _sum_up(steps: jax.Array) -> jax.Array:
    """Path (3, 4, K+1, ...) from its steps (3, 4, K, ...)."""
    return jnp.concatenate([jnp.zeros_like(steps[:, :, :1]), jnp.cumsum(steps, axis=2)], axis=2)


def angular_velocities(
    poses: jax.Array, dt: jax.Array | float, discretization: Discretization = "chord"
) -> jax.Array:
    """Angular velocity in the two angular frame types.

    Args:
        poses: (..., K+1, 4, 4).
        dt: s; a scalar or (..., K).
        discretization: see :func:`linear_velocity_maps`.

    Returns:
        (..., 2, K, 3) in rad/s: expressed in {g} and in {b}, the order of ``AngularType``.

    Raises:
        ValueError: for an unknown discretization.
    """
    rates, _ = velocity_components(poses, dt, discretization)
    return jnp.moveaxis(rates[:, 0], (2, 1, 0), (-3, -2, -1))


def linear_velocity_maps(
    poses: jax.Array, dt: jax.Array | float, discretization: Discretization = "chord"
) -> jax.Array:
    """Affine maps (a | B) of the four linear frame types: u(k; p) = a(k) + B(k) p.

    ``u`` is the velocity of the frame's origin, in the axes of the body named by the type's first
    letter; ``p`` is where that origin lies, in the body named by the second.

    Args:
        poses: (..., K+1, 4, 4), of {b} in {g}; m.
        dt: sample time in s: a scalar, or (..., K) for irregular sampling.
        discretization: how velocity is taken from two poses.

            ``"chord"``: for measured motion. GB and BG use the chord of the origin's path, which is
            (x(k+1) - x(k)) / dt exactly; BB and GG the twist averaged over the step, which is the
            logarithm of the step less the brackets of the Magnus expansion (the error is of sixth
            order in dt, of third where sample times jitter).

            ``"left"``: the paper's Table 3, the mean twist seen from the pose at the start of the
            step. Exact for poses generated by the paper's Eq. 9.

    Returns:
        (..., 4, K, 3, 4) in m/s and 1/s, in the order BB, GB, GG, BG of ``LinearType``.

    Raises:
        ValueError: for an unknown discretization.
    """
    _, maps = velocity_components(poses, dt, discretization)
    return jnp.moveaxis(maps, (3, 2, 0, 1), (-4, -3, -2, -1))

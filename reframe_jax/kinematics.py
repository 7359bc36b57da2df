"""From poses to velocities: twists, and the affine velocity maps in which frames are searched.

The velocity of a constraint frame's origin is affine in the unknown position p of that origin,

    u(k; p) = a(k) + B(k) p,

for each of the four linear frame types (section 4 and Table 3 of the paper, with p the *location* of
the origin, so v + w x p). This module computes (a, B); nothing after it looks at poses again.
"""

from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax import rotations, transforms

__all__ = [
    "Discretization",
    "angular_velocities",
    "body_twists",
    "linear_velocity_maps",
    "sliding_windows",
    "spatial_twists",
]

Discretization = Literal["chord", "left"]



_STENCIL = 5  # samples in the derivative of the twist


def _step_times(dt: jax.Array | float, steps: int, dtype: np.dtype) -> jax.Array:
    """Sample time of every step, (..., K): (K,) unless the windows differ."""
    dt = jnp.asarray(dt, dtype=dtype)
    if dt.ndim == 0:
        dt = dt[None]
    return jnp.broadcast_to(dt, (*dt.shape[:-1], steps))


def _twist_of(angular: jax.Array, linear: jax.Array) -> jax.Array:
    return jnp.concatenate([angular, linear], axis=-1)


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
    steps = transforms.pose_inverse(poses[..., :-1, :, :]) @ poses[..., 1:, :, :]
    twists = transforms.pose_log(steps)
    return twists / _step_times(dt, steps.shape[-3], steps.dtype)[..., None]


def spatial_twists(poses: jax.Array, dt: jax.Array | float) -> jax.Array:
    """Mean spatial twist over every step: the body twist taken to {g} by the adjoint (Eq. 2).

    Arguments and shapes as in :func:`body_twists`; the result is in {g}.
    """
    return _to_ground(poses, body_twists(poses, dt))


def _to_ground(poses: jax.Array, twists: jax.Array) -> jax.Array:
    return (transforms.adjoint(poses[..., :-1, :, :]) @ twists[..., None])[..., 0]


def _derivative_weights(dt: jax.Array) -> tuple[np.ndarray, jax.Array]:
    """Finite-difference weights on irregular nodes: exact for polynomials of degree 4.

    The nodes are the middles of the steps; each derivative uses the five nearest.

    Args:
        dt: (..., K) s.

    Returns:
        The nodes used by every sample, (K, n), and their weights, (..., K, n), in 1/s.
    """
    steps = dt.shape[-1]
    n = min(_STENCIL, steps)
    first = np.clip(np.arange(steps) - n // 2, 0, steps - n)
    nodes = first[:, None] + np.arange(n)
    here = np.arange(steps) - first
    time = (jnp.cumsum(dt, axis=-1) - dt / 2)[..., nodes]
    at = jnp.take_along_axis(time, jnp.broadcast_to(here[:, None], (*time.shape[:-1], 1)), axis=-1)
    weights = []
    for i in range(n):
        others = [j for j in range(n) if j != i]
        # Lagrange's polynomial of node i: product over the other nodes, differentiated at `at`
        scale = jnp.prod(time[..., [i]] - time[..., others], axis=-1)
        slopes = [
            jnp.prod(at - time[..., [m for m in others if m != j]], axis=-1) for j in others
        ]
        weights.append(sum(slopes, jnp.zeros_like(scale)) / scale)
    return nodes, jnp.stack(weights, axis=-1)


def _commutator(twists: jax.Array, dt: jax.Array) -> jax.Array:
    """dt^2/12 [V, dV/dt] per dt: what separates the mean twist of a step from the twist at its middle.

    By the Magnus expansion log(T(k)^-1 T(k+1)) = dt V + dt^3/24 V'' + dt^3/12 [V, V'] + ... for the
    body twist V at the middle of the step (and minus the bracket for the spatial twist). The term in V'' keeps a zero component zero; the commutator
    mixes components, and would leave an error in constrained axes that no amount of data removes.
    """
    nodes, weights = _derivative_weights(dt)
    rate = jnp.sum(weights[..., None] * twists[..., nodes, :], axis=-2)
    w, v = twists[..., :3], twists[..., 3:]
    w_rate, v_rate = rate[..., :3], rate[..., 3:]
    bracket = _twist_of(jnp.cross(w, w_rate), jnp.cross(w, v_rate) - jnp.cross(w_rate, v))
    return (dt**2 / 12)[..., None] * bracket


def _twists(
    poses: jax.Array, dt: jax.Array | float, discretization: Discretization
) -> tuple[jax.Array, jax.Array]:
    """Body and spatial twists that stand for every step, (..., K, 6) each."""
    body = body_twists(poses, dt)
    if discretization == "left":
        return body, _to_ground(poses, body)
    correction = _commutator(body, _step_times(dt, body.shape[-2], body.dtype))
    return body - correction, _to_ground(poses, body + correction)


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
    """
    body, spatial = _twists(poses, dt, discretization)
    return jnp.stack([spatial[..., :3], body[..., :3]], axis=-3)


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
            (x(k+1) - x(k)) / dt exactly; BB and GG the twist at the middle of the step, from the
            mean twist with the leading term of the Magnus expansion removed (the error is of fourth
            order in dt).

            ``"left"``: the paper's Table 3, the mean twist seen from the pose at the start of the
            step. Exact for poses generated by the paper's Eq. 9.

    Returns:
        (..., 4, K, 3, 4) in m/s and 1/s, in the order BB, GB, GG, BG of ``LinearType``.

    Raises:
        ValueError: for an unknown discretization.
    """
    if discretization not in ("chord", "left"):
        raise ValueError(f"discretization must be 'chord' or 'left', not {discretization!r}.")
    body, spatial = _twists(poses, dt, discretization)

    def rigid(twist: jax.Array) -> jax.Array:
        return jnp.concatenate([twist[..., 3:, None], rotations.hat(twist[..., :3])], axis=-1)

    bb, gg = rigid(body), rigid(spatial)
    rotation, position = poses[..., :3, :3], poses[..., :3, 3:]
    inverse = jnp.swapaxes(rotation, -1, -2)
    if discretization == "left":
        gb, bg = rotation[..., :-1, :, :] @ bb, inverse[..., :-1, :, :] @ gg
    else:
        step = _step_times(dt, body.shape[-2], body.dtype)[..., None, None]
        in_ground = jnp.concatenate([position, rotation], axis=-1)
        # a point p of the ground is R^T (p - x) in the body; the body moves against it
        in_body = jnp.concatenate([inverse @ position, -inverse], axis=-1)
        gb = jnp.diff(in_ground, axis=-3) / step
        bg = jnp.diff(in_body, axis=-3) / step
    return jnp.stack([bb, gb, gg, bg], axis=-4)


def sliding_windows(samples: np.ndarray, length: int, stride: int = 1) -> np.ndarray:
    """Windows over the first axis of a recording, as a read-only view: nothing is copied.

    Args:
        samples: (N, ...), poses or times.
        length: samples in a window; a window of K velocities has K + 1 poses.
        stride: samples between the starts of two windows.

    Returns:
        (windows, length, ...); the samples after the last full window are left out.

    Raises:
        ValueError: if the recording is shorter than one window, or a size is not positive.
    """
    samples = np.asarray(samples)
    if length < 1 or stride < 1:
        raise ValueError(f"length and stride must be at least 1, not {length} and {stride}.")
    if len(samples) < length:
        raise ValueError(f"A window of {length} samples does not fit a recording of {len(samples)}.")
    view = np.lib.stride_tricks.sliding_window_view(samples, length, axis=0)
    return np.moveaxis(view, -1, 1)[::stride]

"""A constraint frame between two bodies: its location at a pose, and the velocities along its axes.

A linear frame has its orientation fixed in one body and its origin fixed in the same or the other body, {b}
or {g}. A :class:`ConstraintFrame` stores these bodies and the degrees of freedom as static values. This
module stores them as arrays, so that one compiled program serves every constraint. The velocities along the
axes are the Pfaffian form of the paper's Eq. 3, A(T) V = 0, with one row for every constrained axis.
"""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.types import ORIENTATION_BODIES, POSITION_BODIES, AngularType
from reframe_jax.geometry import rotations
from reframe_jax.geometry.products import apply, matmul

__all__ = [
    "Frame",
    "Located",
    "assemble_frame",
    "body_twist",
    "frame_arrays",
    "ground_offset",
    "ground_twist",
    "locate",
    "locate_on_host",
    "move_frame",
    "multiply",
    "parts_on_body",
    "place_frame",
    "slip",
    "to_fixed_body",
    "twist_map",
]

_LINEAR_ON_BODY = np.stack([ORIENTATION_BODIES, POSITION_BODIES], axis=1) == AngularType.B
"""(4, 2) bool: whether the axes, and the origin, of each linear type are fixed in {b}."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Frame:
    """A constraint frame as arrays, with frame types and degrees of freedom that may vary in a batch.

    Attributes:
        angular_axes: (..., 3, 3), columns are the angular frame's axes, in the body that they are fixed in.
        linear_axes: (..., 3, 3), columns are the linear frame's axes, in the body that they are fixed in.
        position: (..., 3) m, origin of the linear frame, in the body that it is fixed in.
        free: (..., 6), 1 for free axes and 0 for constrained axes; three angular axes, then three linear
            ones.
        on_body: (..., 3) bool, whether the angular axes, the linear axes and the origin are fixed in {b}.
    """

    angular_axes: jax.Array
    linear_axes: jax.Array
    position: jax.Array
    free: jax.Array
    on_body: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Located:
    """A constraint frame at an instant, in the axes of {g}.

    Attributes:
        rotation: (3, 3), orientation of {b} in {g}.
        angular_axes: (3, 3), columns are the angular frame's axes.
        linear_axes: (3, 3), columns are the linear frame's axes.
        lever: (3,) m, from the origin of {b} to the linear frame's origin.
        path: (3,) m, the linear frame's origin expressed in the body that it is *not* fixed in; it moves
            there.
        path_axes: (3, 3), columns are the linear axes in that body. The velocity along each axis is its dot
            product with the derivative of ``path``.
    """

    rotation: jax.Array
    angular_axes: jax.Array
    linear_axes: jax.Array
    lever: jax.Array
    path: jax.Array
    path_axes: jax.Array


def parts_on_body(angular_type: ArrayLike, linear_type: ArrayLike) -> jax.Array:
    """Whether the angular axes, the linear axes and the origin of frames are fixed in {b}.

    Args:
        angular_type: (...) :class:`AngularType` or its values.
        linear_type: (...) :class:`LinearType` or its values.

    Returns:
        (..., 3) bool; False means fixed in {g}.
    """
    turns = jnp.asarray(angular_type) == int(AngularType.B)
    linear = jnp.asarray(_LINEAR_ON_BODY)[jnp.asarray(linear_type)]
    return jnp.concatenate([turns[..., None], linear], axis=-1)


def assemble_frame(
    angular_type: ArrayLike,
    linear_type: ArrayLike,
    *,
    angular_axes: jax.Array,
    linear_axes: jax.Array,
    position: jax.Array,
    angular_dof: ArrayLike | tuple[int, ...],
    linear_dof: ArrayLike | tuple[int, ...],
) -> Frame:
    """Assemble frames from their types, axes, origins and degrees of freedom; types may vary in a batch.

    Args:
        angular_type: (...) :class:`AngularType` or its values.
        linear_type: (...) :class:`LinearType` or its values.
        angular_axes: (..., 3, 3), columns are axes in the body that the angular type names.
        linear_axes: (..., 3, 3), columns are axes in the body that the first letter of the linear type names.
        position: (..., 3) m, origin in the body that the second letter of the linear type names.
        angular_dof: (..., 3), 1 for each free rotation axis.
        linear_dof: (..., 3), 1 for each free translation axis.
    """
    batch = position.shape[:-1]
    free = jnp.concatenate([jnp.asarray(angular_dof), jnp.asarray(linear_dof)], axis=-1)
    return Frame(
        angular_axes=angular_axes,
        linear_axes=linear_axes,
        position=position,
        free=jnp.broadcast_to(free.astype(position.dtype), (*batch, 6)),
        on_body=jnp.broadcast_to(parts_on_body(angular_type, linear_type), (*batch, 3)),
    )


def frame_arrays(frame: ConstraintFrame) -> Frame:
    """Convert a constraint frame to arrays, with the batch axes of its geometry."""
    return assemble_frame(
        frame.angular_type,
        frame.linear_type,
        angular_axes=frame.angular_axes,
        linear_axes=frame.linear_axes,
        position=frame.position,
        angular_dof=frame.angular_dof,
        linear_dof=frame.linear_dof,
    )


def ground_offset(centre: jax.Array) -> jax.Array:
    """Return the offsets to add to origins that were estimated with the origin of {g} moved to a point.

    Args:
        centre: (..., 3) m, the point in {g} that served as the origin.

    Returns:
        (..., 4, 3) m, in the order of :class:`LinearType`: ``centre`` for the types whose origin is fixed in
        {g}, zero for the types whose origin is fixed in {b}.
    """
    in_ground = jnp.asarray(~_LINEAR_ON_BODY[:, 1]).reshape(*([1] * (centre.ndim - 1)), -1, 1)
    return jnp.where(in_ground, centre[..., None, :], 0)


def multiply(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Multiply (m, n) by (n,) or (n, k) with elementwise operations, which XLA fuses over a batch."""
    if right.ndim == 1:
        return jnp.sum(matrix * right[None, :], axis=-1)
    return jnp.sum(matrix[:, :, None] * right[None, :, :], axis=1)


def to_fixed_body(part: jax.Array, on_body: jax.Array, rotation: jax.Array) -> jax.Array:
    """Express a direction, or a set of axes, in the body in which it is fixed.

    Args:
        part: (3,) direction or (3, 3) axes as columns, in the axes of {g}.
        on_body: () bool, True if the direction is fixed in {b}, False if it is fixed in {g}.
        rotation: (3, 3), orientation of {b} in {g}.
    """
    return jnp.where(on_body, multiply(rotation.T, part), part)


def locate(frame: Frame, rotation: jax.Array, position: jax.Array) -> Located:
    """Locate a frame while the body {b} is at a given pose.

    Args:
        frame: a single frame.
        rotation: (3, 3), orientation of {b} in {g}.
        position: (3,) m, origin of {b} in {g}.
    """
    angular = jnp.where(frame.on_body[0], multiply(rotation, frame.angular_axes), frame.angular_axes)
    linear = jnp.where(frame.on_body[1], multiply(rotation, frame.linear_axes), frame.linear_axes)
    with_body = multiply(rotation, frame.position)
    lever = jnp.where(frame.on_body[2], with_body, frame.position - position)
    # relative to the body, a point that is fixed in the ground moves in the opposite direction
    path = jnp.where(frame.on_body[2], position + with_body, -multiply(rotation.T, lever))
    path_axes = jnp.where(frame.on_body[2], linear, multiply(rotation.T, linear))
    return Located(rotation, angular, linear, lever, path, path_axes)


_locate_all = jax.jit(jax.vmap(locate, in_axes=(None, 0, 0)))


def locate_on_host(frame: Frame, poses: np.ndarray) -> Located:
    """Locate a frame at every pose with NumPy, in float64 independent of the settings of JAX.

    Args:
        frame: a single frame.
        poses: (K, 4, 4) of {b} in {g}, m.

    Returns:
        The located frame; each array has a leading axis of length K.
    """

    def widen(leaf: Any) -> np.ndarray:
        leaf = np.asarray(leaf)
        return leaf if leaf.dtype == bool else leaf.astype(float)

    poses = np.asarray(poses, dtype=float)
    with jax.enable_x64(True):
        there = _locate_all(jax.tree.map(widen, frame), poses[:, :3, :3], poses[:, :3, 3])
        return jax.device_get(there)


def twist_map(located: Located) -> jax.Array:
    """Return the matrix from the twist of {b} to the velocities along the frame's axes.

    Args:
        located: the frame at the pose of {b}.

    Returns:
        (6, 6). Its input is the angular velocity, and the velocity of the origin of {b}, in the axes of {g}.
        Its output is the angular velocity along the angular axes, and the velocity of the frame's origin
        along the linear axes. The rows of the constrained axes are A(T). The transpose maps moments (N m) and
        forces (N) along the axes, which act at the frame's origin, to a wrench at the origin of {b}.
    """
    angular, linear = located.angular_axes.T, located.linear_axes.T
    # a . (w x r) = (r x a) . w
    levers = jnp.cross(jnp.broadcast_to(located.lever, (3, 3)), linear)
    top = jnp.concatenate([angular, jnp.zeros_like(angular)], axis=1)
    return jnp.concatenate([top, jnp.concatenate([levers, linear], axis=1)])


def ground_twist(located: Located, velocities: jax.Array) -> jax.Array:
    """Return the twist of {b} for given velocities along the frame's axes; inverts :func:`twist_map`.

    Args:
        located: the frame at the pose of {b}.
        velocities: (6,) rad/s along the angular axes, then m/s along the linear axes.

    Returns:
        (6,) angular velocity and velocity of the origin of {b}, in the axes of {g}.
    """
    w = multiply(located.angular_axes, velocities[:3])
    u = multiply(located.linear_axes, velocities[3:])
    return jnp.concatenate([w, u - jnp.cross(w, located.lever)])


def body_twist(frame: Frame, rotation: jax.Array, position: jax.Array, velocities: jax.Array) -> jax.Array:
    """Return the twist of {b} in its own axes for given velocities along the axes of a frame.

    Args:
        frame: a single frame.
        rotation: (3, 3), orientation of {b} in {g}.
        position: (3,) m, origin of {b} in {g}.
        velocities: (6,) rad/s along the angular axes, then m/s along the linear axes.

    Returns:
        (6,) angular velocity and velocity of the origin of {b}, in the axes of {b}.
    """

    def to_body(vector: jax.Array, on_body: jax.Array) -> jax.Array:
        return jnp.where(on_body, vector, multiply(rotation.T, vector))

    w = to_body(multiply(frame.angular_axes, velocities[:3]), frame.on_body[0])
    u = to_body(multiply(frame.linear_axes, velocities[3:]), frame.on_body[1])
    from_body = jnp.where(frame.on_body[2], frame.position, frame.position - position)
    return jnp.concatenate([w, u - jnp.cross(w, to_body(from_body, frame.on_body[2]))])


def slip(before: Located, now: Located) -> jax.Array:
    """Return the displacement along the frame's axes between two nearby instants.

    The displacement is the integral of the velocity along each axis, by the trapezoidal rule. It is exact for
    the types GB and BG, where the axes do not turn relative to the body in which the origin moves.

    Returns:
        (6,) rad along the angular axes, then m along the linear axes.
    """
    turn = rotations.vee(multiply(now.rotation, before.rotation.T))
    step = now.path - before.path
    axes = (before.path_axes + now.path_axes) / 2
    return jnp.concatenate([multiply(now.angular_axes.T, turn), multiply(axes.T, step)])


def move_frame(
    frame: Frame, turn: jax.Array, shift: jax.Array, rotation: jax.Array, position: jax.Array
) -> Frame:
    """Rotate and shift a constraint frame in the ground while the body is at a given pose.

    The angular and the linear axes turn by the same rotation.

    Args:
        frame: a single frame.
        turn: (3, 3), rotation matrix in {g}.
        shift: (3,) m, displacement of the linear frame's origin in {g}.
        rotation: (3, 3), orientation of {b} in {g}.
        position: (3,) m, origin of {b} in {g}.
    """
    located = locate(frame, rotation, position)
    lever = located.lever + shift
    to_body = multiply(rotation.T, turn)

    def axes(world: jax.Array, on_body: jax.Array) -> jax.Array:
        return jnp.where(on_body, multiply(to_body, world), multiply(turn, world))

    return replace(
        frame,
        angular_axes=axes(located.angular_axes, frame.on_body[0]),
        linear_axes=axes(located.linear_axes, frame.on_body[1]),
        position=jnp.where(frame.on_body[2], multiply(rotation.T, lever), position + lever),
    )


def place_frame(
    frame: ConstraintFrame, axes: jax.Array, origin: jax.Array, rotation: jax.Array, position: jax.Array
) -> ConstraintFrame:
    """Give a constraint frame new axes and a new origin in the ground while the body is at a given pose.

    Args:
        frame: a single frame, whose types and degrees of freedom are kept.
        axes: (3, 3), columns are the new axes in {g}, of both the angular and the linear frame.
        origin: (3,) m, the new origin of the linear frame in {g}.
        rotation: (3, 3), orientation of {b} in {g}.
        position: (3,) m, origin of {b} in {g}.
    """
    with jax.ensure_compile_time_eval():  # the types are static even where the geometry is traced
        angular, linear, point = np.asarray(parts_on_body(frame.angular_type, frame.linear_type))
    in_body = matmul(rotation.T, axes)
    return replace(
        frame,
        angular_rotvec=rotations.rotation_log(in_body if angular else axes),
        linear_rotvec=rotations.rotation_log(in_body if linear else axes),
        position=apply(rotation.T, origin - position) if point else origin,
    )

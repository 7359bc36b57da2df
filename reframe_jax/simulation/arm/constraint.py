"""A constraint frame on a moving body: where it is, what it measures, and where to put one.

The Pfaffian form of the paper's Eq. 3, A(T) V = 0, with one row for every constrained axis. What is
static in a :class:`ConstraintFrame`, its types and degrees of freedom, is an array here, so that one
compiled program serves every class of constraint.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.types import AngularType
from reframe_jax.geometry import rotations
from reframe_jax.geometry.products import apply, matmul

__all__ = ["Frame", "Located", "body_twist", "frame_arrays", "locate", "moved", "placed", "slip", "twist_map"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Frame:
    """A constraint frame as arrays.

    Attributes:
        angular_axes: (..., 3, 3), columns are the angular frame's axes in the body of its type.
        linear_axes: (..., 3, 3), columns are the linear frame's axes in the body of the first letter.
        position: (..., 3) m, in the body of the second letter.
        free: (..., 6), 1 where an axis is free, 0 where it is constrained: angular, then linear.
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
        rotation: (3, 3), of {b} in {g}.
        angular_axes: (3, 3), columns are the angular frame's axes.
        linear_axes: (3, 3), columns are the linear frame's axes.
        lever: (3,) m, from the origin of {b} to the linear frame's origin.
        path: (3,) m, the linear frame's origin in the body it is *not* fixed in, where it moves.
        path_axes: (3, 3), the linear axes in that body: the velocities along them are their product
            with the derivative of ``path``.
    """

    rotation: jax.Array
    angular_axes: jax.Array
    linear_axes: jax.Array
    lever: jax.Array
    path: jax.Array
    path_axes: jax.Array


def _times(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """Matrix times vector, elementwise, so that a batch of them fuses."""
    return jnp.sum(matrix * vector[None, :], axis=-1)


def _product(left: jax.Array, right: jax.Array) -> jax.Array:
    return jnp.sum(left[:, :, None] * right[None, :, :], axis=1)


def frame_arrays(frame: ConstraintFrame) -> Frame:
    """The arrays of a constraint frame, with the batch axes of its geometry."""
    batch = frame.position.shape[:-1]
    dtype = frame.position.dtype
    types = frame.angular_type, frame.linear_type.orientation_body, frame.linear_type.position_body
    on_body = np.array([kind == AngularType.B for kind in types])
    free = jnp.asarray((*frame.angular_dof, *frame.linear_dof), dtype=dtype)
    return Frame(
        angular_axes=frame.angular_axes,
        linear_axes=frame.linear_axes,
        position=frame.position,
        free=jnp.broadcast_to(free, (*batch, 6)),
        on_body=jnp.broadcast_to(jnp.asarray(on_body), (*batch, 3)),
    )


def locate(frame: Frame, rotation: jax.Array, position: jax.Array) -> Located:
    """Where a frame is when the body is at a pose.

    Args:
        frame: of one rollout.
        rotation: (3, 3), of {b} in {g}.
        position: (3,) m.
    """
    angular = jnp.where(frame.on_body[0], _product(rotation, frame.angular_axes), frame.angular_axes)
    linear = jnp.where(frame.on_body[1], _product(rotation, frame.linear_axes), frame.linear_axes)
    with_body = _times(rotation, frame.position)
    lever = jnp.where(frame.on_body[2], with_body, frame.position - position)
    # the body moves past a point of the ground: seen from the body, that point moves the other way
    path = jnp.where(frame.on_body[2], position + with_body, -_times(rotation.T, lever))
    path_axes = jnp.where(frame.on_body[2], linear, _product(rotation.T, linear))
    return Located(rotation, angular, linear, lever, path, path_axes)


def twist_map(located: Located) -> jax.Array:
    """Matrix from the twist of {b} to the velocities along the frame's axes.

    Args:
        located: the frame.

    Returns:
        (6, 6): from (angular velocity, velocity of the origin of {b}) in the axes of {g} to angular
        velocity along the angular and velocity of the frame's origin along the linear axes. Its rows
        at the constrained axes are A(T); its transpose takes moments (N m) and forces (N) along the
        axes, acting at the frame's origin, to a wrench at the origin of {b}.
    """
    angular, linear = located.angular_axes.T, located.linear_axes.T
    # a . (w x r) = (r x a) . w
    levers = jnp.cross(jnp.broadcast_to(located.lever, (3, 3)), linear)
    top = jnp.concatenate([angular, jnp.zeros_like(angular)], axis=1)
    return jnp.concatenate([top, jnp.concatenate([levers, linear], axis=1)])


def body_twist(located: Located, velocities: jax.Array) -> jax.Array:
    """The inverse of :func:`twist_map`: the twist of {b} with given velocities along the frame's axes.

    Args:
        located: the frame.
        velocities: (6,) rad/s along the angular, m/s along the linear axes.

    Returns:
        (6,) angular velocity and velocity of the origin of {b}, in the axes of {g}.
    """
    w = _times(located.angular_axes, velocities[:3])
    u = _times(located.linear_axes, velocities[3:])
    return jnp.concatenate([w, u - jnp.cross(w, located.lever)])


def slip(before: Located, now: Located) -> jax.Array:
    """Displacement along the frame's axes between two near instants.

    The integral of the velocity along every axis over the motion, by the trapezoidal rule: exact where
    the axes do not turn with respect to the body that the origin moves in (GB and BG).

    Returns:
        (6,) rad along the angular, m along the linear axes.
    """
    turn = rotations.vee(_product(now.rotation, before.rotation.T))
    step = now.path - before.path
    axes = (before.path_axes + now.path_axes) / 2
    return jnp.concatenate([_times(now.angular_axes.T, turn), _times(axes.T, step)])


def moved(frame: Frame, turn: jax.Array, shift: jax.Array, rotation: jax.Array, position: jax.Array) -> Frame:
    """A frame turned and shifted in the world while the body is at a pose; both its parts turn alike.

    Args:
        frame: of one rollout.
        turn: (3, 3), rotation matrix in {g}.
        shift: (3,) m, of the linear frame's origin in {g}.
        rotation: (3, 3), of {b} in {g}.
        position: (3,) m, of {b} in {g}.
    """
    located = locate(frame, rotation, position)
    lever = located.lever + shift
    to_body = _product(rotation.T, turn)

    def axes(world: jax.Array, on_body: jax.Array) -> jax.Array:
        return jnp.where(on_body, _product(to_body, world), _product(turn, world))

    return replace(
        frame,
        angular_axes=axes(located.angular_axes, frame.on_body[0]),
        linear_axes=axes(located.linear_axes, frame.on_body[1]),
        position=jnp.where(frame.on_body[2], _times(rotation.T, lever), position + lever),
    )


def placed(
    frame: ConstraintFrame, axes: jax.Array, origin: jax.Array, rotation: jax.Array, position: jax.Array
) -> ConstraintFrame:
    """A frame of the same class, placed in the world while the body is at a pose.

    Args:
        frame: its types and degrees of freedom are kept.
        axes: (3, 3), columns are the axes of both its parts in {g}.
        origin: (3,) m, the linear frame's origin in {g}.
        rotation: (3, 3), of {b} in {g}.
        position: (3,) m, of {b} in {g}.
    """

    def rotvec(body: AngularType) -> jax.Array:
        return rotations.rotation_log(axes if body == AngularType.G else matmul(rotation.T, axes))

    on_body = frame.linear_type.position_body == AngularType.B
    return replace(
        frame,
        angular_rotvec=rotvec(frame.angular_type),
        linear_rotvec=rotvec(frame.linear_type.orientation_body),
        position=apply(rotation.T, origin - position) if on_body else origin,
    )

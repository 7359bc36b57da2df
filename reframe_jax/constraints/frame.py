"""A constraint with its geometry (paper, Table 1), located at a pose of the body.

A linear frame has its axes fixed in one body, {b} or {g}, and its origin fixed in the same or the other body.
A :class:`ConstraintFrame` stores these bodies and the degrees of freedom as static values. :class:`Frame`
stores them as arrays, so that one compiled program serves every constraint. A constraint is the condition
A(T) V = 0 on the twist V at the pose T (the paper's Eq. 3), with one row of A for every constrained axis. The
functions map between twists and velocities along the axes.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from reframe_jax.constraints.catalogue import constraint
from reframe_jax.constraints.types import ORIENTATION_BODIES, POSITION_BODIES, AngularType, Dof, LinearType
from reframe_jax.geometry import rotations
from reframe_jax.geometry.products import apply, matmul
from reframe_jax.geometry.small import times

_LINEAR_ON_BODY = np.stack([ORIENTATION_BODIES, POSITION_BODIES], axis=1) == AngularType.B
"""(4, 2) bool: whether the axes, and the origin, of each linear type are fixed in {b}."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ConstraintFrame:
    """The angular and linear frames of a constraint: types, degrees of freedom and geometry (paper, Table 1).

    A JAX pytree: the geometry arrays are its leaves; the types and degrees of freedom are static.

    Attributes:
        angular_type, linear_type: the bodies in which the frames are fixed, B for {b} and G for {g}.
        angular_dof, linear_dof: one integer per axis of the frame; 1 is free, 0 is constrained.
        angular_rotvec: (..., 3) rad, orientation of the angular frame in the body that ``angular_type``
            names.
        linear_rotvec: (..., 3) rad, orientation of the linear frame in the body that the first letter of
            ``linear_type`` names.
        position: (..., 3) m, origin of the linear frame in the body that the second letter names.
    """

    angular_type: AngularType = field(metadata={"static": True})
    angular_dof: Dof = field(metadata={"static": True})
    linear_type: LinearType = field(metadata={"static": True})
    linear_dof: Dof = field(metadata={"static": True})
    angular_rotvec: jax.Array
    linear_rotvec: jax.Array
    position: jax.Array

    @staticmethod
    def named(
        label: str,
        *,
        linear_type: LinearType | None = None,
        rotvec: jax.Array | np.ndarray | tuple[float, ...] = (0.0, 0.0, 0.0),
        position: jax.Array | np.ndarray | tuple[float, ...] = (0.1, 0.3, 0.1),
    ) -> "ConstraintFrame":
        """Make a named constraint, by default with the geometry of the paper's simulations (section 5.3).

        Args:
            label: letter, name or common word of the catalogue, such as "A" or "hinge".
            linear_type: linear frame type, BB by default. Only constraints that all four types express (A to
                D and :data:`OTHER_CONSTRAINTS`) allow a choice.
            rotvec: (..., 3) rad, orientation of both frames.
            position: (..., 3) m.

        Raises:
            KeyError: for an unknown label.
            ValueError: if the linear type cannot express the constraint.
        """
        entry = constraint(label)
        if entry.linear_type is not None and linear_type not in (None, entry.linear_type):
            raise ValueError(f"{entry.name} needs a {entry.linear_type} frame, not {linear_type}.")
        kind = entry.linear_type if linear_type is None else linear_type
        kind = LinearType.BB if kind is None else kind
        return ConstraintFrame(
            angular_type=kind.orientation_body,
            angular_dof=entry.angular_dof,
            linear_type=kind,
            linear_dof=entry.linear_dof,
            angular_rotvec=jnp.asarray(rotvec, dtype=float),
            linear_rotvec=jnp.asarray(rotvec, dtype=float),
            position=jnp.asarray(position, dtype=float),
        )

    @property
    def angular_axes(self) -> jax.Array:
        """(..., 3, 3): columns are the angular frame's axes."""
        return rotations.rotation_exp(self.angular_rotvec)

    @property
    def linear_axes(self) -> jax.Array:
        """(..., 3, 3): columns are the linear frame's axes."""
        return rotations.rotation_exp(self.linear_rotvec)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Frame:
    """A constraint frame as arrays, with frame types and degrees of freedom that may vary in a batch."""

    angular_axes: jax.Array  # (..., 3, 3), columns are the axes, in the body that they are fixed in
    linear_axes: jax.Array  # (..., 3, 3), columns are the axes, in the body that they are fixed in
    position: jax.Array  # (..., 3) m, origin of the linear frame, in the body that it is fixed in
    free: jax.Array  # (..., 6), 1 for free axes and 0 for constrained axes; angular axes, then linear axes
    on_body: jax.Array  # (..., 3) bool, whether angular axes, linear axes and origin are fixed in {b}


class Located(NamedTuple):
    """A constraint frame at an instant, in the axes of {g}."""

    rotation: jax.Array  # (3, 3), orientation of {b} in {g}
    angular_axes: jax.Array  # (3, 3), columns are the angular frame's axes
    linear_axes: jax.Array  # (3, 3), columns are the linear frame's axes
    lever: jax.Array  # (3,) m, vector from the origin of {b} to the linear frame's origin
    # (3,) m, position of the linear frame's origin relative to the other body: the body in which the origin
    # is *not* fixed, and in which it moves. If the origin is fixed in {g}, the position is negated, so that
    # its derivative is the velocity of the body relative to the ground
    path: jax.Array
    # (3, 3), columns are the linear axes in the other body. The velocity along each axis is the dot product
    # of the axis and the derivative of ``path``
    path_axes: jax.Array


def fixed_on_body(frame: ConstraintFrame) -> tuple[bool, bool, bool]:
    """Return whether the angular axes, the linear axes and the origin are fixed in {b}, not in {g}."""
    axes, origin = _LINEAR_ON_BODY[frame.linear_type].tolist()
    return frame.angular_type == AngularType.B, axes, origin


@partial(jax.jit, inline=True)
def assemble_frame(
    types: tuple[ArrayLike, ArrayLike],
    axes: tuple[jax.Array, jax.Array],
    position: jax.Array,
    dof: tuple[ArrayLike | tuple[int, ...], ArrayLike | tuple[int, ...]],
) -> Frame:
    """Build frames from codes (...) of ``AngularType`` and ``LinearType``, which may vary in a batch.

    Axes, position and degrees of freedom are those of a :class:`ConstraintFrame`, with axes (..., 3, 3);
    pairs are angular, then linear.
    """
    batch = position.shape[:-1]
    free = jnp.concatenate([jnp.asarray(part) for part in dof], axis=-1)
    turning = jnp.asarray(types[0]) == int(AngularType.B)
    linear = jnp.asarray(_LINEAR_ON_BODY)[jnp.asarray(types[1])]
    fixed = jnp.concatenate([turning[..., None], linear], axis=-1)
    free = jnp.broadcast_to(free.astype(position.dtype), (*batch, 6))
    return Frame(*axes, position, free, jnp.broadcast_to(fixed, (*batch, 3)))


def frame_arrays(frame: ConstraintFrame) -> Frame:
    """Convert a constraint frame to arrays, with the batch axes of its geometry."""
    types = np.int32(frame.angular_type), np.int32(frame.linear_type)
    dof = np.asarray(frame.angular_dof, np.int32), np.asarray(frame.linear_dof, np.int32)
    return assemble_frame(types, (frame.angular_axes, frame.linear_axes), frame.position, dof)


@partial(jax.jit, inline=True)
def locate(frame: Frame, rotation: jax.Array, position: jax.Array) -> Located:
    """Locate a single frame when {b} has the orientation (3, 3) and the origin (3,), m, in {g}."""
    angular = jnp.where(frame.on_body[0], times(rotation, frame.angular_axes), frame.angular_axes)
    linear = jnp.where(frame.on_body[1], times(rotation, frame.linear_axes), frame.linear_axes)
    with_body = times(rotation, frame.position)
    lever = jnp.where(frame.on_body[2], with_body, frame.position - position)
    # relative to the body, a point that is fixed in the ground moves in the opposite direction
    path = jnp.where(frame.on_body[2], position + with_body, -times(rotation.T, lever))
    path_axes = jnp.where(frame.on_body[2], linear, times(rotation.T, linear))
    return Located(rotation, angular, linear, lever, path, path_axes)


_locate_all = jax.jit(jax.vmap(locate, in_axes=(None, 0, 0)))


def locate_on_host(frame: ConstraintFrame, poses: np.ndarray) -> Located:
    """Locate a single frame at every pose (K, 4, 4), m, in float64 independent of the settings of JAX.

    Each array of the located frame is a NumPy array with a leading axis of length K.
    """
    poses = np.asarray(poses, dtype=float)
    with jax.enable_x64(True):
        arrays = frame_arrays(jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), dtype=float), frame))
        return jax.device_get(_locate_all(arrays, poses[:, :3, :3], poses[:, :3, 3]))


def twist_map(located: Located) -> jax.Array:
    """Return the matrix (6, 6) that maps the twist of {b} to the velocities along the frame's axes.

    The twist is the angular velocity, rad/s, and the velocity of the origin of {b}, m/s, in the axes of {g}.
    The result is the angular velocity along the angular axes, and the velocity of the frame's origin along
    the linear axes. The rows of the constrained axes are A(T). The transpose maps moments (N m) and forces
    (N) along the axes, which act at the frame's origin, to a wrench at the origin of {b}.
    """
    angular, linear = located.angular_axes.T, located.linear_axes.T
    # a . (w x r) = (r x a) . w
    levers = jnp.cross(jnp.broadcast_to(located.lever, (3, 3)), linear)
    top = jnp.concatenate([angular, jnp.zeros_like(angular)], axis=1)
    return jnp.concatenate([top, jnp.concatenate([levers, linear], axis=1)])


def ground_twist(located: Located, velocities: jax.Array) -> jax.Array:
    """Return the twist (6,) of {b} in {g} for velocities (6,) along the axes; inverts :func:`twist_map`."""
    w = times(located.angular_axes, velocities[:3])
    return jnp.concatenate([w, times(located.linear_axes, velocities[3:]) - jnp.cross(w, located.lever)])


def body_twist(frame: Frame, rotation: jax.Array, position: jax.Array, velocities: jax.Array) -> jax.Array:
    """Return the body twist (w, v), (6,) rad/s and m/s, for velocities (6,) along the axes of a frame.

    The velocities are those along the angular axes, then along the linear axes. ``rotation`` (3, 3) and
    ``position`` (3,), m, are the pose of {b} in {g}; see :func:`locate` and :func:`ground_twist`.
    """
    w, v = jnp.split(ground_twist(locate(frame, rotation, position), velocities), 2)
    return jnp.concatenate([times(rotation.T, w), times(rotation.T, v)])


def slip(before: Located, now: Located) -> jax.Array:
    """Return how far the body rotated and moved along the frame's axes between two nearby instants.

    The translation along an axis is the integral of the velocity of the origin along this axis, by the
    trapezoidal rule. It is exact for the types GB and BG, whose axes are fixed in the body relative to which
    the origin moves. The rotation about an axis is a component of the rotation between the instants, for
    small angles.

    Returns:
        (6,): rotations about the angular axes, rad; then displacements of the frame's origin along the linear
        axes, m.
    """
    turn = rotations.vee(times(now.rotation, before.rotation.T))
    axes = (before.path_axes + now.path_axes) / 2
    return jnp.concatenate([times(now.angular_axes.T, turn), times(axes.T, now.path - before.path)])


def move_frame(
    frame: ConstraintFrame, turn: jax.Array, shift: jax.Array, rotation: jax.Array
) -> ConstraintFrame:
    """Turn the axes of constraint frames, and shift their origins, at one orientation of {b} in {g}.

    The turn (..., 3, 3) and the shift (..., 3), m, are in {g}; ``rotation`` (..., 3, 3) is the orientation.
    """
    angular, linear, point = fixed_on_body(frame)
    inverse = jnp.swapaxes(rotation, -1, -2)
    in_body = matmul(inverse, matmul(turn, rotation))
    return replace(
        frame,
        angular_rotvec=rotations.rotation_log(matmul(in_body if angular else turn, frame.angular_axes)),
        linear_rotvec=rotations.rotation_log(matmul(in_body if linear else turn, frame.linear_axes)),
        position=frame.position + (apply(inverse, shift) if point else shift),
    )


def place_frame(
    frame: ConstraintFrame, axes: jax.Array, origin: jax.Array, rotation: jax.Array, position: jax.Array
) -> ConstraintFrame:
    """Replace the axes and the origins of constraint frames, by values in {g} at one pose of the body.

    The columns of ``axes`` (..., 3, 3) become the axes of the angular and the linear frame, and ``origin``
    (..., 3), m, their origin. ``rotation`` (..., 3, 3) and ``position`` (..., 3), m, are the pose.
    """
    angular, linear, point = fixed_on_body(frame)
    inverse = jnp.swapaxes(rotation, -1, -2)
    in_body = matmul(inverse, axes)
    return replace(
        frame,
        angular_rotvec=rotations.rotation_log(in_body if angular else axes),
        linear_rotvec=rotations.rotation_log(in_body if linear else axes),
        position=apply(inverse, origin - position) if point else origin,
    )

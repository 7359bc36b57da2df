"""Frames to control in: true, wrong on purpose, or identified."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.geometry import rotations
from reframe_jax.identification.results import Identification
from reframe_jax.simulation.arm.constraint import Frame, frame_arrays, moved
from reframe_jax.simulation.arm.model import PANDA, Arm, arm_named, forward_kinematics

__all__ = ["LITERATURE_ERRORS", "ROOMY", "control_frames", "erroneous_frames"]

ROOMY = (0.0, -0.7, 0.0, -2.35, 0.0, 1.65, 0.785)
"""rad, where tasks start: nearer to the base than the arm's home, so that none stretches the arm out."""

LITERATURE_ERRORS = ((0.5, 5.0), (1.0, 7.5))
"""Ranges of the errors that methods with prior knowledge report, in degrees and mm (paper, section 7.2)."""


def control_frames(found: Identification | ConstraintFrame | Frame) -> Frame:
    """Frames to control in, with the batch axes of what they come from.

    Args:
        found: identifications, whose types may differ from one to the next, or constraint frames.
    """
    if isinstance(found, Frame):
        return found
    if isinstance(found, ConstraintFrame):
        return frame_arrays(found)
    dtype = found.linear.position.dtype
    in_body = np.array(
        [(t.orientation_body == AngularType.B, t.position_body == AngularType.B) for t in LinearType]
    )
    angular = found.angular.type_code == int(AngularType.B)
    linear = jnp.asarray(in_body)[found.linear.type_code]
    return Frame(
        angular_axes=found.angular.axes,
        linear_axes=found.linear.axes,
        position=found.linear.position,
        free=jnp.concatenate([found.angular.dof, found.linear.dof], axis=-1).astype(dtype),
        on_body=jnp.concatenate([jnp.asarray(angular)[..., None], linear], axis=-1),
    )


def erroneous_frames(
    truth: ConstraintFrame,
    key: jax.Array,
    *,
    angles: tuple[float, float] = LITERATURE_ERRORS[0],
    distances: tuple[float, float] = LITERATURE_ERRORS[1],
    arm: str | Arm = PANDA,
    start: ArrayLike = ROOMY,
) -> Frame:
    """Frames turned and shifted by errors of random direction and uniform size.

    Args:
        truth: geometry (N, 3) each.
        key: of the errors.
        angles: degrees, smallest and largest turn.
        distances: mm, smallest and largest shift.
        arm: the robot.
        start: (7,) rad, where the errors are as said.
    """
    dtype, count, arm = truth.position.dtype, truth.position.shape[0], arm_named(arm)
    pose = forward_kinematics(arm.start(start, dtype), arm)

    def draw(key: jax.Array, low: float, high: float) -> jax.Array:
        way, size = jax.random.split(key)
        direction = jax.random.normal(way, (count, 3), dtype)
        length = jax.random.uniform(size, (count, 1), dtype, low, high)
        return length * direction / jnp.linalg.norm(direction, axis=-1, keepdims=True)

    turn_key, shift_key = jax.random.split(key)
    turns = rotations.rotation_exp(draw(turn_key, *(math.radians(angle) for angle in angles)))
    shifts = draw(shift_key, *(distance / 1e3 for distance in distances))
    return jax.vmap(lambda frame, turn, shift: moved(frame, turn, shift, *pose))(
        frame_arrays(truth), turns, shifts
    )

"""Control frames: true frames, frames with deliberate errors, and identified frames."""

import math

import jax
import jax.numpy as jnp
from numpy.typing import ArrayLike

from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.located import Frame, assemble_frame, frame_arrays, move_frame
from reframe_jax.geometry import rotations
from reframe_jax.identification.results import Identification
from reframe_jax.simulation.arm.model import PANDA, Arm, find_arm, forward_kinematics

__all__ = ["LITERATURE_ERRORS", "ROOMY", "control_frames", "erroneous_frames"]

ROOMY = (0.0, -0.7, 0.0, -2.35, 0.0, 1.65, 0.785)
"""rad, initial joint positions of tasks: closer to the base than home, so that no task stretches the arm."""

LITERATURE_ERRORS = ((0.5, 5.0), (1.0, 7.5))
"""Ranges of the errors reported for methods with prior knowledge, degrees and mm (paper, section 7.2)."""


def control_frames(found: Identification | ConstraintFrame | Frame) -> Frame:
    """Return control frames with the batch axes of ``found``; types may vary in a batch of results."""
    if isinstance(found, Frame):
        return found
    if isinstance(found, ConstraintFrame):
        return frame_arrays(found)
    return assemble_frame(
        found.angular.type_code,
        found.linear.type_code,
        angular_axes=found.angular.axes,
        linear_axes=found.linear.axes,
        position=found.linear.position,
        angular_dof=found.angular.dof,
        linear_dof=found.linear.dof,
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
    """Rotate and shift frames (N) by errors with random directions and uniformly distributed sizes.

    The ranges of ``angles`` are in degrees, of ``distances`` in mm. The errors apply at the joint positions
    ``start`` (7,), rad.
    """
    dtype, count, arm = truth.position.dtype, truth.position.shape[0], find_arm(arm)
    pose = forward_kinematics(arm.start(start, dtype), arm)

    def draw(key: jax.Array, low: float, high: float) -> jax.Array:
        way, size = jax.random.split(key)
        direction = jax.random.normal(way, (count, 3), dtype)
        length = jax.random.uniform(size, (count, 1), dtype, low, high)
        return length * direction / jnp.linalg.norm(direction, axis=-1, keepdims=True)

    turn_key, shift_key = jax.random.split(key)
    turns = rotations.rotation_exp(draw(turn_key, *(math.radians(angle) for angle in angles)))
    shifts = draw(shift_key, *(distance / 1e3 for distance in distances))
    return jax.vmap(lambda frame, turn, shift: move_frame(frame, turn, shift, *pose))(
        frame_arrays(truth), turns, shifts
    )

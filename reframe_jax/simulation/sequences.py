"""Sequences of constraints with known truth: one constraint after the other, each where the body then is."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.located import place_frame
from reframe_jax.geometry import rotations
from reframe_jax.simulation.motions import PoseErrors, disturb
from reframe_jax.simulation.synthetic import Excitation, simulate

__all__ = ["SequenceSimulation", "simulate_sequence"]

_REACH = 0.3  # m, half the width of the cube about the body in which origins of frames are drawn
_NO_ERRORS = PoseErrors()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SequenceSimulation:
    """A simulated recording of several constraints.

    Attributes:
        times: (N,) s.
        poses: (N, 4, 4) measured poses, errors included; m.
        exact_poses: (N, 4, 4) poses without errors.
        truths: the constraints, in the order in which they held.
        boundaries: index of the pose at which each constraint but the first takes over. That pose satisfies
            both constraints.
    """

    times: jax.Array
    poses: jax.Array
    exact_poses: jax.Array
    truths: tuple[ConstraintFrame, ...]
    boundaries: tuple[int, ...] = field(metadata={"static": True})


def simulate_sequence(
    constraints: Sequence[str | ConstraintFrame],
    key: jax.Array,
    *,
    durations: float | Sequence[float] = 5.0,
    dt: float = 0.01,
    excitation: str | Excitation = "exciting",
    ease: float = 0.25,
    errors: PoseErrors = _NO_ERRORS,
) -> SequenceSimulation:
    """Simulate a body that moves under one constraint after the other.

    The poses are continuous, and so is the velocity: each motion sets out from rest and comes to rest.

    Args:
        constraints: labels or names of the catalogue, such as "A" or "unconstrained", in random places
            within reach of the body; or frames, which stay where they are.
        key: of the geometry, the motions and the errors.
        durations: s, of every constraint, or of each.
        dt: sample time, s.
        excitation: as in :func:`reframe_jax.simulation.synthetic.simulate`.
        ease: s, in which each motion sets out and comes to rest; 0 for sudden changes of velocity.
        errors: of the tracker; none by default.

    Returns:
        The recording; each constraint holds for round(duration / dt) steps.

    Raises:
        ValueError: if there are no constraints, or not as many durations.
        KeyError: for an unknown constraint.
    """
    each = [durations] * len(constraints) if isinstance(durations, int | float) else list(durations)
    if not constraints or len(each) != len(constraints):
        raise ValueError(
            f"simulate_sequence needs constraints, and one duration or as many; got {len(constraints)} "
            f"constraints and {len(each)} durations."
        )
    *keys, error_key = jax.random.split(key, len(constraints) + 1)
    pose = jnp.eye(4, dtype=float)
    pieces, truths, boundaries = [pose[None]], [], [0]
    for constraint, duration, own_key in zip(constraints, each, keys, strict=True):
        place_key, motion_key = jax.random.split(own_key)
        frame = _place(constraint, place_key, pose) if isinstance(constraint, str) else constraint
        moved = simulate(
            frame, motion_key, duration=duration, dt=dt, excitation=excitation, ease=ease, start=pose
        ).exact_poses
        pose = moved[-1]
        pieces.append(moved[1:])
        truths.append(frame)
        boundaries.append(boundaries[-1] + len(moved) - 1)
    exact = jnp.concatenate(pieces)
    return SequenceSimulation(
        times=dt * jnp.arange(len(exact), dtype=exact.dtype),
        poses=disturb(exact, error_key, errors, dt),
        exact_poses=exact,
        truths=tuple(truths),
        boundaries=tuple(boundaries[1:-1]),
    )


def _place(label: str, key: jax.Array, pose: jax.Array) -> ConstraintFrame:
    """A constraint with a name, turned at random, its origin within reach of the body."""
    turn_key, shift_key = jax.random.split(key)
    shift = jax.random.uniform(shift_key, (3,), minval=-_REACH, maxval=_REACH, dtype=pose.dtype)
    quaternion = jax.random.normal(turn_key, (4,), dtype=pose.dtype)
    axes = rotations.quaternion_to_rotation(quaternion / jnp.linalg.norm(quaternion))
    frame = ConstraintFrame.named(label, rotvec=np.zeros(3), position=np.zeros(3))
    return place_frame(frame, axes, pose[:3, 3] + shift, pose[:3, :3], pose[:3, 3])

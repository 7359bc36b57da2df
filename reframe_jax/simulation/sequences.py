"""Simulate recordings with several consecutive constraints and known truth."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.constraints.frame import ConstraintFrame, place_frame
from reframe_jax.geometry import rotations
from reframe_jax.simulation.motions import PoseErrors, disturb
from reframe_jax.simulation.synthetic import pitch_of, simulate

__all__ = ["SequenceSimulation", "each_duration", "simulate_sequence"]

_REACH = 0.3  # m, half the width of the cube about the body in which origins of frames are drawn
_EASE = 0.25  # s, duration of the start and of the end of each motion
_NO_ERRORS = PoseErrors()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SequenceSimulation:
    """A simulated recording of several constraints.

    Attributes:
        times, poses, exact_poses: (N,) s and (N, 4, 4) m, as in :class:`.Simulation`.
        truths: the constraints in order of time.
        boundaries: index of the first pose of each constraint after the first. This pose obeys both
            constraints.
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
    errors: PoseErrors = _NO_ERRORS,
) -> SequenceSimulation:
    """Simulate a body that moves under several consecutive constraints.

    The poses and velocities are continuous: each motion starts from rest and ends at rest. Constraints are
    labels or names of the catalogue, such as "A" or "unconstrained", which get a random geometry near the
    body; or frames, which are used without change. Each is active for round(duration / dt) steps, with one
    duration, s, for all or one per constraint. The tracker has no errors by default. A ValueError is raised
    without constraints, or for a wrong number of durations, a KeyError for an unknown constraint.
    """
    each = each_duration(constraints, durations)
    *keys, error_key = jax.random.split(key, len(constraints) + 1)
    pose = jnp.eye(4, dtype=float)
    pieces, truths, boundaries = [pose[None]], [], [0]
    for constraint, duration, own_key in zip(constraints, each, keys, strict=True):
        place_key, motion_key = jax.random.split(own_key)
        options: Any = {"duration": duration, "dt": dt, "ease": _EASE, "start": pose}
        if isinstance(constraint, str):
            options["pitch"] = pitch_of(constraint)
            constraint = _place(constraint, place_key, pose)
        moved = simulate(constraint, motion_key, **options).exact_poses
        pose = moved[-1]
        pieces.append(moved[1:])
        truths.append(constraint)
        boundaries.append(boundaries[-1] + len(moved) - 1)
    exact = jnp.concatenate(pieces)
    return SequenceSimulation(
        times=dt * jnp.arange(len(exact), dtype=exact.dtype),
        poses=disturb(exact, error_key, errors, dt),
        exact_poses=exact,
        truths=tuple(truths),
        boundaries=tuple(boundaries[1:-1]),
    )


def each_duration(
    constraints: Sequence[str | ConstraintFrame], durations: float | Sequence[float]
) -> list[float]:
    """Return one duration per constraint; raise a ValueError without constraints, or for another number."""
    one = isinstance(durations, int | float | np.number)
    each: Any = [durations] * len(constraints) if one else durations
    if not constraints or len(each) != len(constraints):
        raise ValueError(
            "A sequence needs constraints, and one duration or one per constraint; found "
            f"{len(constraints)} constraints and {len(each)} durations."
        )
    return list(each)


def _place(label: str, key: jax.Array, pose: jax.Array) -> ConstraintFrame:
    """Place a named constraint with a random orientation, and a random origin near the body."""
    turn_key, shift_key = jax.random.split(key)
    shift = jax.random.uniform(shift_key, (3,), minval=-_REACH, maxval=_REACH, dtype=pose.dtype)
    quaternion = jax.random.normal(turn_key, (4,), dtype=pose.dtype)
    axes = rotations.quaternion_to_rotation(quaternion / jnp.linalg.norm(quaternion))
    return place_frame(ConstraintFrame.named(label), axes, pose[:3, 3] + shift, pose[:3, :3], pose[:3, 3])

"""Simulate batches of demonstrations: a hand guides the arm under a constraint."""

import math
from dataclasses import dataclass
from typing import Any, TypedDict

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.compilation import index_leaves
from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.located import frame_arrays, move_frame, place_frame
from reframe_jax.geometry import rotations
from reframe_jax.simulation.arm.guide import EXCITATIONS, Guide
from reframe_jax.simulation.arm.guided import Plan, demonstration_keys, record, run_guided
from reframe_jax.simulation.arm.imperfections import Imperfections, check_numbers, compliance_of
from reframe_jax.simulation.arm.model import PANDA, Arm, find_arm, forward_kinematics
from reframe_jax.simulation.arm.rollout import RolloutStatus, Steps, Track, rollout_status
from reframe_jax.simulation.synthetic import Excitation

SPREAD = (0.4, 0.02)
"""rad and m, standard deviations per component of a random geometry."""

_ORIGIN = (0.05, 0.02, -0.12)  # m, from the TCP to the origin of a named constraint, in the axes of the base
_LONGEST = 0.01  # s, longest step at which the simulation keeps the constraint


class DemonstrateOptions(TypedDict, total=False):
    """Keyword arguments of :func:`demonstrate`, for functions that pass them on."""

    duration: float
    dt: float
    step: float | None
    excitation: str | Excitation
    spread: tuple[float, float]
    guide: Guide
    imperfections: Imperfections
    arm: str | Arm
    start: ArrayLike | None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Demonstration:
    """A batch of demonstrations; slice it like an array.

    Attributes:
        times: (K+1,) s.
        poses: (N, K+1, 4, 4) m, recorded poses of {b} in {g}, with the errors of the robot.
        exact_poses: (N, K+1, 4, 4) m, the true poses.
        joint_positions: (N, K+1, 7) rad.
        joint_velocities: (N, K+1, 7) rad/s.
        truth: the true constraint, with one geometry (N, 3) per demonstration.
        reaction: (N, K+1, 6) N m and N, moments of the constraint on the tool along the angular axes, and
            forces along the linear axes at the frame's origin; zero along free axes.
        slip: (N, K+1, 6) rad and m, displacement along the axes of the frame, the integral of the velocity.
            Along constrained axes, the slip is the violation of the constraint; see ``violation``.
        limit_margin: (N,) rad, smallest distance of a joint from the end of its range.
        status_code: (N,) int, code of ``status``.
    """

    times: jax.Array
    poses: jax.Array
    exact_poses: jax.Array
    joint_positions: jax.Array
    joint_velocities: jax.Array
    truth: ConstraintFrame
    reaction: jax.Array
    slip: jax.Array
    limit_margin: jax.Array
    status_code: jax.Array

    def __getitem__(self, index: int | slice | np.ndarray | jax.Array) -> "Demonstration":
        """Select demonstrations; a single index removes the batch axis."""
        parts = {name: value for name, value in vars(self).items() if name != "times"}
        return Demonstration(self.times, **index_leaves(parts, index))

    @property
    def violation(self) -> jax.Array:
        """(..., 2) rad and m, largest slip along constrained rotations and translations."""
        free = jnp.asarray((*self.truth.angular_dof, *self.truth.linear_dof), dtype=bool)
        held = jnp.max(jnp.abs(self.slip), axis=-2)
        held = jnp.where(jnp.broadcast_to(free, held.shape), 0, held)
        return jnp.stack([jnp.max(held[..., :3], axis=-1), jnp.max(held[..., 3:], axis=-1)], axis=-1)

    @property
    def status(self) -> Any:
        """:class:`RolloutStatus` of a single demonstration; integer codes of a batch."""
        if np.ndim(self.status_code) or isinstance(self.status_code, jax.core.Tracer):
            return self.status_code
        return RolloutStatus(int(self.status_code))


def frame_on_arm(
    constraint: str | ConstraintFrame, arm: str | Arm = PANDA, *, start: ArrayLike | None = None
) -> ConstraintFrame:
    """Place a named constraint so that the arm can move under the constraint; return a frame unchanged.

    The axes of the frame are parallel to the robot's base at the start. The origin is 0.13 m below and in
    front of the TCP, like the tip of a tool or the axis of a joint at this distance.

    Args:
        constraint: label or name of the catalogue, or a frame.
        arm: the robot.
        start: (..., 7) rad; the arm's home by default.

    Raises:
        KeyError: for an unknown constraint.
        ValueError: for an unknown robot, or if ``constraint`` is not a constraint.
    """
    if isinstance(constraint, ConstraintFrame):
        return constraint
    if not isinstance(constraint, str):
        raise ValueError(f"A constraint must be a label, a name or a ConstraintFrame, not {constraint!r}.")
    arm = find_arm(arm)
    joints = arm.start(start, float)
    rotation, position = forward_kinematics(joints, arm)
    axes, offset = (jnp.asarray(part, dtype=joints.dtype) for part in (np.eye(3), _ORIGIN))
    axes, offset = jnp.broadcast_to(axes, rotation.shape), jnp.broadcast_to(offset, position.shape)
    return place_frame(ConstraintFrame.named(constraint), axes, position + offset, rotation, position)


def demonstrate(
    constraint: str | ConstraintFrame,
    key: jax.Array,
    *,
    batch: int = 1,
    first: int = 0,
    duration: float = 5.0,
    dt: float = 0.05,
    step: float | None = None,
    excitation: str | Excitation = "exciting",
    spread: tuple[float, float] = (0.0, 0.0),
    guide: Guide = Guide(),  # noqa: B008
    imperfections: Imperfections = Imperfections(),  # noqa: B008
    arm: str | Arm = PANDA,
    start: ArrayLike | None = None,
) -> Demonstration:
    """Simulate a hand that guides the arm under a constraint.

    The function works under ``jit`` (with static shapes and names). It also works under ``grad`` with respect
    to the geometry of the constraint and the guide. One compiled program serves all constraints. For a given
    key, demonstration i is the same in every batch, up to rounding errors.

    Args:
        constraint: label or name of one of the twelve constraints of the paper, placed by
            :func:`frame_on_arm`, or any frame, with its geometry in the robot's base and the TCP frame. A
            geometry (N, 3) gives each demonstration a separate geometry.
        key: JAX random key.
        batch: number N of demonstrations.
        first: number of the first demonstration, to continue an earlier batch.
        duration: s.
        dt: s, time between recorded samples.
        step: s, time step of the simulation, which must divide ``dt``. The default is the longest step up to
            0.01 s; the error of a rigid constraint is then a few um.
        excitation: motion along the free axes: ``"exciting"``, ``"brisk"``, ``"paper"``, or a function of
            time that returns angular and linear velocities (3,), in rad/s and m/s.
        spread: rad and m, standard deviations of a random rotation and shift of the geometry of each
            demonstration, for example :data:`SPREAD`.
        guide: stiffness, misalignment and tremor of the hand.
        imperfections: errors of the robot and its sensors.
        arm: ``"panda"``, ``"fr3"``, or an arm.
        start: (7,) or (N, 7) rad, initial joint positions, at rest; the arm's home by default.

    Returns:
        The demonstrations. Check ``status_code``, because the simulation does not enforce joint limits.

    Raises:
        KeyError: for an unknown constraint.
        ValueError: for an unknown name, or unusable numbers or shapes.
    """
    arm = find_arm(arm)
    check_demonstration(batch, first, excitation, spread, guide, imperfections, start)
    steps = sampling(duration, dt, step)
    frame = frame_on_arm(constraint, arm, start=start)
    joints = jnp.broadcast_to(arm.start(start, frame.position.dtype), (batch, 7))
    numbers = jnp.asarray(first + np.arange(batch), dtype=jnp.uint32)
    frame = scatter(frame, key, numbers, joints, spread, arm)
    endless, at_rest = jnp.asarray(jnp.inf, dtype=joints.dtype), jnp.zeros_like(joints)
    options = guide, imperfections
    plan = Plan(steps, excitation, arm)
    track = run_guided(frame_arrays(frame), key, numbers, joints, at_rest, endless, *options, plan=plan)
    poses, exact = record(track.joints, key, numbers, imperfections, arm=arm)
    times = dt * jnp.arange(steps.samples + 1, dtype=joints.dtype)
    return assemble(track, frame, times, poses, exact, imperfections, arm)


def assemble(
    track: Track,
    truth: ConstraintFrame,
    times: jax.Array,
    poses: jax.Array,
    exact: jax.Array,
    imperfections: Imperfections,
    arm: Arm,
) -> Demonstration:
    """Assemble a batch of demonstrations, and compute their status."""
    compliance = compliance_of(imperfections, track.joints.dtype)
    margin, status = rollout_status(track, frame_arrays(truth).free, compliance, arm)
    return Demonstration(
        times=times,
        poses=poses,
        exact_poses=exact,
        joint_positions=track.joints,
        joint_velocities=track.velocity,
        truth=truth,
        reaction=track.force,
        slip=track.slip,
        limit_margin=margin,
        status_code=status,
    )


def check_demonstration(
    batch: int,
    first: int,
    excitation: str | Excitation,
    spread: tuple[float, float],
    guide: Guide,
    imperfections: Imperfections,
    start: ArrayLike | None,
) -> None:
    """Raise a ValueError for options that no demonstration can have."""
    if not callable(excitation) and excitation not in EXCITATIONS:
        raise ValueError(f"No excitation {excitation!r}. There are: {', '.join(EXCITATIONS)}.")
    if batch < 1:
        raise ValueError(f"batch must be at least 1, not {batch}.")
    if first < 0:
        raise ValueError(f"first must be at least 0, not {first}.")
    if np.shape(spread) != (2,):
        raise ValueError(f"spread must be two numbers, rad and m, not {spread!r}.")
    check_numbers(guide, Guide)
    check_numbers(imperfections, Imperfections)
    if start is not None and np.shape(start) not in ((7,), (batch, 7)):
        raise ValueError(f"start must have shape (7,) or ({batch}, 7), not {np.shape(start)}.")


def sampling(duration: float, dt: float, step: float | None) -> Steps:
    """Divide a duration into samples and steps (s); the default step is the longest that divides ``dt``."""
    if not (0 < dt <= duration < math.inf):
        raise ValueError(f"Expected 0 < dt <= duration; found a dt of {dt:g} s in {duration:g} s.")
    if step is None:
        step = dt / math.ceil(dt / _LONGEST - 1e-6)
    if not (0 < step <= dt):
        raise ValueError(f"Expected 0 < step <= dt; found a step of {step:g} s and a dt of {dt:g} s.")
    substeps = round(dt / step)
    if abs(substeps * step - dt) > 1e-6 * dt:
        raise ValueError(f"The step of {step:g} s must divide the sample time of {dt:g} s.")
    return Steps(round(duration / dt), substeps, dt / substeps)


def scatter(
    frame: ConstraintFrame,
    key: jax.Array,
    numbers: jax.Array,
    joints: jax.Array,
    spread: tuple[float, float],
    arm: Arm,
) -> ConstraintFrame:
    """Give each demonstration a geometry (N, 3), with randomly turned axes and a randomly shifted origin.

    Raises:
        ValueError: for a geometry that is neither (3,) nor (N, 3).
    """
    batch = len(numbers)
    for name in ("angular_rotvec", "linear_rotvec", "position"):
        shape = getattr(frame, name).shape
        if shape not in ((3,), (batch, 3)):
            raise ValueError(f"{name} of the constraint must have shape (3,) or ({batch}, 3), not {shape}.")
    frame = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (batch, 3)), frame)
    if not any(np.ravel(spread)):
        return frame
    keys, dtype = demonstration_keys(key, numbers)[:, 0], joints.dtype
    random = jax.vmap(lambda key: jax.random.normal(key, (2, 3), dtype))(keys)
    turn, shift = jnp.moveaxis(jnp.asarray(spread, dtype=dtype)[None, :, None] * random, 1, 0)
    return move_frame(frame, rotations.rotation_exp(turn), shift, forward_kinematics(joints, arm)[0])

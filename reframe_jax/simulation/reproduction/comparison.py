"""Compare reproductions in true and identified frames."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.constraints.frame import ConstraintFrame, Frame, frame_arrays, locate
from reframe_jax.geometry.products import apply
from reframe_jax.identification.classify import Thresholds
from reframe_jax.identification.entry import identify
from reframe_jax.identification.results import Identification
from reframe_jax.simulation import metrics
from reframe_jax.simulation.arm.collection import draw_usable
from reframe_jax.simulation.arm.demonstration import SPREAD, Demonstration, demonstrate
from reframe_jax.simulation.arm.imperfections import REALISTIC, Imperfections, check_imperfections
from reframe_jax.simulation.arm.model import PANDA, Arm, find_arm, forward_kinematics
from reframe_jax.simulation.reproduction.controllers import Controller, constant_wrench
from reframe_jax.simulation.reproduction.trials import ROOMY, Trials, control_frames, reproduce
from reframe_jax.simulation.synthetic import Excitation


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Comparison:
    """A task reproduced in two kinds of frames.

    Attributes:
        demonstrations, found: the demonstrations, and the identifications of their frames.
        exact, identified: trials in the true frames, the baseline, and in the identified frames.
        redrawn: number of geometries that were left out, because the demonstration was infeasible or the
            end-stop was out of reach even in the true frame (see ``RolloutStatus``).
        errors: (N, 3) errors of the identified frames: angular axis and linear axis in degrees, position in
            mm; NaN for quantities that the constraint does not determine.
    """

    demonstrations: Demonstration
    found: Identification
    exact: Trials
    identified: Trials
    errors: jax.Array
    redrawn: jax.Array

    def excess(self) -> tuple[jax.Array, jax.Array]:
        """Peak moments (N,), N m, and forces (N,), N, of identified frames, minus those of exact frames."""
        found, exact = self.identified, self.exact
        return found.peak_moment - exact.peak_moment, found.peak_force - exact.peak_force

    @property
    def rows(self) -> dict[str, Trials]:
        """Trials by the geometry that the robot uses: exact or identified."""
        return {"exact": self.exact, "identified": self.identified}


def compare(
    constraint: str | ConstraintFrame,
    key: jax.Array,
    trials: int = 30,
    *,
    controller: Controller = constant_wrench(),  # noqa: B008
    imperfections: Imperfections = REALISTIC,
    excitation: str | Excitation = "exciting",
    spread: tuple[float, float] = SPREAD,
    arm: str | Arm = PANDA,
    start: tuple[float, ...] = ROOMY,
    progress: Callable[[int, int], None] | None = None,
) -> Comparison:
    """Demonstrate, identify, and reproduce a task in the true and in the identified frames.

    Each of the ``trials`` has a random geometry. Options are those of
    :func:`reframe_jax.simulation.arm.demonstrate` and :func:`reproduce`; the reproductions have the
    compliance of the demonstrations, and both start at the joint positions ``start`` (7,), rad. ``progress``
    receives the number of prepared trials and ``trials``. The comparison leaves out, and counts, geometries
    for which the arm reaches a limit, or for which the end-stop is out of reach even with the true frame.

    A constraint may not determine the origin of its frame. The comparison then moves the identified origin to
    the true origin, where the forces act. If all rotations are free, moments act along the true axes. Other
    choices are equally correct, but their trials could not be compared with the baseline. A ValueError is
    raised for unusable numbers or names, or if more than 9 in 10 geometries are unusable.
    """
    if trials < 1:
        raise ValueError(f"trials must be at least 1, not {trials}.")
    check_imperfections(imperfections)
    demonstrate_key, _ = jax.random.split(key)
    robot: Any = {"arm": arm, "start": start}
    compliance = float(imperfections.angular_compliance), float(imperfections.compliance)
    run: Callable[..., Trials] = partial(reproduce, controller=controller, compliance=compliance, **robot)
    chunk = min(trials, 64)
    options: Any = {"imperfections": imperfections, "excitation": excitation, "spread": spread, **robot}

    def draw(number: int) -> tuple[tuple[Demonstration, Trials], np.ndarray]:
        made = demonstrate(constraint, demonstrate_key, batch=chunk, first=number * chunk, **options)
        made, exact = jax.device_get((made, run(made.truth, made.truth)))
        return (made, exact), np.maximum(made.status_code, exact.status_code)

    parts: list[tuple[Demonstration, Trials]] = []
    subject = "tasks are within the arm's reach"
    for (made, exact), good in draw_usable(draw, trials, chunk, subject=subject, progress=progress):
        parts.append((made[good], exact[good]))
    # without the draws after the last one that was needed
    drawn = (len(parts) - 1) * chunk + int(good[-1]) + 1
    times = made.times
    made, exact = jax.tree.map(lambda *leaves: jnp.asarray(np.concatenate(leaves)), *parts)
    made, exact = (replace(part, times=jnp.asarray(times)) for part in (made, exact))
    found = identify(made.poses, times=made.times, scales=1, thresholds=Thresholds())
    errors = metrics.geometry_errors(found, made.truth, start=made.exact_poses[:, 0])
    columns = jnp.degrees(errors.angular), jnp.degrees(errors.linear), 1e3 * errors.position
    return Comparison(
        demonstrations=made,
        found=found,
        exact=exact,
        identified=run(made.truth, matched_choices(found, made.truth, **robot)),
        redrawn=jnp.asarray(drawn - trials),
        errors=jnp.stack(columns, axis=-1),
    )


def matched_choices(
    found: Identification, truth: ConstraintFrame, *, arm: str | Arm = PANDA, start: "ArrayLike" = ROOMY
) -> Frame:
    """Return the identified frames (N), with true origins and axes in place of arbitrary origins and axes.

    The replaced origins and axes agree with the truth at the joint positions ``start`` (7,), rad.
    """
    arm = find_arm(arm)
    pose = forward_kinematics(arm.start(start, truth.position.dtype), arm)

    def move(frame: Frame, true: Frame, free: jax.Array) -> Frame:
        away = locate(true, *pose).lever - locate(frame, *pose).lever
        away = jnp.where(frame.on_body[2], apply(pose[0].T, away), away)
        turns = jnp.all(frame.free[:3] > 0)
        return replace(
            frame,
            position=frame.position + apply(free, away),
            angular_axes=jnp.where(turns, true.angular_axes, frame.angular_axes),
            on_body=frame.on_body.at[0].set(jnp.where(turns, true.on_body[0], frame.on_body[0])),
        )

    return jax.vmap(move)(control_frames(found), frame_arrays(truth), found.linear.free_position)

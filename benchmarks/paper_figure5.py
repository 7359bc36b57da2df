"""Figure 5 of the paper on a simulated Panda: tasks reproduced in exact, inexact and identified frames."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import reframe_jax as rf
from benchmarks.charts import plot_bars
from benchmarks.paper_common import Section, Store, plain, spread, table
from benchmarks.paper_table4 import SETUPS, Setup
from reframe_jax.constraints.frame import frame_arrays, move_frame
from reframe_jax.geometry import rotations
from reframe_jax.simulation import arm as panda
from reframe_jax.simulation import reproduction

__all__ = ["ROWS", "TASKS", "Size", "reproduce_all", "section"]

TASKS = ("A", "B", "I", "I, position only")
ROWS = ("exact", "literature", "identified")
_ERRORS = (0.5, 5.0), (1.0, 7.5)  # degrees and mm, reported for methods with prior knowledge (section 7.2)

_INTRODUCTION = """\
## Figure 5: reproduction

In this section, the simulated arm repeats the tasks A, B and I from end-stop to end-stop. Constant wrenches
(3.5 N m, 7 N) move the arm along the free axes of a control frame. There are three control frames: the
*exact* frame, an *inexact* frame with the errors that methods with prior knowledge report (0.5-5 degrees,
1-7.5 mm), and the frame *identified* from a demonstration. Every cell has {trials} trials with different
geometries, and shows the mean ± standard deviation of the peak reaction along the true constrained axes. The
exact frame also causes reactions, from the inertia and friction of the arm. *Excess* is the difference from
the reaction of the exact frame in the same trial: the effect of the errors of the frame. *At rest* is the
reaction after 5 s, when the arm pushes against the end-stop and its inertia has no effect. *I, position only*
is task I as the paper controlled it, with true axes. For A and B, which all four types express, the
identified type may differ from the exact type. (The paper shows its reactions in a picture without numbers.
It reports that the arm reached all end-stops, and that larger errors of the frame did not always increase the
reactions.)
"""
_TITLES = {
    "realistic": "A mount with a compliance of 0.1 mm/N and 2.5 mrad/(N m)",
    "matched": "A mount with a compliance of 0.1 mm/N and 8 mrad/(N m), at the speed of the paper",
}


@dataclass(frozen=True)
class Size:
    """Size of the computation of Figure 5.

    Attributes:
        trials: number of trials per task and kind of frame.
        setups: names from ``paper_table4.SETUPS``.
        seed: random seed.
    """

    trials: int = 32
    setups: tuple[str, ...] = tuple(_TITLES)
    seed: int = 2025

    @staticmethod
    def quick(seed: int) -> "Size":
        """A small part of the full size."""
        return Size(trials=8, setups=("realistic",), seed=seed)


def reproduce_all(size: Size, setup: Setup) -> dict[str, np.ndarray]:
    """Reproduce the tasks in the three kinds of frames.

    Returns:
        Arrays (tasks, rows, trials): peaks ``moment`` (N m) and ``force`` (N); values at the end
        ``rest_moment`` and ``rest_force``; ``completed``. Also ``errors`` (tasks, trials, 3) of the
        identified frames in deg, deg and mm, and ``redrawn`` (tasks,), the number of geometries out of reach.
    """
    results: dict[str, list[object]] = {}
    for label in ("A", "B", "I"):
        key = jax.random.fold_in(jax.random.key(size.seed + 1), ord(label))
        outcome = reproduction.compare(label, key, size.trials, **setup._asdict())
        wrong = erroneous_frames(outcome.demonstrations.truth, jax.random.split(key)[1])
        rows = outcome.rows | {"literature": _run(outcome, setup.imperfections)(wrong)}
        _add(results, rows, np.asarray(outcome.errors), int(outcome.redrawn))
    errors = np.asarray(outcome.errors) * [0, 0, 1]
    _add(results, _position_only(outcome, key, setup.imperfections), errors, int(outcome.redrawn))
    return {name: np.asarray(values) for name, values in results.items()}


def _add(
    results: dict[str, list[object]],
    rows: Mapping[str, reproduction.Trials],
    errors: np.ndarray,
    redrawn: int,
) -> None:
    """Append one task."""
    trials = [jax.device_get(rows[name]) for name in ROWS]
    rest = [trial.reaction[:, -1] for trial in trials]
    for name, values in {
        "moment": [trial.peak_moment for trial in trials],
        "force": [trial.peak_force for trial in trials],
        "rest_moment": [np.linalg.norm(reaction[:, :3], axis=-1) for reaction in rest],
        "rest_force": [np.linalg.norm(reaction[:, 3:], axis=-1) for reaction in rest],
        "completed": [trial.completed for trial in trials],
        "errors": errors,
        "redrawn": redrawn,
    }.items():
        results.setdefault(name, []).append(values)


def _run(
    outcome: reproduction.Comparison, imperfections: panda.Imperfections
) -> Callable[[Any], reproduction.Trials]:
    """Return a function from control frames to their trials, under the true constraints of a comparison."""
    give = float(imperfections.angular_compliance), float(imperfections.compliance)
    return partial(reproduction.reproduce, outcome.demonstrations.truth, compliance=give)


def _position_only(
    outcome: reproduction.Comparison, key: jax.Array, imperfections: panda.Imperfections
) -> dict[str, reproduction.Trials]:
    """Reproduce task I in frames with true axes and errors of the position only."""
    truth, run = outcome.demonstrations.truth, _run(outcome, imperfections)
    found = reproduction.matched_choices(outcome.found, truth)
    wrong = erroneous_frames(truth, jax.random.fold_in(key, 0), angles=(0.0, 0.0))
    return {
        "exact": outcome.exact,
        "literature": run(wrong),
        "identified": run(replace(frame_arrays(truth), position=found.position)),
    }


def erroneous_frames(
    truth: rf.ConstraintFrame,
    key: jax.Array,
    *,
    angles: tuple[float, float] = _ERRORS[0],
    distances: tuple[float, float] = _ERRORS[1],
) -> rf.ConstraintFrame:
    """Rotate and shift frames (N) by errors with random directions and uniformly distributed sizes.

    The ranges of ``angles`` are in degrees, of ``distances`` in mm. The errors apply at the start of the
    reproductions.
    """
    dtype, count = truth.position.dtype, truth.position.shape[0]
    rotation = panda.forward_kinematics(jnp.asarray(reproduction.ROOMY, dtype=dtype))[0]

    def draw(key: jax.Array, low: float, high: float) -> jax.Array:
        way, size = jax.random.split(key)
        direction = jax.random.normal(way, (count, 3), dtype)
        length = jax.random.uniform(size, (count, 1), dtype, low, high)
        return length * direction / jnp.linalg.norm(direction, axis=-1, keepdims=True)

    turn_key, shift_key = jax.random.split(key)
    turns = rotations.rotation_exp(draw(turn_key, *(math.radians(angle) for angle in angles)))
    shifts = draw(shift_key, *(distance / 1e3 for distance in distances))
    return move_frame(truth, turns, shifts, jnp.broadcast_to(rotation, turns.shape))


def section(store: Store, size: Size) -> Section:
    """Compute, or resume, and describe the reproductions of Figure 5."""
    blocks, metrics, data = [_INTRODUCTION.format(trials=size.trials)], {}, {}
    for name in size.setups:
        found = store.piece(f"figure5-{name}", partial(reproduce_all, size, SETUPS[name]))
        picture = store.picture(f"figure5-{name}", _picture(found))
        blocks += [f"### {_TITLES[name]}\n", picture, "", _table(found), _left_out(found)]
        data[name] = {key: plain(values) for key, values in found.items() if key != "completed"}
        for i, task in enumerate(TASKS):
            prefix = f"figure5_{name}_{task.replace(', ', '_').replace(' ', '_')}"
            metrics[f"{prefix}_completed"] = float(found["completed"][i].mean())
            for kind in ("moment", "force"):
                excess = found[kind][i, ROWS.index("identified")] - found[kind][i, 0]
                metrics[f"{prefix}_excess_{kind}"] = float(excess.mean())
    return Section("\n".join(blocks), metrics, data)


def _picture(found: Mapping[str, np.ndarray]) -> object:
    groups = [f"{task[0]}\n{rf.CONSTRAINTS[task[0]].name}" for task in TASKS[:3]] + ["I\nposition only"]
    groups = [text.replace(" pin-plane", "\npin-plane") for text in groups]
    bars = {
        f"peak reaction {kind}": {row: list(found[kind][:, j]) for j, row in enumerate(ROWS)}
        for kind in ("moment", "force")
    }
    units = dict(zip(bars, ("N m", "N"), strict=True))
    return plot_bars(groups, bars, ylabels=units)


def _table(found: Mapping[str, np.ndarray]) -> str:
    head = ["task", "frame", "errors (median) [deg, deg, mm]", "end-stop reached"]
    head += ["moment [N m]", "excess", "at rest", "force [N]", "excess", "at rest"]
    rows = []
    for i, task in enumerate(TASKS):
        medians = np.median(found["errors"][i], axis=0)
        errors = ", ".join("–" if np.isnan(error) else f"{error:.2f}" for error in medians)
        for j, row in enumerate(ROWS):
            cells = [task, row, errors if row == "identified" else ""]
            cells.append(f"{100 * found['completed'][i, j].mean():.0f} %")
            for kind in ("moment", "force"):
                excess = found[kind][i, j] - found[kind][i, 0]
                cells += [spread(found[kind][i, j]), spread(excess, "+.2f") if j else ""]
                cells.append(spread(found[f"rest_{kind}"][i, j]))
            rows.append(cells)
    return table(head, rows) + "\n"


def _left_out(found: Mapping[str, np.ndarray]) -> str:
    counts = [
        f"{task}: {int(count)}" for task, count in zip(TASKS[:3], found["redrawn"], strict=False) if count
    ]
    return (
        f"Geometries that the arm could not reach, and that were replaced: {', '.join(counts)}.\n"
        if counts
        else ""
    )

"""How well the library knows what it does not know: intervals, probabilities, and ambiguous motions.

- Coverage: the share of 95 % intervals of the covariance that hold the truth, over all directions in which
  the axes and the origin are determined, for every constraint and noise level. With white noise it should be
  92 to 98 %; where it falls short, the noise is too large for a first-order covariance, or the noise of the
  window is hard to tell. Also printed is the root of the mean square of error over standard deviation,
  without the worst one per cent, and the share of windows with the right class, which alone are counted.
- Reliability: of the probabilities of the name and of free axes: the mean of those in a bin, and how often
  they were right. --plot draws it.
- Ambiguous motions: how often the motion was said not to tell, for motions that cannot, and for exciting
  ones.

Windows of 5 s at 20 Hz with random geometry, measured with noise whose ratio of rad to m is 3.
"""

import itertools
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

import reframe_jax as rf
from benchmarks.common import chosen_plan, machine, plan_parser, write_record
from reframe_jax.constraints import AngularType, ConstraintFrame, LinearType, lookup
from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.plotting.style import BODY, LINES, new_figure
from reframe_jax.simulation.metrics import dof_correct, types_correct
from reframe_jax.simulation.motions import PoseErrors, random_motion
from reframe_jax.simulation.synthetic import Simulation
from reframe_jax.uncertainty.covariance import Covariance, Errors

__all__ = ["standard_scores"]

SAMPLES, DT = 100, 0.05
INTERVAL = 1.96  # standard deviations that hold 95 %
_LEAST = 1e-12  # share of the largest variance below which a direction has none
_TRIMMED = 0.99  # share of the scores that the root of the mean square is taken of
_BINS = (0.0, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 1.0)
AMBIGUOUS = "EFGIJ"  # with the paper's velocities
QUANTITIES = "angular", "linear", "position"


@dataclass(frozen=True)
class Plan:
    """What a run covers: ``windows`` of every constraint and noise level."""

    labels: tuple[str, ...] = tuple(rf.CONSTRAINTS)
    motion: str = "exciting"
    sigmas: tuple[float, ...] = (1e-5, 1e-4, 1e-3, 3e-3, 1e-2)
    windows: int = 1000
    slow: float = 0.0
    errors: Errors = "measured"


QUICK = Plan(sigmas=(1e-4, 1e-3), windows=32)


def say(text: str) -> None:
    """Report progress."""
    print(text, file=sys.stderr, flush=True)


def recordings(label: str, motion: str, sigma: float, slow: float, count: int) -> Simulation:
    """Simulated windows of a constraint."""

    def of_key(key: jax.Array) -> Simulation:
        errors = PoseErrors(sigma=sigma, slow=slow)
        return random_motion(label, key, samples=SAMPLES, dt=DT, excitation=motion, errors=errors)

    return jax.vmap(of_key)(jax.random.split(jax.random.key(2025), count))


def standard_scores(
    found: rf.Identification, covariance: Covariance, truth: ConstraintFrame, start: np.ndarray
) -> dict[str, np.ndarray]:
    """Errors of N windows over their standard deviations, along the principal axes of the covariance.

    Args:
        found: of N windows, with the right class.
        covariance: of these.
        truth: leaves with an axis of N; one of the twelve, as :meth:`ConstraintFrame.named` orders its axes.
        start: (N, 4, 4) first true poses, at which both parts of the frame agree, m.

    Returns:
        (N, 3) of "angular" and "linear" axes, which only a class with a unique axis has, and the "position";
        NaN along directions without a variance.
    """
    matrix = np.asarray(covariance.matrix)
    entry = lookup(truth.linear_type, truth.angular_dof, truth.linear_dof)
    assert entry is not None
    axes_of_type = np.array([int(t.orientation_body) for t in LinearType])
    origin_of_type = np.array([int(t.position_body) for t in LinearType])
    turn, shift = np.asarray(start)[:, :3, :3], np.asarray(start)[:, :3, 3]

    def seen(axes: np.ndarray, fixed_in: int, wanted: np.ndarray) -> np.ndarray:
        """Axes (N, 3, n) of one body in those of another, at the start."""
        in_ground = turn @ axes if fixed_in == AngularType.B else axes
        return np.where((wanted == AngularType.B)[:, None, None], turn.mT @ in_ground, in_ground)

    frame_axes = np.asarray(rotation_exp(truth.linear_rotvec))
    fixed_in = int(truth.linear_type.orientation_body)
    scores = {}
    for name, part, odd, dof, own in (
        (
            "angular",
            found.angular,
            entry.angular_axis,
            truth.angular_dof,
            np.asarray(found.angular.type_code),
        ),
        (
            "linear",
            found.linear,
            entry.linear_axis,
            truth.linear_dof,
            axes_of_type[np.asarray(found.linear.type_code)],
        ),
    ):
        if odd is None:
            continue
        true = seen(frame_axes[:, :, odd : odd + 1], fixed_in, own)[:, :, 0]
        axis = np.asarray(rotation_exp(part.rotvec))[:, :, 2 if sum(dof) == 1 else 0]
        axis = axis * np.sign(np.sum(axis * true, axis=1))[:, None]
        block = slice(0, 3) if name == "angular" else slice(3, 6)
        scores[name] = _scores(np.cross(true, axis), matrix[:, block, block])
    body = origin_of_type[np.asarray(found.linear.type_code)]
    point = np.asarray(truth.position)
    if truth.linear_type.position_body == AngularType.B:
        point = (turn @ point[:, :, None])[:, :, 0] + shift
    in_body = (turn.mT @ (point - shift)[:, :, None])[:, :, 0]
    error = np.asarray(found.linear.position) - np.where((body == AngularType.B)[:, None], in_body, point)
    projector = np.asarray(found.linear.free_position)
    free = [i for i in range(3) if not entry.position[i]]
    if free:  # the truth moves along its own free directions, until what is left is across those found
        along = seen(frame_axes[:, :, free], fixed_in, body)
        amount = np.linalg.pinv(projector @ along, rcond=1e-3) @ projector @ error[:, :, None]
        error = error - (along @ amount)[:, :, 0]
    error = error - (projector @ error[:, :, None])[:, :, 0]
    scores["position"] = _scores(error, matrix[:, 6:9, 6:9])
    return scores


def _scores(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Errors (N, 3) over standard deviations, along the eigenvectors of the covariance (N, 3, 3)."""
    variances, directions = np.linalg.eigh(covariance)
    along = (error[:, None] @ directions)[:, 0]
    known = variances > _LEAST * np.maximum(variances[:, -1:], np.finfo(float).tiny)
    return np.where(known & (variances > 1e-24), along / np.sqrt(np.where(known, variances, 1)), np.nan)


def coverage_of(label: str, sigma: float, plan: Plan) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """One row of the table, and what the reliability of probabilities needs."""
    made = recordings(label, plan.motion, sigma, plan.slow, plan.windows)
    poses = np.asarray(made.poses)
    found = rf.identify(poses, dt=DT)
    sure = rf.covariance(found, poses, dt=DT, errors=plan.errors)
    usable = np.asarray(found.status_code) == 0
    right = usable & np.asarray(types_correct(found, made.truth) & dof_correct(found, made.truth))
    scores = standard_scores(found, sure, made.truth, np.asarray(made.exact_poses[:, 0]))
    row: dict[str, Any] = {"constraint": label, "sigma": sigma, "windows": plan.windows}
    row["right"] = float(np.mean(right))
    for name in QUANTITIES:
        values = np.abs(scores[name][right]) if name in scores else np.zeros(0)
        values = np.sort(values[np.isfinite(values)])
        known = len(values) > 0
        row[f"{name}_coverage"] = float(np.mean(values < INTERVAL)) if known else None
        trimmed = values[: max(int(_TRIMMED * len(values)), 1)]
        row[f"{name}_rms"] = float(np.sqrt(np.mean(trimmed**2))) if known else None
    true_name = rf.constraint(label).name
    free = [np.asarray(part.free_probability).ravel() for part in (found.angular, found.linear)]
    true = [np.sort(dof) for dof in (made.truth.angular_dof, made.truth.linear_dof)]
    said = {
        "name": np.asarray(found.probability, float),
        "name_right": np.asarray([each == true_name for each in found.name], float),
        "free": np.concatenate(free),
        "free_right": np.concatenate([np.tile(dof, plan.windows) for dof in true]).astype(float),
    }
    return row, said


def show_coverage(rows: list[dict[str, Any]]) -> None:
    """Print coverage and root mean square of scores, by constraint and noise level."""
    print("\nShare of 95 % intervals that hold the truth, and rms of error over standard deviation")
    print(f"{'':4}{'sigma, m':>10}{'right':>8}" + "".join(f"{name:>18}" for name in QUANTITIES))
    for row in rows:
        cells = [
            f"{'-':>18}"
            if row[f"{name}_coverage"] is None
            else f"{row[f'{name}_coverage']:>12.1%}{row[f'{name}_rms']:>6.2f}"
            for name in QUANTITIES
        ]
        print(f"{row['constraint']:4}{row['sigma']:>10.0e}{row['right']:>8.1%}" + "".join(cells))


def reliability(said: list[dict[str, np.ndarray]], kind: str) -> list[dict[str, float]]:
    """By bin of probability: how many, their mean, and how often they were right."""
    stated = np.concatenate([each[kind] for each in said])
    right = np.concatenate([each[f"{kind}_right"] for each in said])
    rows = []
    for low, high in itertools.pairwise(_BINS):
        here = (stated >= low) & ((stated < high) | (high == 1))
        if here.any():
            row = {"low": low, "high": high, "count": int(here.sum())}
            rows.append(row | {"stated": float(np.mean(stated[here])), "right": float(np.mean(right[here]))})
    return rows


def show_reliability(rows: list[dict[str, float]], title: str) -> None:
    """Print a table of :func:`reliability`."""
    print(f"\n{title}\n{'bin':>12}{'number':>10}{'stated':>10}{'right':>10}")
    for row in rows:
        print(
            f"{row['low']:>5.2f}-{row['high']:<6.2f}{row['count']:>10}{row['stated']:>10.3f}{row['right']:>10.3f}"
        )


def draw_reliability(tables: dict[str, list[dict[str, float]]], file: Path) -> None:
    """Draw stated probabilities against the share that was right."""
    figure = new_figure(4.4, 4.4)
    axes = figure.add_subplot()
    axes.plot([0, 1], [0, 1], color=BODY, linewidth=1, label="as stated")
    for (name, rows), colour in zip(tables.items(), LINES, strict=False):
        right = np.array([row["right"] for row in rows])
        width = INTERVAL * np.sqrt(right * (1 - right) / [row["count"] for row in rows])
        stated = [row["stated"] for row in rows]
        axes.errorbar(stated, right, yerr=width, marker="o", color=colour, label=name, capsize=2)
    axes.set_xlabel("probability stated")
    axes.set_ylabel("share that was right")
    axes.set_aspect("equal")
    axes.legend(frameon=False)
    figure.savefig(file)


def ambiguity(plan: Plan) -> list[dict[str, Any]]:
    """How often a motion was said to determine the class, by motion and constraint; at a noise of 0.1 mm."""
    rows = []
    ambiguous = [(label, "paper") for label in AMBIGUOUS]
    for label, motion in ambiguous + [(label, plan.motion) for label in plan.labels]:
        poses = np.asarray(recordings(label, motion, 1e-4, 0.0, plan.windows).poses)
        tested = rf.excitation(rf.identify(poses, dt=DT), poses, dt=DT)
        shares = {
            name: float(np.mean(getattr(tested, name))) for name in ("determined", "one_path", "steady")
        }
        rows.append({"constraint": label, "motion": motion, **shares})
    return rows


def show_ambiguity(rows: list[dict[str, Any]]) -> None:
    """Print the table of :func:`ambiguity`."""
    print("\nShare of windows whose motion is said to determine the class, to be one path, or to be steady")
    print(f"{'':4}{'motion':10}{'determined':>12}{'one path':>10}{'steady':>10}")
    for row in rows:
        shares = f"{row['determined']:>12.1%}{row['one_path']:>10.1%}{row['steady']:>10.1%}"
        print(f"{row['constraint']:4}{row['motion']:10}{shares}")


def report(plan: Plan, picture: Path | None) -> dict[str, Any]:
    """Run and print everything; returns the record for --json."""
    rows, said = [], []
    for sigma in plan.sigmas:
        for label in plan.labels:
            say(f"{label} at {sigma:g} m")
            row, probabilities = coverage_of(label, sigma, plan)
            rows.append(row)
            said.append(probabilities)
    show_coverage(rows)
    tables = {"name": reliability(said, "name"), "free axis": reliability(said, "free")}
    show_reliability(tables["name"], "Probability of the name, and how often it was right")
    show_reliability(tables["free axis"], "Probability that an axis is free, and how often it was")
    if picture is not None:
        draw_reliability(tables, picture)
    motions = ambiguity(plan)
    show_ambiguity(motions)
    covered = [row[f"{name}_coverage"] for row in rows for name in QUANTITIES]
    covered = [value for value in covered if value is not None]
    print(f"\ncoverage: {min(covered):.1%} to {max(covered):.1%}, mean {np.mean(covered):.1%}")
    return {"machine": machine(), "coverage": rows, "reliability": tables, "ambiguity": motions}


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the benchmark."""
    parser = plan_parser("uncertainty", __doc__, quick="a few minutes: two noise levels, few windows")
    add = parser.add_argument
    add("--motion", choices=["exciting", "hand", "sine", "slow", "reach"], help="of the windows")
    add("--windows", type=int, help="of every constraint and noise level")
    add("--slow", type=float, help="m, standard deviation of an error that changes slowly")
    add("--errors", choices=["measured", "white"], help="of the covariance; see reframe_jax.covariance")
    add("--plot", type=Path, help="file of the reliability diagram")
    options = parser.parse_args(argv)
    plan = chosen_plan(options, Plan(), QUICK)
    jax.config.update("jax_enable_x64", True)
    print(f"{plan.motion} motion, covariance from {plan.errors} errors; {machine()}")
    write_record(options.json, report(plan, options.plot))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

"""Test the reported uncertainty: coverage of intervals, reliability of probabilities, and ambiguous motions.

- Coverage: the fraction of 95 % intervals of the covariance that contain the truth, over all determined
  directions of axes and origin, by constraint and noise level. Also the RMS of error over standard deviation,
  without the largest 1 %. Only windows with the right class and a valid first-order covariance
  (``first_order``) count; their coverage should be 92 to 98 %. A second line has the windows without a valid
  first-order covariance.
- Reliability: the probabilities of names, classes, types and free axes, averaged in bins, and the fraction
  that was right. --plot draws a diagram.
- Ambiguous motions: how often ``excitation`` reports that the motion does not determine the constraint, for
  ambiguous motions and for exciting ones.

Windows of 5 s at 20 Hz with random geometry, measured with noise whose ratio of rad to m is 3. Run in parts
by --constraints or --sigmas with --json; --join prints the tables of several parts.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import reframe_jax as rf
from benchmarks.common import chosen_plan, machine, plan_parser, read_parts, write_record
from benchmarks.motions import random_motion
from benchmarks.uncertainty_reliability import (
    KINDS,
    Said,
    draw_reliability,
    merge_tables,
    print_reliability,
    probabilities_of,
    reliability,
)
from reframe_jax.constraints.catalogue import lookup
from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.types import ORIENTATION_BODIES, POSITION_BODIES, AngularType
from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.identification.certainty import Covariance
from reframe_jax.simulation.metrics import dof_correct, types_correct
from reframe_jax.simulation.motions import PoseErrors, disturb
from reframe_jax.simulation.synthetic import Excitation, Simulation
from reframe_jax.uncertainty.covariance import Errors, Method

__all__ = ["standard_scores"]

SAMPLES, DT = 100, 0.05
INTERVAL = 1.96  # standard deviations of a 95 % interval
_LEAST = 1e-12  # fraction of the largest variance below which a variance counts as zero
_TRIMMED = 0.99  # fraction of the scores in the RMS
_ENOUGH = 20  # fewest scores for a fraction
QUANTITIES = "angular", "linear", "position"


@dataclass(frozen=True)
class Plan:
    """Size of a run: ``windows`` per constraint and noise level."""

    labels: tuple[str, ...] = tuple(rf.CONSTRAINTS)
    motion: str = "exciting"
    sigmas: tuple[float, ...] = (1e-5, 1e-4, 1e-3, 3e-3, 1e-2)
    windows: int = 1000
    slow: float = 0.0
    errors: Errors = "measured"
    method: Method = "derivative"


QUICK = Plan(sigmas=(1e-4, 1e-3), windows=32)


def print_progress(text: str) -> None:
    """Print progress to standard error."""
    print(text, file=sys.stderr, flush=True)


def recordings(label: str, motion: str | Excitation, count: int) -> Simulation:
    """Exact motions of a constraint, the same for every noise level."""

    def of_key(key: jax.Array) -> Simulation:
        return random_motion(label, key, samples=SAMPLES, dt=DT, excitation=motion)

    return jax.vmap(of_key)(jax.random.split(jax.random.key(2025), count))


def measured(made: Simulation, sigma: float, slow: float) -> np.ndarray:
    """Add the errors of a tracker to the poses (N, K+1, 4, 4) of exact motions."""
    keys = jax.random.split(jax.random.key(7), len(made.exact_poses))
    return np.asarray(_disturb(made.exact_poses, keys, PoseErrors(sigma=sigma, slow=slow)))


@jax.jit
def _disturb(poses: jax.Array, keys: jax.Array, errors: PoseErrors) -> jax.Array:
    return jax.vmap(lambda pose, key: disturb(pose, key, errors, DT))(poses, keys)


def standard_scores(
    found: rf.Identification, covariance: Covariance, truth: ConstraintFrame, start: np.ndarray
) -> dict[str, np.ndarray]:
    """Errors of N windows divided by their standard deviations, along the principal axes of the covariance.

    Args:
        found: identifications of N windows, with the right class.
        covariance: covariance of ``found``.
        truth: true constraint with N geometries; one of the twelve, with the axes of
            :meth:`ConstraintFrame.named`.
        start: (N, 4, 4) m, first true poses, at which the angular and linear axes agree.

    Returns:
        (N, 3) scores of "angular" and "linear" axes, if the class determines an axis, and of the "position";
        NaN along directions without a variance.
    """
    matrix = np.asarray(covariance.matrix)
    entry = lookup(truth.linear_type, truth.angular_dof, truth.linear_dof)
    assert entry is not None
    turn, shift = np.asarray(start)[:, :3, :3], np.asarray(start)[:, :3, 3]

    def seen(axes: np.ndarray, fixed_in: int, wanted: np.ndarray) -> np.ndarray:
        """Express axes (N, 3, n) of one body in the other body, at the start."""
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
            ORIENTATION_BODIES[np.asarray(found.linear.type_code)],
        ),
    ):
        if odd is None:
            continue
        true = seen(frame_axes[:, :, odd : odd + 1], fixed_in, own)[:, :, 0]
        axis = np.asarray(rotation_exp(part.rotvec))[:, :, 2 if sum(dof) == 1 else 0]
        axis = axis * np.sign(np.sum(axis * true, axis=1))[:, None]
        block = slice(0, 3) if name == "angular" else slice(3, 6)
        scores[name] = _scores(np.cross(true, axis), matrix[:, block, block])
    body = POSITION_BODIES[np.asarray(found.linear.type_code)]
    point = np.asarray(truth.position)
    if truth.linear_type.position_body == AngularType.B:
        point = (turn @ point[:, :, None])[:, :, 0] + shift
    in_body = (turn.mT @ (point - shift)[:, :, None])[:, :, 0]
    error = np.asarray(found.linear.position) - np.where((body == AngularType.B)[:, None], in_body, point)
    projector = np.asarray(found.linear.free_position)
    free = [i for i in range(3) if not entry.position[i]]
    if free:  # shift the truth along its free directions, so that the error is normal to the estimated ones
        along = seen(frame_axes[:, :, free], fixed_in, body)
        amount = np.linalg.pinv(projector @ along, rcond=1e-3) @ projector @ error[:, :, None]
        error = error - (along @ amount)[:, :, 0]
    error = error - (projector @ error[:, :, None])[:, :, 0]
    scores["position"] = _scores(error, matrix[:, 6:9, 6:9])
    return scores


def _scores(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Errors (N, 3) divided by standard deviations, along the eigenvectors of the covariance (N, 3, 3)."""
    variances, directions = np.linalg.eigh(covariance)
    along = (error[:, None] @ directions)[:, 0]
    known = variances > _LEAST * np.maximum(variances[:, -1:], np.finfo(float).tiny)
    return np.where(known & (variances > 1e-24), along / np.sqrt(np.where(known, variances, 1)), np.nan)


def coverage_of(label: str, made: Simulation, sigma: float, plan: Plan) -> tuple[dict[str, Any], Said]:
    """One row of the coverage table, and the data for the reliability of probabilities."""
    poses = measured(made, sigma, plan.slow)
    found = rf.identify(poses, dt=DT)
    covariance = rf.covariance(found, poses, dt=DT, errors=plan.errors, method=plan.method)
    usable = np.asarray(found.status_code) == 0
    right = usable & np.asarray(types_correct(found, made.truth) & dof_correct(found, made.truth))
    small = np.asarray(covariance.first_order)
    scores = standard_scores(found, covariance, made.truth, np.asarray(made.exact_poses[:, 0]))
    row: dict[str, Any] = {"constraint": label, "sigma": sigma, "windows": plan.windows}
    row |= {"right": float(np.mean(right)), "first_order": float(np.mean(small[right]))}
    row |= {"inside": _summary(scores, right & small), "outside": _summary(scores, right & ~small)}
    return row, probabilities_of(found, made, rf.constraint(label).name)


def _summary(scores: dict[str, np.ndarray], counted: np.ndarray) -> dict[str, tuple[float, float]]:
    """Coverage and RMS of the scores of some windows, if there are enough scores."""
    summary = {}
    for name, values in scores.items():
        sizes = np.abs(values[counted])
        sizes = np.sort(sizes[np.isfinite(sizes)])
        if len(sizes) >= _ENOUGH:
            rms = float(np.sqrt(np.mean(sizes[: int(_TRIMMED * len(sizes))] ** 2)))
            summary[name] = float(np.mean(sizes < INTERVAL)), rms
    return summary


def print_coverage(rows: list[dict[str, Any]]) -> None:
    """Print coverage and RMS of scores, by constraint and noise level."""
    print("\nFraction of 95 % intervals that contain the truth, and RMS of error over standard deviation")
    print(f"{'':4}{'sigma, m':>10}{'right':>8}{'small':>8}" + "".join(f"{name:>18}" for name in QUANTITIES))
    for row in rows:
        first = f"{row['constraint']:4}{row['sigma']:>10.0e}{row['right']:>8.1%}"
        for part, fraction in (("inside", row["first_order"]), ("outside", 1 - row["first_order"])):
            if row[part]:
                print(
                    first + f"{fraction:>8.1%}" + "".join(_cell(row[part].get(name)) for name in QUANTITIES)
                )
            first = f"{'noise too large':>22}"
    covered = [row["inside"][name][0] for row in rows for name in row["inside"]]
    print(f"\ncoverage: {min(covered):.1%} to {max(covered):.1%}, mean {np.mean(covered):.1%}")


def _cell(summary: Sequence[float] | None) -> str:
    return f"{'-':>18}" if summary is None else f"{summary[0]:>12.1%}{summary[1]:>6.2f}"


def straight(t: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Translation along one line, without rotation."""
    return jnp.zeros(3), jnp.asarray([0.0, 0.15, 0.0]) * jnp.sin(1.3 * t)


def turning(t: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Rotation about one axis, without translation."""
    return jnp.asarray([0.0, 0.7, 0.0]) * jnp.sin(1.3 * t), jnp.zeros(3)


def without_spin(t: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Two rotations and two translations, without the third rotation."""
    rates = jnp.asarray([1.1, 1.9, 1.0])
    turn = jnp.asarray([0.6, 0.6, 0.0]) * jnp.sin(rates * t)
    return turn, 0.15 * jnp.sin(1.2 * rates * t + 1.0)


AMBIGUOUS: tuple[tuple[str, str, str | Excitation], ...] = (
    *((label, "paper", "paper") for label in "EFGIJ"),
    ("K", "straight line", straight),
    ("L", "straight line", straight),
    ("K", "one rotation", turning),
    ("L", "one rotation", turning),
    ("K", "no spin", without_spin),
)


def ambiguity(plan: Plan) -> list[dict[str, Any]]:
    """How often a motion is reported to determine the class, by motion and constraint, at 0.1 mm of noise."""
    rows = []
    exciting = [(label, plan.motion, plan.motion) for label in plan.labels]
    for label, name, motion in [each for each in AMBIGUOUS if each[0] in plan.labels] + exciting:
        poses = measured(recordings(label, motion, plan.windows), 1e-4, 0.0)
        tested = rf.excitation(rf.identify(poses, dt=DT), poses, dt=DT)
        shares = {
            name: float(np.mean(getattr(tested, name))) for name in ("determined", "one_path", "steady")
        }
        rows.append({"constraint": label, "motion": name, **shares})
    return rows


def print_ambiguity(rows: list[dict[str, Any]]) -> None:
    """Print the table of :func:`ambiguity`."""
    print("\nFraction of motions reported to determine the constraint, to be one path, or to be steady")
    print(f"{'':4}{'motion':15}{'determined':>12}{'one path':>10}{'steady':>10}")
    for row in rows:
        shares = f"{row['determined']:>12.1%}{row['one_path']:>10.1%}{row['steady']:>10.1%}"
        print(f"{row['constraint']:4}{row['motion']:15}{shares}")


def run(plan: Plan) -> dict[str, Any]:
    """Compute the data of all tables."""
    rows, said = [], []
    for label in plan.labels:
        made = recordings(label, plan.motion, plan.windows)
        for sigma in plan.sigmas:
            print_progress(f"{label} at {sigma:g} m")
            row, probabilities = coverage_of(label, made, sigma, plan)
            rows.append(row)
            said.append(probabilities)
    tables = {kind: reliability(said, kind) for kind in KINDS}
    return {"machine": machine(), "coverage": rows, "reliability": tables, "ambiguity": ambiguity(plan)}


def joined(parts: list[dict[str, Any]]) -> dict[str, Any]:
    """Join the records of several runs."""
    tables = {kind: merge_tables([part["reliability"][kind] for part in parts]) for kind in KINDS}
    both = {key: [row for part in parts for row in part[key]] for key in ("coverage", "ambiguity")}
    return {"machine": parts[0]["machine"], **both, "reliability": tables}


def print_report(record: dict[str, Any], picture: Path | None) -> None:
    """Print the tables, and draw the diagram if a file is given."""
    print_coverage(sorted(record["coverage"], key=lambda row: (row["sigma"], row["constraint"])))
    print_reliability(record["reliability"])
    print_ambiguity(record["ambiguity"])
    if picture is not None:
        draw_reliability(record["reliability"], picture)


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the benchmark."""
    parser = plan_parser("uncertainty", __doc__, quick="a few minutes: two noise levels, few windows")
    add = parser.add_argument
    add("--motion", choices=["exciting", "hand", "sine", "slow", "reach"], help="excitation of the windows")
    add("--windows", type=int, help="windows per constraint and noise level")
    add("--slow", type=float, help="m, standard deviation of slow errors (drift)")
    add("--errors", choices=["measured", "white"], help="option errors of reframe_jax.covariance")
    add("--method", choices=["derivative", "bootstrap"], help="option method of reframe_jax.covariance")
    add("--plot", type=Path, help="file of the reliability diagram")
    options = parser.parse_args(argv)
    plan = chosen_plan(options, Plan(), QUICK)
    jax.config.update("jax_enable_x64", True)
    parts = read_parts(options)
    record = joined(parts) if parts else run(plan)
    how = f"{plan.errors} errors" if plan.method == "derivative" else "a bootstrap"
    print(f"{plan.motion} motion, covariance from {how}; {record['machine']}")
    print_report(record, options.plot)
    write_record(options.json, record)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

"""Degrees of freedom against the displacement along the weakest free axis.

The windows are those of :mod:`benchmarks.noise` with free translations, if the motion determines the degrees
of freedom (see :mod:`benchmarks.determined`: the displacement along each free axis is at least ten times the
noise). Drift of a tracker also causes displacements: the origins of recorded hinges move along constrained
axes by up to a tenth of the displacement of the body. The windows are therefore grouped by the ratio of the
displacement along the weakest free axis to the displacement of the body, and wrong results are listed.
Displacements are standard deviations over the window; the displacement of the body refers to its measured
position.
"""

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import reframe_jax as rf
from benchmarks.common import chosen_plan, machine, plan_parser, read_parts, write_record
from benchmarks.determined import distances
from benchmarks.fits import Windows, scores
from benchmarks.noise import Plan, make, print_progress

PLAN = Plan(labels=tuple("DEFGHIJKL"), sigmas=(1e-6, 1e-5, 1e-4, 1e-3), rates=(10, 100))
QUICK = Plan(labels=("D", "K"), motions=("slow",), sigmas=(1e-5,), rates=(10,), windows=2)
EDGES = 0.0, 0.01, 0.03, 0.1, 0.3, np.inf  # edges of the groups of ratios
CONFIDENT = 0.9


@dataclass(frozen=True)
class Window:
    """A window, the displacement along its weakest free axis, and its identification."""

    constraint: str
    motion: str
    rate: float
    sigma: float
    displacement_mm: float
    noises: float
    ratio: float
    right: bool
    name: str
    probability: float


def judge(windows: Windows, where: dict[str, np.ndarray]) -> list[Window]:
    """Identify the windows of one constraint and rate."""
    assert windows.frame.linear_type is not None
    found, kind = rf.identify(windows.poses, dt=windows.dt), int(windows.frame.linear_type)
    candidates = found.candidates
    rotvecs = jnp.asarray(candidates.angular.rotvec), jnp.asarray(candidates.linear.rotvec)
    exact = jnp.asarray(windows.exact)
    _, moves, levers = distances(exact, windows.dt, rotvecs, jnp.asarray(candidates.linear.position))
    free = sum(rf.CONSTRAINTS[windows.label].linear_dof)
    weakest = np.sort(np.asarray(moves)[:, kind], axis=1)[:, 3 - free]
    noise = where["sigma"] * np.hypot(1, where["ratio"] * np.asarray(levers)[:, kind])
    body = np.sqrt(np.sum(np.var(windows.exact[:, :, :3, 3], axis=1), axis=1))
    right = scores(found, windows).right["dof"]
    return [
        Window(
            windows.label,
            str(where["motion"][i]),
            float(where["rate"][i]),
            float(where["sigma"][i]),
            1e3 * float(weakest[i]),
            float(weakest[i] / noise[i]),
            float(weakest[i] / body[i]),
            bool(right[i]),
            str(found.name[i]),
            float(found.probability[i]),
        )
        for i in np.flatnonzero(windows.determination.dof)
    ]


def run(plan: Plan) -> list[Window]:
    """Run all windows of a plan whose motion determines the degrees of freedom."""
    rows = []
    for rate in plan.rates:
        for windows, where in make(plan, rate):
            print_progress(f"{rate:g} Hz: {windows.label}, {len(windows.poses)} windows")
            rows += judge(windows, where)
    return rows


def print_table(rows: list[Window]) -> dict[str, float]:
    """Print the groups and the wrong windows; return the metrics."""
    print("weakest free axis over body      windows   right   wrong with p >= 0.9")
    metrics: dict[str, float] = {"windows": len(rows), "right": _fraction_right(rows)}
    for low, high in pairwise(EDGES):
        group = [row for row in rows if low <= row.ratio < high]
        confident_wrong = sum(not row.right and row.probability >= CONFIDENT for row in group)
        name = f"{low:g} to {high:g}" if np.isfinite(high) else f"from {low:g}"
        percent = f"{100 * _fraction_right(group):.1f} %" if group else "-"
        print(f"{name:<32}{len(group):>7}{percent:>9}{confident_wrong:>14}")
        metrics[f"right_from_{low:g}"] = _fraction_right(group)
    print(f"{'all':<32}{len(rows):>7}{100 * _fraction_right(rows):>7.1f} %")
    print()
    wrong = sorted((row for row in rows if not row.right), key=lambda row: row.ratio)
    metrics["sure_and_wrong"] = sum(row.probability >= CONFIDENT for row in wrong)
    for row in wrong:
        print(
            f"{row.constraint} {row.motion}, {row.rate:g} Hz, {row.sigma:g} m: {row.displacement_mm:.2f} mm, "
            f"{row.noises:.0f} x noise, {row.ratio:.3f} x body: {row.name} ({row.probability:.2f})"
        )
    return metrics


def _fraction_right(rows: list[Window]) -> float:
    return float(np.mean([row.right for row in rows])) if rows else float("nan")


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the benchmark."""
    options = plan_parser("weak_axes", __doc__, quick="a few windows").parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    parts = read_parts(options)
    print(parts[0]["machine"] if parts else machine())
    rows = [Window(**window) for part in parts for window in part["windows"]]
    rows = rows or run(chosen_plan(options, PLAN, QUICK))
    record: dict[str, Any] = {"machine": machine(), "metrics": print_table(rows)}
    write_record(options.json, record | {"windows": [asdict(row) for row in rows]})
    return 0


if __name__ == "__main__":
    sys.exit(main())

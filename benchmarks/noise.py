"""Errors against noise and sampling rate for every constraint and motion, compared with the Cramér-Rao bound.

The windows last 5 s, with all twelve constraints, random geometry, several motions and several sampling
rates. The noise is white; --errors adds other errors. The motion is the same at every rate and noise level.
The methods are:

- ``identify``, and ``scales=1``: ``identify`` with differences of consecutive poses, as in the paper;
- ``dual annealing``: SciPy's on the paper's objective, for a few windows of the first rate, because each
  window takes half a second or more;
- ``circle fit``, ``line fit``, ``pivot``, ``mean screw``: fits of a line, for A, B and C.

Errors are errors of the determined axes and components of the position. Each error has three columns: the
median, the RMS, and, after an x, the median ratio to the bound of the window. An efficient estimate has a
ratio of 0.7 (one unknown) to 0.9 (three unknowns). The bounds of E to H are bounds for consecutive poses; see
:mod:`benchmarks.bounds`. Quantities with a bound above 0.2 rad or 0.1 m are left out.

The column "known" is the fraction of windows whose motion determines the degrees of freedom (see
:mod:`benchmarks.determined`). For these windows, the next columns are the fractions of right types (ties
count as right), right degrees of freedom, and right names (only if the motion also determines the type). The
column "wrong" is the fraction of these windows with a wrong name and a probability of 0.9 or more.
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import reframe_jax as rf
from benchmarks.bounds import cramer_rao
from benchmarks.common import chosen_plan, machine, plan_parser, read_parts, write_record
from benchmarks.determined import determined
from benchmarks.fits import LINE_FITS, QUANTITIES, Scores, Windows, anneal, line_scores, scores
from benchmarks.motions import random_motion
from benchmarks.timing import timed
from reframe_jax.simulation.motions import PoseErrors
from reframe_jax.simulation.synthetic import EXCITATIONS

DURATION = 5.0  # s
RATIOS = 1.0, 20.0  # rad/m, range of the ratio of rotation noise to position noise
# settings by name, with the headings of their columns
SHARES = {
    "determined": "determined",
    "types": "types_right",
    "dof": "dof_right",
    "name": "name_right",
    "confident_wrong": "confident_wrong",
}
MEANINGLESS = {
    "angular": 0.2,
    "linear": 0.2,
    "position": 0.1,
}  # rad and m: quantities with a larger bound are left out
UNITS = {"angular": np.degrees(1.0), "linear": np.degrees(1.0), "position": 1e3}
ERRORS = {
    "white": PoseErrors(),
    "outliers": PoseErrors(outliers=0.01),
    "slow": PoseErrors(slow=1e-3),
    "rounded": PoseErrors(rounding=1e-3),
}


@dataclass(frozen=True)
class Plan:
    """Size of a run: ``windows`` per constraint, motion, noise level and rate."""

    labels: tuple[str, ...] = tuple(rf.CONSTRAINTS)
    motions: tuple[str, ...] = tuple(EXCITATIONS)
    sigmas: tuple[float, ...] = (1e-6, 1e-5, 1e-4, 1e-3, 3e-3)
    rates: tuple[float, ...] = (10, 30, 100, 300)
    windows: int = 4
    annealed: int = 5
    errors: str = "white"


QUICK = Plan(motions=("hand",), sigmas=(1e-4, 1e-3), rates=(10, 40), windows=2, annealed=1)


@dataclass
class Table:
    """Scores of all windows in columns; a row is the result of one method for one window."""

    columns: dict[str, list[np.ndarray]] = field(default_factory=dict)

    def add(self, contestant: str, where: dict[str, np.ndarray], scored: Scores) -> None:
        """Append the rows of one method, with the settings of every window."""
        count = len(where["rate"])
        blank = np.full(count, np.nan)
        row = {"contestant": np.full(count, contestant, dtype=object), **where}
        for name in QUANTITIES:
            known = scored.bounds[name] < MEANINGLESS[name]
            row[name] = np.where(known, scored.errors[name], np.nan)
            row[f"{name}_bound"] = np.where(
                known & np.isfinite(scored.errors[name]), scored.bounds[name], np.nan
            )
        for name, column in SHARES.items():
            row[column] = np.asarray(scored.right.get(name, blank), dtype=float)
        for name, values in row.items():
            self.columns.setdefault(name, []).append(values)

    def joined(self) -> dict[str, np.ndarray]:
        """Concatenate all rows to columns (n,)."""
        return {name: np.concatenate(parts) for name, parts in self.columns.items()}


def print_progress(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def make(plan: Plan, rate: float) -> Iterator[tuple[Windows, dict[str, np.ndarray]]]:
    """Simulate the windows of every constraint at one rate, and list their settings."""
    samples, dt = round(DURATION * rate), 1 / rate
    keys = jax.random.split(jax.random.key(2025), plan.windows)
    ratio_keys = jax.vmap(partial(jax.random.fold_in, data=1))(keys)
    low, high = RATIOS
    ratios = low * (high / low) ** jax.vmap(partial(jax.random.uniform, dtype=float))(ratio_keys)
    sigmas = jnp.asarray(plan.sigmas)
    each = [
        jnp.tile(jnp.arange(plan.windows), len(sigmas)),
        jnp.repeat(jnp.arange(len(sigmas)), plan.windows),
    ]
    sigma, ratio = sigmas[each[1]], ratios[each[0]]

    def of_key(label: str, motion: str, key: jax.Array, sigma: jax.Array, ratio: jax.Array) -> Any:
        errors = replace(ERRORS[plan.errors], sigma=sigma, rotation_ratio=ratio)
        return random_motion(label, key, samples=samples, dt=dt, excitation=motion, errors=errors)

    for label in plan.labels:
        parts = []
        for i, motion in enumerate(plan.motions):
            own = jax.vmap(partial(jax.random.fold_in, data=i))(keys)[each[0]]
            parts.append(jax.vmap(partial(of_key, label, motion))(own, sigma, ratio))
        made = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
        where = {
            "constraint": np.full(len(made.poses), label, dtype=object),
            "motion": np.repeat(np.array(plan.motions, dtype=object), len(sigma)),
            "sigma": np.tile(sigma, len(plan.motions)),
            "ratio": np.tile(ratio, len(plan.motions)),
            "rate": np.full(len(made.poses), float(rate)),
        }
        bound = cramer_rao(made.truth, made.exact_poses, where["sigma"], where["ratio"])
        exact = np.asarray(made.exact_poses)
        poses = np.asarray(made.poses)
        determination = determined(label, made.truth, exact, poses, dt, where["sigma"], where["ratio"])
        yield Windows(label, made.truth, poses, exact, dt, bound, determination), where


def run(plan: Plan) -> tuple[dict[str, np.ndarray], list[dict[str, Any]]]:
    """Run all rates: the table, and the run time of every method at every rate."""
    table, times = Table(), []
    for rate in plan.rates:
        groups = list(make(plan, rate))
        poses = np.concatenate([windows.poses for windows, _ in groups])
        print_progress(f"{rate:g} Hz: {len(poses)} windows of {poses.shape[1] - 1} steps")
        found, seconds, compiling = timed(partial(rf.identify, poses, dt=1 / rate), 1)
        times.append(_time(rate, "identify", len(poses), seconds, compiling))
        _score(table, "identify", found, groups)
        by_one, seconds, compiling = timed(partial(rf.identify, poses, dt=1 / rate, scales=1), 1)
        times.append(_time(rate, "scales=1", len(poses), seconds, compiling))
        _score(table, "scales=1", by_one, groups)
        for name, (labels, fit) in LINE_FITS.items():
            for windows, where in groups:
                if windows.label in labels:
                    table.add(name, where, line_scores(fit(windows.poses), windows))
        if plan.annealed and rate == plan.rates[0]:
            times.append(_anneal_some(table, plan, found, groups))
    return table.joined(), times


def _time(rate: float, name: str, windows: int, seconds: float, compiling: float) -> dict[str, Any]:
    print_progress(
        f"{rate:g} Hz: {name}: {windows} windows in {seconds:.2f} s, compiled in {compiling:.1f} s"
    )
    return {"rate": rate, "contestant": name, "windows": windows, "seconds": seconds, "compile_s": compiling}


def _score(table: Table, name: str, found: rf.Identification, groups: list[Any]) -> None:
    start = 0
    for windows, where in groups:
        end = start + len(windows.poses)
        table.add(name, where, scores(found[start:end], windows))
        start = end


def _anneal_some(table: Table, plan: Plan, found: rf.Identification, groups: list[Any]) -> dict[str, Any]:
    """Run dual annealing on a few windows per constraint, spread over motions and noise levels."""
    start, total, count = 0, 0.0, 0
    for windows, where in groups:
        size = len(windows.poses)
        rows = np.unique(np.linspace(0, size - 1, min(plan.annealed, size)).astype(int))
        annealed, seconds = anneal(found[start + rows], windows[rows])
        some = {name: values[rows] for name, values in where.items()}
        scored = scores(annealed, windows[rows])
        scored.right.pop("confident_wrong")  # dual annealing gives no probability
        table.add("dual annealing", some, scored)
        start, total, count = start + size, total + seconds, count + len(rows)
    return _time(float(groups[0][1]["rate"][0]), "dual annealing", count, total, 0.0)


def summarise(table: dict[str, np.ndarray], by: Sequence[str]) -> list[dict[str, Any]]:
    """Summarize every method for every combination of some columns."""
    keys = list(zip(*(table[name] for name in (*by, "contestant")), strict=True))
    ranks = [
        {value: i for i, value in enumerate(dict.fromkeys(column))} for column in zip(*keys, strict=True)
    ]
    rows = []
    for key in sorted(set(keys), key=lambda key: [rank[x] for rank, x in zip(ranks, key, strict=True)]):
        here = np.array([k == key for k in keys])
        row: dict[str, Any] = dict(zip((*by, "contestant"), key, strict=True)) | {"windows": int(here.sum())}
        for name in QUANTITIES:
            errors, bounds = table[name][here], table[f"{name}_bound"][here]
            known, scale = np.isfinite(errors), UNITS[name]
            unit = "mm" if name == "position" else "deg"
            errors, bounds = errors[known], bounds[known]
            row |= {
                f"{name}_median_{unit}": scale * float(np.median(errors)) if known.any() else None,
                f"{name}_rms_{unit}": scale * float(np.sqrt(np.mean(errors**2))) if known.any() else None,
                f"{name}_bound_{unit}": scale * float(np.sqrt(np.mean(bounds**2))) if known.any() else None,
                f"{name}_ratio": float(np.median(errors / bounds)) if known.any() else None,
            }
        for column in SHARES.values():
            right = table[column][here]
            row[column] = None if np.isnan(right).all() else float(np.nanmean(right))
        rows.append(row)
    return rows


def print_table(rows: list[dict[str, Any]], by: str, title: str) -> None:
    """Print a table of figures."""
    print(f"\n{title}")
    heads = [f"{name + ', ' + unit:>25}" for name, unit in zip(QUANTITIES, ("deg", "deg", "mm"), strict=True)]
    print(f"{'':8}{'':15}{''.join(heads)}{'known':>8}{'types':>7}{'dof':>6}{'name':>6}{'wrong':>8}")
    last: Any = None
    for row in rows:
        value = row[by] if isinstance(row[by], str) else f"{row[by]:g}"
        print(f"{value if value != last else '':8}{row['contestant']:15}", end="")
        last = value
        for name, unit in zip(QUANTITIES, ("deg", "deg", "mm"), strict=True):
            figures = [row[f"{name}_{kind}"] for kind in (f"median_{unit}", f"rms_{unit}", "ratio")]
            median, rms, ratio = ("-" if x is None else f"{x:.2g}" for x in figures)
            print(f"{median:>8}{rms:>8}{'x' + ratio:>9}" if median != "-" else f"{'-':>25}", end="")
        shares = [row[column] for column in SHARES.values()]
        print(
            "".join(
                f"{'-' if s is None else f'{s:.0%}':>{w}}"
                for s, w in zip(shares, (8, 7, 6, 6, 8), strict=True)
            )
        )


def slopes(rows: list[dict[str, Any]], by: str) -> dict[str, float]:
    """Slope of the log median error of ``identify`` against the log of a setting."""
    mine = [row for row in rows if row["contestant"] == "identify"]
    found = {}
    for name in QUANTITIES:
        column = f"{name}_median_{'mm' if name == 'position' else 'deg'}"
        points = np.log([(row[by], row[column]) for row in mine if row[column]])
        if len(points) > 1:
            found[f"{name}_slope_by_{by}"] = float(np.polyfit(points[:, 0], points[:, 1], 1)[0])
    return found


def report(plan: Plan, table: dict[str, np.ndarray], times: list[dict[str, Any]]) -> dict[str, Any]:
    """Print the tables; return the record for --json."""
    by_constraint = summarise(table, ["constraint"])
    print_constraints(by_constraint)
    if len(plan.motions) > 1:
        print_table(summarise(table, ["motion"]), "motion", "By motion")
    by_sigma, by_rate = summarise(table, ["sigma"]), summarise(table, ["rate"])
    print_table(by_sigma, "sigma", "By standard deviation of the position noise, m")
    print_table(by_rate, "rate", "By sampling rate, Hz: the motion is the same")
    metrics = slopes(by_sigma, "sigma") | slopes(by_rate, "rate")
    print("\nSlope of log median error of identify, where the bound has 1 by noise and -0.5 by rate")
    for name, slope in metrics.items():
        print(f"{name.replace('_', ' '):28}{slope:>8.2f}")
    print(f"\n{'':8}{'':15}{'windows':>9}{'seconds':>10}{'compile':>10}")
    for row in times:
        print(
            f"{row['rate']:<8g}{row['contestant']:15}{row['windows']:>9}{row['seconds']:>10.2f}{row['compile_s']:>10.1f}"
        )
    mine = table["contestant"] == "identify"
    metrics |= {column: float(np.nanmean(table[column][mine])) for column in SHARES.values()}
    rows = summarise(table, ["constraint", "motion", "sigma", "rate"])
    return {
        "machine": machine(),
        "metrics": metrics,
        "times": times,
        "constraints": by_constraint,
        "rows": rows,
    }


def print_constraints(rows: list[dict[str, Any]]) -> None:
    """Print the table of all constraints."""
    print_table(rows, "constraint", "By constraint, over all motions, noise levels and rates")


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the benchmark."""
    parser = plan_parser("noise", __doc__, quick="about a minute: one motion, two noise levels, two rates")
    add = parser.add_argument
    add("--motions", nargs="+", choices=list(EXCITATIONS), help="motions to run")
    add("--rates", nargs="+", type=float, help="sampling rates, Hz")
    add("--windows", type=int, help="windows per constraint, motion, noise level and rate")
    add("--annealed", type=int, help="windows per constraint to solve by dual annealing; 0: none")
    add(
        "--errors",
        choices=list(ERRORS),
        help="errors in addition to the white noise; the bound ignores these errors",
    )
    options = parser.parse_args(argv)
    if parts := read_parts(options):
        print(f"windows of {DURATION:g} s; {parts[0]['machine']}")
        print_constraints([row for part in parts for row in part["constraints"]])
        return 0
    plan = chosen_plan(options, Plan(), QUICK)
    jax.config.update("jax_enable_x64", True)
    print(f"windows of {DURATION:g} s, {plan.errors} noise; {machine()}")
    write_record(options.json, report(plan, *run(plan)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

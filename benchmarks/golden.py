"""Regression test of identification: names, probabilities, errors and coverage on many recordings.

    python -m benchmarks.golden --json NEW.json --compare benchmarks/results/golden.json
    python -m benchmarks.golden --group soft

Groups of recordings (:mod:`benchmarks.golden_cases` has the simulations):

- ``real``: the recordings in shared/data; circles and lines through the positions give the truth;
- ``white``: seventeen constraints with white noise of 1 um to 3 mm, at 10 and 100 Hz, three motions;
- ``soft``: the same constraints with slow errors of 0.1 to 3 mm and 0.5 to 10 mrad, at 20 Hz;
- ``repeatable``: the same with errors that depend on the pose only, as those of an arm with wrong lengths;
- ``correlated``: the same with errors that are correlated over some samples, at 50 Hz;
- ``planar``: a tracker of planar motion measures two coordinates and one angle;
- ``stages``: axes of rotation on two or three translations;
- ``frames``: the same, with the body's frame 1 m from where its errors act, or with inverse poses;
- ``stops``: the same constraints, with white noise or slow errors, moved in three parts with rests between;
- ``faults``: the same constraints, with white noise and poses that jump, repeat or are missing;
- ``nothing``: unconstrained motions with white noise or slow errors;
- ``paper``: the twelve constraints of the paper, identified with ``scales=1`` and its thresholds;
- ``arm``: demonstrations on the simulated arm, only with ``--arm``.

A name is right if it is the name of the constraint, and if the linear type is correct for constraints with a
single type. A recording is strong if its free motion is large compared with the errors: the RMS along each
principal axis exceeds 20 times the slow errors, or both 10 times the white noise and 2 mm or 5 mrad. (The
axes are those of the free rotations, and of the free translations without the part proportional to the
rotations.) Errors (median, 90 %) include right names only. ``axis`` is the larger error of the angular and
the linear axis; ``position`` of a hinge is the distance of the axes at the point nearest to the motion.
``inside`` is the fraction of 95 % regions of ``rf.covariance`` that contain the true position, and the true
axes. Seconds are the run time of ``rf.identify``, with recordings on all processors at the same time.
"""

import json
import os
import sys
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import reframe_jax as rf
from benchmarks import golden_cases as made
from benchmarks.common import machine, new_parser
from benchmarks.golden_cases import CONSTRAINTS, Case

DATA = Path(os.environ.get("REFRAME_DATA", Path(__file__).parents[2] / "shared" / "data"))
GROUPS = ("real", *made.PLANS, "arm")
MARKS = {True: "right", False: "WRONG", None: "not scored"}
CONFIDENT, BINS = (
    0.9,
    (0.3, 0.5, 0.7, 0.9, 0.97, 0.99),
)  # probabilities; BINS are the bin edges of the calibration table
Row = dict[str, Any]

HINGE, SLIDE, PINS = "Revolute joint", "Prismatic joint", (CONSTRAINTS["K"].name, CONSTRAINTS["L"].name)
RECORDINGS: dict[str, tuple[str, tuple[str, ...]]] = {
    "kitchen_door": ("door", (HINGE,)),
    "champ_microwave": ("hinge", (HINGE,)),
    "champ_stapler": ("hinge", (HINGE,)),
    "hinge": ("hinge", (HINGE,)),
    "lost_": ("hinge", (HINGE,)),
    "kitchen_drawer": ("drawer", (SLIDE,)),
    "champ_drawer": ("drawer", (SLIDE,)),
    "contour": ("contour", (CONSTRAINTS["E"].name, "3 rotations, 1 translation in BB")),
    "pouring": ("free", (CONSTRAINTS["unconstrained"].name,)),
    "wiping": ("wiping", PINS),
    "grating": ("grating", ()),
    "tcp_touches": ("ball", (CONSTRAINTS["spherical"].name,)),
}
"""Moved object and right names or classes, by the start of the file name; grating has no name."""
MEASURED = {
    "hinge": ((0.00914, -0.00131, -0.99996), (-0.03309, -0.24509, -0.00055)),
    "lost_": ((0.0976, 0.1952, 0.9759), (0.5, 0.3, 0.2)),
}
"""Axes of hinges and points on them, m, in the ground."""
_WORKING = 2.0  # label of the phase with contact
_BEFORE, _AFTER = 0.6, 0.5  # s of that phase without contact: the tool comes down, and leaves
_COVERED = 100  # most poses of a simulated recording for the computation of a covariance


def real_cases(folder: Path) -> list[Case]:
    """Read the recordings of a folder and of its subfolder ``cases``."""
    cases = []
    files = sorted([*folder.glob("*.csv"), *folder.glob("cases/*.csv")])
    for file, start in [pair for pair in product(files, RECORDINGS) if pair[0].name.startswith(pair[1])]:
        label, names = RECORDINGS[start]
        if file.parent.name == "cases":  # as users read them, without the rows in which tracking was lost
            recording = rf.load_recording(file)
            poses, times = np.asarray(recording.poses), np.asarray(recording.times)
        table = np.loadtxt(file, delimiter=",", skiprows=1)
        if file.read_text().split("\n", 1)[0].endswith("label"):
            table = table[table[:, -1] == _WORKING]
            inside = table[:, 0] >= table[0, 0] + _BEFORE
            table = table[inside & (table[:, 0] <= table[-1, 0] - _AFTER)]
        if file.parent.name != "cases":
            poses = made.make_poses(Rotation.from_quat(table[:, 4:8]).as_matrix(), table[:, 1:4])
            times = table[:, 0]
        truth = made.no_truth()
        if start in MEASURED:
            truth = made.hinge_truth(np.array(MEASURED[start][0]), np.array(MEASURED[start][1]), poses)
        elif label == "door":
            truth = made.hinge_truth(*fit_axis(table[:, 1:4], circle=True), poses)
        elif label == "drawer":
            direction = made.in_both(fit_axis(table[:, 1:4], circle=False)[0], poses)
            truth = replace(truth, linear=direction)
        cases.append(Case(f"real/{file.stem}", "real", label, poses, times, names, truth))
    return cases


def fit_axis(positions: np.ndarray, *, circle: bool) -> tuple[np.ndarray, np.ndarray]:
    """Direction and point, m, of a robust circle axis or line through the positions."""
    middle = np.median(positions, axis=0)
    away = positions - middle
    basis = np.linalg.svd(away, full_matrices=False)[2]
    flat = away @ basis[:2].T
    design = np.column_stack([2 * flat, np.ones(len(flat))])
    centre = np.linalg.lstsq(design, np.sum(flat**2, axis=1), rcond=None)[0][:2] @ basis[:2]
    start = np.concatenate([basis[2], centre] if circle else [basis[0], np.zeros(3)])

    def miss(unknown: np.ndarray) -> np.ndarray:
        axis = unknown[:3] / np.linalg.norm(unknown[:3])
        along = (away - unknown[3:6]) @ axis
        across = away - unknown[3:6] - along[:, None] * axis
        radii = np.linalg.norm(across, axis=1)
        return np.concatenate([along, radii - unknown[6]]) if circle else across.ravel()

    start = np.append(start, np.median(np.linalg.norm(away - centre, axis=1)))
    found = least_squares(
        miss, start, loss="soft_l1", f_scale=3e-3
    ).x  # residuals above 3 mm have a lower weight
    return found[:3] / np.linalg.norm(found[:3]), middle + found[3:6]


# ---------- identification
def covariance_of(found: Any, poses: np.ndarray, **timing: Any) -> dict[str, np.ndarray]:
    """Covariance matrices (N, 3, 3) of the angular axes and linear axes, rad^2, and of the position, m^2."""
    covariance = rf.covariance(found, poses, **timing)
    parts = {
        "angular": covariance.angular_axes,
        "linear": covariance.linear_axes,
        "position": covariance.position,
    }
    return {name: np.asarray(matrix, dtype=float).reshape(-1, 3, 3) for name, matrix in parts.items()}


def run(cases: Sequence[Case]) -> tuple[dict[str, Row], dict[str, float], list[str]]:
    """Identify recordings, with equal lengths in one batch; return rows, seconds by group, and notes."""
    batches: dict[tuple[Any, ...], list[Case]] = {}
    for case in cases:
        alike = (case.key,) if case.group == "real" else (len(case.poses), case.times[1], case.paper_settings)
        batches.setdefault(alike, []).append(case)
    rows: dict[str, Row] = {}
    seconds, notes = dict.fromkeys([case.group for case in cases], 0.0), set()
    # most of the time is compilation, partly on one processor
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for batch, (found, spent, note) in zip(
            batches.values(), pool.map(_run_batch, batches.values()), strict=True
        ):
            rows |= found
            notes.add(note)
            for case in batch:
                seconds[case.group] += spent / len(batch)
    seconds = {group: round(spent, 1) for group, spent in seconds.items()}
    return {case.key: rows[case.key] for case in cases if case.key in rows}, seconds, sorted(notes - {""})


def _run_batch(batch: Sequence[Case]) -> tuple[dict[str, Row], float, str]:
    """Identify recordings of equal length; return rows, seconds, and a note."""
    first, single, start = batch[0], batch[0].group == "real", time.perf_counter()
    options: dict[str, Any] = {"times": first.times if single else np.array([case.times for case in batch])}
    paper: dict[str, Any] = {"scales": 1, "thresholds": rf.Thresholds()} if first.paper_settings else {}
    poses = first.poses if single else np.array([case.poses for case in batch])
    try:
        found = rf.identify(poses, **options, **paper)
    except ValueError as error:
        if not single:
            raise
        row = {"constraint": first.label, "name": f"No result: {error}", "strong": True}
        return {first.key: row | {"right": False if first.expected else None}}, 0.0, ""
    answers = read_answers(found)
    spent, note = time.perf_counter() - start, ""
    if not single:
        print(f"{len(batch)} recordings of {len(first.poses)} poses: {spent:.0f} s", file=sys.stderr)
    matrices: dict[str, np.ndarray] = {}
    scored = any(is_right(case, answer) for case, answer in zip(batch, answers, strict=True))
    if scored and not paper and (single or len(first.poses) <= _COVERED):
        try:
            matrices = covariance_of(found, poses, **options)
        except Exception as error:  # an error of the covariance must not stop the comparison of names
            note = f"No coverage: rf.covariance raised {type(error).__name__}: {error}"[:200]
    rows = {
        case.key: score(case, answers[i], {name: matrix[i] for name, matrix in matrices.items()})
        for i, case in enumerate(batch)
    }
    return rows, spent, note


def read_answers(found: Any) -> list[Row]:
    """Extract the compared results of each recording from an identification."""
    parts = {
        "name": np.asarray(found.name, dtype=object).reshape(-1),
        "p": np.asarray(found.probability, dtype=float).reshape(-1),
        "status": np.asarray(found.status, dtype=int).reshape(-1),
        "kind": np.asarray(found.linear.frame_type, dtype=int).reshape(-1),
        "angular_kind": np.asarray(found.angular.frame_type, dtype=int).reshape(-1),
        "point": np.asarray(found.linear.position, dtype=float).reshape(-1, 3),
    }
    for name, frame in (("angular", found.angular), ("linear", found.linear)):
        axes = np.asarray(frame.axes, dtype=float).reshape(-1, 3, 3)
        dof = np.asarray(frame.dof, dtype=int).reshape(-1, 3)
        count = dof.sum(axis=1)
        odd = np.argmax(
            dof == (count == 1)[:, None], axis=1
        )  # the single free axis, or the single constrained axis
        axis = np.take_along_axis(axes, odd[:, None, None], 2)[:, :, 0]
        parts[name] = np.where(np.isin(count, (1, 2))[:, None], axis, np.nan)
    return [dict(zip(parts, values, strict=True)) for values in zip(*parts.values(), strict=True)]


# ---------- scores
def is_right(case: Case, answer: Row) -> bool:
    """Whether the name is right, and the linear type of constraints with a single type."""
    kind, name = rf.LinearType(int(answer["kind"])).name, str(answer["name"])
    return name.removeprefix("Unnamed: ") in case.expected and made.unique_type(name) in (None, kind)


def score(case: Case, answer: Row, matrices: dict[str, np.ndarray]) -> Row:
    """Whether the name is right; for right names, the errors and whether 95 % regions contain the truth."""
    kind, right = rf.LinearType(int(answer["kind"])).name, is_right(case, answer)
    row: Row = {
        "constraint": case.label,
        "name": str(answer["name"]),
        "type": kind,
        "p": _digits(float(answer["p"]), 4),
        "status": int(answer["status"]),
        "strong": case.strong,
        "right": right if case.expected else None,
    }
    if not right:
        return row
    truth, inside, angles = case.truth, {}, []
    bodies = {"angular": int(answer["angular_kind"]), "linear": "GB".index(kind[0])}
    for part, of_both in (("angular", truth.angular), ("linear", truth.linear)):
        true = of_both[bodies[part]]
        turn = np.cross(true, answer[part] * np.sign(answer[part] @ true))
        if np.isfinite(turn).all():
            angles.append(float(np.degrees(np.arctan2(np.linalg.norm(turn), abs(true @ answer[part])))))
            inside[part] = is_inside(turn, np.eye(3) - np.outer(true, true), matrices.get(part))
    body = "GB".index(kind[1])
    error, directions = answer["point"] - truth.point[body], truth.directions[body]
    if np.isfinite(directions @ error).all():
        inside["position"] = is_inside(directions @ error, directions, matrices.get("position"))
        if truth.line:
            axis = answer["angular"]
            if body != bodies["angular"]:
                turns = case.poses[:, :3, :3] if body == made.GROUND else case.poses[:, :3, :3].mT
                axis = np.median(turns @ axis, axis=0)
            directions = np.eye(3) - np.outer(axis, axis) / (axis @ axis)
        row["position_mm"] = _digits(1e3 * float(np.linalg.norm(directions @ error)))
    row |= {"axis_deg": _digits(max(angles))} if angles else {}
    return row | {"inside": {part: value for part, value in inside.items() if value is not None}}


def is_inside(error: np.ndarray, directions: np.ndarray, matrix: np.ndarray | None) -> bool | None:
    """Whether the 95 % region of a covariance contains an error; None without a variance."""
    if matrix is None or not np.isfinite(matrix).all():
        return None
    variances, axes = np.linalg.eigh(directions @ matrix @ directions)
    known = variances > 1e-9 * max(variances[-1], 1e-24)
    distance = np.sum((error @ axes)[known] ** 2 / variances[known])
    return bool(distance <= chi2.ppf(0.95, known.sum())) if known.any() else None


def _digits(value: float, digits: int = 3) -> float | None:
    return float(f"{value:.{digits}g}") if np.isfinite(value) else None


def summarise(rows: Sequence[Row]) -> Row:
    """Summarize rows: counts, errors (median and 90 %), coverage and calibration."""
    rows = [row | {"p": row.get("p") or 0.0} for row in rows if row["right"] is not None]
    right, strong = [row for row in rows if row["right"]], [row for row in rows if row["strong"]]
    confident, confident_strong = ([row for row in part if row["p"] >= CONFIDENT] for part in (rows, strong))
    summary: Row = {"number": len(rows), "right": len(right)}
    for name, part in (("strong", strong), ("sure", confident), ("sure_strong", confident_strong)):
        summary |= {name: len(part), f"right_{name}": sum(row["right"] for row in part)}
    summary["wrong_sure"] = summary["sure"] - summary["right_sure"]
    for name in ("position_mm", "axis_deg"):
        values = [row[name] for row in right if row.get(name) is not None] or [np.nan]
        summary |= {name: _digits(np.median(values)), f"{name}_90": _digits(np.quantile(values, 0.9))}
    for name, parts in (("inside_position", ("position",)), ("inside_axis", ("angular", "linear"))):
        held = [row["inside"][part] for row in right for part in parts if part in row.get("inside", {})]
        summary |= {name: _digits(sum(held) / len(held)) if held else None, f"{name}_of": len(held)}
    summary["calibration"] = []  # number, mean probability and fraction of right names of each bin
    places = np.digitize([row["p"] for row in rows], BINS)
    for place in np.unique(places):
        part = [row for row, own in zip(rows, places, strict=True) if own == place]
        means = (float(np.mean([row[name] for row in part])) for name in ("p", "right"))
        summary["calibration"].append([len(part), *(_digits(mean) for mean in means)])
    return summary


def by_group(rows: dict[str, Row]) -> dict[str, list[Row]]:
    """Sort rows into groups; the key of a row starts with its group."""
    groups = {group: [row for key, row in rows.items() if key.startswith(group + "/")] for group in GROUPS}
    return {group: part for group, part in groups.items() if part}


# ---------- tables
def table_line(name: str, rows: Sequence[Row], seconds: float | None = None) -> str:
    """Format a line of the table."""
    found = summarise(rows)
    line = f"{name:14}{found['number']:>7}{found['right']:>7}"
    for part in ("strong", "sure", "sure_strong"):
        line += f"{found[f'right_{part}']:>7}/{found[part]:<4}"
    for part in ("position_mm", "position_mm_90", "axis_deg", "axis_deg_90"):
        line += f"{'' if found[part] is None else f'{found[part]:.3g}':>9}"
    for part in ("inside_position", "inside_axis"):
        line += f"{'' if found[part] is None else f'{found[part]:.0%}':>8}"
    return line + ("" if seconds is None else f"{seconds:>6.0f} s")


def print_summary(record: Row) -> None:
    """Print the tables of a run: by group, by constraint, calibration, and real recordings."""
    groups = by_group(record["cases"])
    print(f"{'':14}{'number':>7}{'right':>7}{'strong':>12}{'p >= 0.9':>12}{'and strong':>12}", end="")
    print(f"{'position, mm':>18}{'axis, deg':>18}{'inside':>8}{'inside':>8}{'time':>8}")
    for group, rows in groups.items():
        print(table_line(group, rows, record["seconds"].get(group)))
    for group in [group for group in ("white", "soft", "repeatable", "stops", "faults") if group in groups]:
        print(f"\n{group} by constraint, with the most frequent wrong names")
        for label in CONSTRAINTS:
            rows = [row for row in groups[group] if row["constraint"] == label]
            wrong = Counter(row["name"].split(":")[0] for row in rows if not row["right"]).most_common(2)
            print(table_line(label, rows), "  " + ", ".join(f"{name} {count}" for name, count in wrong))
    print("\ncalibration: mean probability > fraction of right names (recordings)")
    for group, rows in groups.items():
        bins = summarise(rows)["calibration"]
        print(f"{group:10}" + "  ".join(f"{mean:.3f} > {right:.3f} ({count})" for count, mean, right in bins))
    for key, row in record["cases"].items():
        if key.startswith("real/"):
            line = f"{key:33}{row['name'][:42]:43}{row.get('p') or 0:6.3f}  {MARKS[row['right']]:11}"
            units = {"position_mm": "mm", "axis_deg": "deg"}
            print(line, *(f"{row[part]} {unit}" for part, unit in units.items() if part in row))
    for note in record["notes"]:
        print(f"note: {note}")


def compare(old: Row, new: Row, most: int = 12) -> list[str]:
    """Lines that list improvements and regressions of each group, over the recordings of both runs."""
    both = [key for key in new["cases"] if key in old["cases"]]
    before, after = ({key: record["cases"][key] for key in both} for record in (old, new))
    lines = []
    for group, rows in by_group(after).items():
        was, now = summarise(by_group(before)[group]), summarise(rows)
        lines.append(f"{group}: {len(rows)} recordings in both runs")
        for name in [name for name in was if None not in (was[name], now[name])]:
            gain = _goodness(name, now[name]) - _goodness(name, was[name])
            if gain and abs(gain) > 0.02 * abs(was[name]):
                change = f"{name:20}{was[name]:>10.4g} -> {now[name]:.4g}"
                lines.append(f"  {'better' if gain > 0 else 'worse':8}{change}")
        keys = [key for key in both if _name_and_mark(before[key]) != _name_and_mark(after[key])]
        keys = [key for key in keys if key.startswith(f"{group}/")]
        turned = Counter((bool(before[key]["right"]), bool(after[key]["right"])) for key in keys)
        counts = f"{turned[False, True]} became right, {turned[True, False]} became wrong"
        lines.append(f"  names   {len(keys)} changed, {counts}")
        keys.sort(key=lambda key: bool(after[key]["right"]) - bool(before[key]["right"]))  # losses first
        for key in keys if group == "real" else keys[:most]:
            lines.append(f"    {key}: {_name_and_mark(before[key])} -> {_name_and_mark(after[key])}")
    return lines


def _goodness(name: str, value: Any) -> float:
    """A value of a summary with the sign that makes larger better; 0 for values that are not compared."""
    if name in ("inside_position", "inside_axis"):
        return -abs(value - 0.95)
    sign = name.startswith("right") - name.startswith(("wrong", "position", "axis"))
    return sign * value if sign else 0.0


def _name_and_mark(row: Row) -> str:
    return f"{row['name']} ({MARKS[row['right']]})"


def write(file: Path, record: Row) -> None:
    """Write a run as JSON, one line per recording."""
    head = json.dumps({name: value for name, value in record.items() if name != "cases"}, indent=1)
    lines = ",\n".join(f"  {json.dumps(key)}: {json.dumps(row)}" for key, row in record["cases"].items())
    file.write_text(f'{head[:-2]},\n "cases": {{\n{lines}\n }}\n}}\n')


def collect(groups: Sequence[str], data: Path = DATA, every: int = 1) -> tuple[list[Case], list[str]]:
    """Select every n-th recording of some groups, with a note if there are no real recordings."""
    real = real_cases(data)[::every] if "real" in groups else []
    notes = [] if real or "real" not in groups else [f"The group real was skipped: no recordings in {data}."]
    specs = [spec for group in groups if group in made.PLANS for spec in [*made.PLANS[group]()][::every]]
    return [*real, *made.simulate(specs), *(made.arm_cases() if "arm" in groups else [])], notes


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the benchmark."""
    add = (parser := new_parser("golden", __doc__)).add_argument
    add("--group", nargs="+", choices=GROUPS, help="groups to run")
    add("--arm", action="store_true", help="also run the simulated arm")
    add("--fewer", type=int, default=1, metavar="N", help="run every N-th recording of each group")
    add("--data", type=Path, default=DATA, help="folder of recordings (REFRAME_DATA, or ../shared/data)")
    add("--json", type=Path, help="file to write all figures to")
    add("--read", type=Path, metavar="JSON", help="print an earlier run, without a new run")
    add(
        "--compare",
        type=Path,
        metavar="JSON",
        help="print improvements and regressions relative to an earlier run",
    )
    add("--changes", type=int, default=12, help="changed names to print of each simulated group (12)")
    options = parser.parse_args(argv)
    old = json.loads(options.compare.read_text()) if options.compare else None
    if options.read:
        record = json.loads(options.read.read_text())
    else:
        jax.config.update("jax_enable_x64", True)
        groups = options.group or [group for group in GROUPS if group != "arm" or options.arm]
        cases, skipped = collect(groups, options.data, options.fewer)
        rows, seconds, notes = run(cases)
        summary = {group: summarise(part) for group, part in by_group(rows).items()}
        record = {"machine": machine(), "notes": skipped + notes, "seconds": seconds}
        record |= {"summary": summary, "cases": rows}
    print_summary(record)
    if options.json:
        write(options.json, record)
    if old is not None:
        print("\n" + "\n".join(compare(old, record, options.changes)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

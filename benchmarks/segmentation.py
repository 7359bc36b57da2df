"""Sequences of constraints: changes found, false cuts, names, and the time of a long recording.

    python -m benchmarks.segmentation [--quick] [--sequences N] [--singles N] [--arm N] [--hours H]

- sequences of free motion, pin on plane, contour, ball, hinge, slide, plane and lock with white noise of
  10 um to 1 mm and with soft contacts that give 0.3 to 1 mm (:mod:`benchmarks.segmentation_cases`);
- the same with splines through random places for motion, slower and with fewer independent values;
- the same with 10 to 20 s instead of 4 to 8 s a constraint;
- the same with outliers, with repeated or missing poses, and with the body frame 0.6 m away;
- recordings of one constraint, in which no change may be found;
- a pointer that pivots about eight points, with 0.1, 0.3 and 1 mm of noise;
- real recordings in ``../shared/data``, if they are there;
- with ``--arm``, tasks on the simulated arm;
- a recording of six minutes or more at 100 Hz, for the time and the memory.

A change is found if a boundary lies within 0.3 s of it; a boundary further from every change is a false cut.
A constraint is named right if the segment that overlaps it most has its name. The run takes three minutes on
two free cores.
"""

import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import numpy as np

import reframe_jax as rf
from benchmarks.common import add_files, machine, new_parser, write_record
from benchmarks.pointer import simulate_pointer
from benchmarks.segmentation_arm import arm_rows, print_arm
from benchmarks.segmentation_cases import (
    MOTIONS,
    NAMES,
    SPOILED,
    Sequence,
    move_through,
    simulate_sequences,
    simulate_single,
    spoil,
)
from benchmarks.timing import peak_above
from reframe_jax.simulation.motions import PoseErrors

CLOSE = 0.3  # s
_SEED = 2026  # others served to choose constants
_DATA = Path(__file__).parent.parent.parent / "shared" / "data"
_REAL = {
    "kitchen_door_389": "Revolute joint",
    "kitchen_door_403": "Revolute joint",
    "kitchen_door_411": "Revolute joint",
    "kitchen_drawer_394": "Prismatic joint",
    "kitchen_drawer_407": "Prismatic joint",
    "champ_microwave_with_grasp": "Revolute joint",
    "pouring": "Unconstrained",
    "contour_a_1": "3 rotations, 1 translation in BB",
    "contour_b_1": "3 rotations, 1 translation in BB",
    "hinge": "Revolute joint",
    "wiping_0": "Pin-plane contact",
}
_POINTS = np.random.default_rng(2).uniform(-0.2, 0.2, (8, 3))


def main() -> None:
    parser = new_parser("segmentation", __doc__)
    add = parser.add_argument
    add("--quick", action="store_true", help="a quarter of the recordings, and no long one")
    add("--sequences", type=int, default=40, help="simulated sequences of each motion (%(default)s)")
    add("--singles", type=int, default=5, help="recordings of each constraint by itself (%(default)s)")
    add("--arm", type=int, default=0, help="tasks of the arm with each constraint (%(default)s)")
    add("--hours", type=float, default=0.1, help="length of the long recording; 0: none (%(default)s)")
    add("--seed", type=int, default=_SEED, help="seed of the simulated sequences (%(default)s)")
    add_files(parser)
    options = parser.parse_args()
    if options.quick:
        options.sequences, options.singles, options.hours = options.sequences // 4, 1, 0.0
    jax.config.update("jax_enable_x64", True)
    record: dict[str, Any] = {
        "machine": machine(),
        **{
            motion: [
                compare(each) for each in simulate_sequences(options.sequences, options.seed, motion=motion)
            ]
            for motion in MOTIONS
        },
        **{
            how: [
                compare(spoil(each, how))
                for motion in ("sines", "jerks")
                for each in simulate_sequences(options.sequences // 2, options.seed, motion=motion)
            ]
            for how in SPOILED
        },
        "lasting": [
            compare(each)
            for each in simulate_sequences(options.sequences, options.seed, motion="jerks", lasting=(10, 20))
        ],
        "singles": [
            compare(simulate_single(label, number, options.seed))
            for number in range(options.singles)
            for label in NAMES
        ],
        "pivots": [compare_pivots(sigma) for sigma in (1e-4, 3e-4, 1e-3)],
        "real": [compare_real(name) for name in _REAL] if _DATA.is_dir() else [],
        "arm": arm_rows(options.arm),
        "long": [measure_time(options.hours)] if options.hours else [],
    }
    print(record["machine"])
    write_record(options.json, record | {"metrics": print_metrics(record)})


def compare(truth: Sequence) -> dict[str, Any]:
    """Changes and names of a simulated recording against the truth."""
    found = rf.segment(truth.poses, times=truth.times)
    cuts = np.array([boundary.time for boundary in found.boundaries])
    edges = [*truth.starts.tolist(), len(truth.poses)]
    overlapping = [
        max(found.segments, key=lambda s: min(s.stop, b) - max(s.start, a)) for a, b in pairwise(edges)
    ]
    misses = np.abs(truth.changes[:, None] - cuts)
    return {
        "labels": truth.labels,
        "errors": truth.errors,
        "misses": misses.min(axis=1, initial=np.inf).tolist(),
        "false": int(np.sum(misses.min(axis=0, initial=np.inf) > CLOSE)),
        "names": [segment.name for segment in overlapping],
        "named": [
            any(right in segment.name for right in NAMES[label])
            for segment, label in zip(overlapping, truth.labels, strict=True)
        ],
        "held": [
            bool(b.earliest <= start <= b.latest)
            for start in truth.starts[1:]
            for b in found.boundaries
            if abs(b.index - start) <= CLOSE / truth.times[1]
        ],
        "whole": len(found.moving) <= 1,
    }


def compare_pivots(sigma: float) -> dict[str, Any]:
    """Spherical joints of a pointer that pivots about eight points, and their worst border in s."""
    truth = simulate_pointer(_POINTS, jax.random.key(2), errors=PoseErrors(sigma=sigma, rotation_ratio=5.0))
    times = np.asarray(truth.times)
    found = rf.segment(np.asarray(truth.poses), times=times)
    balls = [segment for segment in found.segments if segment.name == "Spherical joint"]
    errors = [
        min(max(abs(times[s.start] - times[start]), abs(times[s.stop - 1] - times[stop - 1])) for s in balls)
        for start, stop in truth.dwells
        if balls
    ]
    return {
        "sigma": sigma,
        "balls": len(balls),
        "close": int(np.sum(np.array(errors) < CLOSE)),
        "worst": max(errors),
    }


def compare_real(name: str) -> dict[str, Any]:
    """Moving segments of a real recording; whether the longest has the right name."""
    recording = rf.load_recording(_DATA / f"{name}.csv")
    found = rf.segment(recording.poses, times=recording.times)
    longest = max(found.segments, key=lambda s: s.stop - s.start)
    segments = [(float(found.times[s.start]), s.name) for s in found.segments]
    return {
        "name": name,
        "moving": len(found.moving),
        "right": _REAL[name] in longest.name,
        "segments": segments,
    }


def measure_time(hours: float) -> dict[str, Any]:
    """Time and memory of a long recording at 100 Hz without the names, compiled before."""
    from reframe_jax.segmentation.entry import find_segments

    labels = ["hinge", "free", "pin", "slide", "ball", "free", "plane"]
    made = move_through(labels, np.full(7, 10.0), {"white": 1e-5}, np.random.default_rng(0), rate=100)
    part = np.concatenate([made.poses, made.poses[-2:0:-1]])
    poses = np.concatenate([part] * -(-round(hours * 360_000) // len(part)))[: round(hours * 360_000)]
    poses[:, :3, 3] += np.random.default_rng(1).normal(0, 1e-5, (len(poses), 3))
    times = 0.01 * np.arange(len(poses))
    find_segments(poses[:2000], times[:2000])  # compiles the search for outliers
    start = time.perf_counter()
    found, memory = peak_above(lambda: find_segments(poses, times))
    taken = time.perf_counter() - start
    changes = sum(len(labels) - 1 for _ in range(len(poses) // (len(part) // 2)))
    return {"poses": len(poses), "s": taken, "MB": memory, "segments": len(found[0]), "changes": changes}


def print_sequences(title: str, rows: list[dict[str, Any]]) -> dict[str, float]:
    """Print the figures of simulated sequences, and return them."""
    if not rows:
        return {}
    misses = np.array([miss for row in rows for miss in row["misses"]])
    named = [name for row in rows for name in row["named"]]
    metrics = {
        "changes found": float(np.mean(misses <= CLOSE)),
        "false cuts for 100 changes": 100 * sum(row["false"] for row in rows) / len(misses),
        "constraints named right": float(np.mean(named)),
        "median error of borders s": float(np.median(misses[misses <= CLOSE])),
        "intervals that hold the change": float(np.mean([h for row in rows for h in row["held"]])),
    }
    print(f"\n{len(rows)} {title}, {len(misses)} changes")
    for name, value in metrics.items():
        print(f"  {name:<32} {value:8.3f}")
    for label in NAMES:
        right = [
            named
            for row in rows
            for named, each in zip(row["named"], row["labels"], strict=True)
            if each == label
        ]
        wrong = {
            name
            for row in rows
            for name, named, each in zip(row["names"], row["named"], row["labels"], strict=True)
            if each == label and not named
        }
        print(f"    {label:<10} {sum(right):>3} of {len(right):>3} right; wrong names: {sorted(wrong)}")
    return metrics


def print_metrics(record: dict[str, Any]) -> dict[str, float]:
    """Print the figures of a record, and return them."""
    metrics: dict[str, float] = {}
    for motion in MOTIONS:
        found = print_sequences(f"sequences of {motion}", record[motion])
        metrics |= {f"{motion}: {name}": value for name, value in found.items()}
    for how, description in SPOILED.items():
        found = print_sequences(f"sequences of sines and jerks {description}", record[how])
        metrics |= {f"{how}: {name}": value for name, value in found.items()}
    found = print_sequences("sequences of jerks of 10 to 20 s a constraint", record["lasting"])
    metrics |= {f"lasting: {name}": value for name, value in found.items()}
    if record["singles"]:
        metrics["single constraints whole"] = float(np.mean([row["whole"] for row in record["singles"]]))
        print(
            f"  {len(record['singles'])} single constraints whole: {metrics['single constraints whole']:.3f}"
        )
    for row in record["pivots"]:
        name = f"pivots {1e3 * row['sigma']:.1f} mm"
        print(f"  {name}: {row['close']} of 8, {row['balls']} balls, worst {row['worst']:.2f} s")
        metrics[name] = row["close"]
    for row in record["real"]:
        verdict = "right" if row["right"] else "wrong"
        print(f"  {row['name']:<28} {row['moving']} moving, {verdict}: {row['segments']}")
    if record["real"]:
        metrics["real names"] = float(np.mean([row["right"] for row in record["real"]]))
    if record["arm"]:
        metrics |= print_arm(record["arm"])
    for row in record["long"]:
        print(f"  {row['poses']} poses: {row['s']:.1f} s, {row['MB']:.0f} MB, {row['segments']} segments")
        metrics |= {"long s": row["s"], "long MB": row["MB"]}
    return metrics


if __name__ == "__main__":
    main()

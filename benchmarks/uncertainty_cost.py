"""What the covariance costs, beside the identification that it belongs to.

Windows of K = 50 and 100 steps at 20 Hz, of every constraint with random geometry, measured with 0.1 mm and
0.3 mrad. Identification and covariance run in turns, so that both see the same machine. The table has the
fastest run of the batch, per window, and the median of the ratios of neighbouring runs; the median of one
window by itself; how much longer the first covariance of the batch took, which has to be compiled; and the
share of 95 % intervals of origins that hold the truth.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

import reframe_jax as rf
from benchmarks.common import machine, new_parser, write_record
from benchmarks.uncertainty import DT, INTERVAL, SAMPLES, measured, recordings, standard_scores
from reframe_jax.simulation.metrics import dof_correct, types_correct

__all__ = ["cost_of"]

SIGMA = 1e-4  # m
SINGLES = 100  # calls with one window


def seconds(call: Callable[[], Any]) -> float:
    """Of one call, until its arrays are there."""
    start = time.perf_counter()
    jax.block_until_ready(jax.tree.leaves(call()))
    return time.perf_counter() - start


def in_turns(poses: np.ndarray, found: rf.Identification, repeats: int) -> tuple[float, np.ndarray]:
    """Seconds of the first covariance, and of identifications and covariances in turns, (repeats, 2)."""

    def covariance() -> Any:
        return rf.covariance(found, poses, dt=DT, compiled=True)

    def identification() -> Any:
        return rf.identify(poses, dt=DT, compiled=True)

    first = seconds(covariance)
    turns = [[seconds(identification), seconds(covariance)] for _ in range(repeats)]
    return first, np.array(turns)


def cost_of(label: str, samples: int, windows: int, repeats: int) -> dict[str, Any]:
    """One row of the table."""
    made = recordings(label, "exciting", windows)
    poses = measured(made, SIGMA, 0.0)[:, : samples + 1]
    found = rf.identify(poses, dt=DT)
    first, batch = in_turns(poses, found, repeats)
    _, single = in_turns(poses[0], rf.identify(poses[0], dt=DT, compiled=True), SINGLES)
    sure = rf.covariance(found, poses, dt=DT)
    right = np.asarray(types_correct(found, made.truth) & dof_correct(found, made.truth))
    scores = standard_scores(found, sure, made.truth, np.asarray(made.exact_poses[:, 0]))["position"][right]
    sizes = np.abs(scores[np.isfinite(scores)])
    return {
        "identify": float(np.min(batch[:, 0])) / windows,
        "covariance": float(np.min(batch[:, 1])) / windows,
        "ratio": float(np.median(batch[:, 1] / batch[:, 0])),
        "one identify": float(np.median(single[:, 0])),
        "one covariance": float(np.median(single[:, 1])),
        "compile": first - float(np.min(batch[:, 1])),
        "coverage": float(np.mean(sizes < INTERVAL)) if len(sizes) else None,
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the benchmark."""
    parser = new_parser("uncertainty_cost", __doc__)
    add = parser.add_argument
    add("--constraints", nargs="+", choices=list(rf.CONSTRAINTS), metavar="LABEL", help="these only, A to L")
    add("--windows", type=int, default=1024, help="in a batch")
    add("--repeats", type=int, default=7, help="runs of the batch")
    add("--json", type=Path, help="file to write all figures to")
    add("--samples", nargs="+", type=int, default=[50, 100], metavar="K", help="steps of a window, up to 100")
    options = parser.parse_args(argv)
    if max(options.samples) > SAMPLES:
        parser.error(f"--samples must be at most {SAMPLES}")
    jax.config.update("jax_enable_x64", True)
    print(machine())
    print(f"{'':9}{'batch, us a window':>22}{'':8}{'one window, ms':>25}{'compile':>12}{'95 %':>9}")
    names = f"{'identify':>10}{'covariance':>12}{'ratio':>8}{'identify':>13}{'covariance':>12}{'s':>12}"
    print(f"{'':4}{'K':>5}{names}{'hold':>9}")
    rows = []
    for samples in options.samples:
        for label in options.constraints or rf.CONSTRAINTS:
            row = cost_of(label, samples, options.windows, options.repeats)
            rows.append({"constraint": label, "samples": samples, **row})
            held = "-" if row["coverage"] is None else f"{row['coverage']:.1%}"
            print(
                f"{label:4}{samples:>5}{1e6 * row['identify']:>10.1f}{1e6 * row['covariance']:>12.1f}"
                f"{row['ratio']:>8.2f}{1e3 * row['one identify']:>13.2f}{1e3 * row['one covariance']:>12.2f}"
                f"{row['compile']:>12.1f}{held:>9}",
                flush=True,
            )
        ratios = [row["ratio"] for row in rows if row["samples"] == samples]
        print(
            f"ratios of K = {samples}: {min(ratios):.2f} to {max(ratios):.2f}, mean {np.mean(ratios):.2f}\n"
        )
    write_record(options.json, {"machine": machine(), "rows": rows})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

"""Every way to solve the six problems of a window, in one run, on the same windows.

Contestants, all in float64 unless said otherwise:

- ``identify``: the library's fast path, all windows in one call;
- ``identify, float32``: the same in single precision; its origins are judged in float64;
- ``general search``: basin hopping over rotation vector and position together, as for norms whose
  rotation has no closed form;
- ``dual annealing``: SciPy's, as the paper configured it (100 iterations, no gradient);
- ``L-BFGS-B x 16``: SciPy's, from 16 random starts, with the exact gradient of the log norm;
- ``CMA-ES x 4``: evosax's, four runs of 250 generations (if evosax is installed; not with --quick).

A problem is missed if its norm is more than 0.1 % above the best that any contestant or a search with
64 long restarts has found. Errors are those of the origin, over windows whose type is unique.

Floors, per window of K = 50 velocities. Bytes: the poses are read and the results written, 6.5 kB and
1.7 kB; at 20 GB/s of a laptop's memory 2M windows/s, at 4.8 TB/s of an H200 600M/s. Flops: kinematics
and moments 0.1 Mflop, the search 6 starts x 5 descents x 6 steps x 4 types x 1,100 = 0.8 Mflop; at
50 Gflop/s of two cores with AVX-512 55,000 windows/s, at 30 Tflop/s of an H200 in float64 33M/s. The run
measures what this machine copies and multiplies, and prints the gap to the floors that follow.
"""

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import reframe_jax as rf
from benchmarks import contestants, scaling
from benchmarks.dual_annealing import DT, MISS, best_known, errors_mm, make_windows
from benchmarks.paper_common import machine
from benchmarks.timing import machine_floors, peak_above, timed
from reframe_jax.identify import default_solver

BASELINE = Path(__file__).with_name("results") / "identification_baseline.json"
GATED = {"speedup": 0.5, "speedup_over_general": 0.5}  # smallest share of the baseline that passes
_DISTINCT = 6144  # windows beyond are repetitions
_MOMENT_FLOPS, _STEP_FLOPS = 0.1e6, 1100  # kinematics and moments; one step of one problem


@dataclass
class Size:
    """How much of everything a run does: windows for ``identify``, and for slower contestants."""

    windows: int = 12288
    judged: int = _DISTINCT
    general: int = 1536
    slow: int = 24
    full: bool = True


QUICK = Size(windows=1536, judged=192, general=32, slow=4, full=False)


@cache
def windows(count: int) -> tuple[np.ndarray, list[str]]:
    """Windows of all twelve constraints, sigma from 1e-6 to 1e-3 m; repeated beyond 6144 of them."""
    distinct = min(count, _DISTINCT)
    poses, labels = make_windows(distinct)
    copies = -(-count // distinct)
    return np.tile(poses, (copies, 1, 1, 1))[:count], (labels * copies)[:count]


@dataclass
class Row:
    """What a contestant did.

    Attributes:
        name: of the contestant.
        index: (n,) windows it solved.
        norms: (n, 6), two angular and four linear.
        positions: (n, 4, 3), m.
        seconds: for all of them, warm.
        compile_s: before that.
    """

    name: str
    index: np.ndarray
    norms: np.ndarray
    positions: np.ndarray
    seconds: float
    compile_s: float

    def __post_init__(self) -> None:
        """Print the speed as soon as it is known."""
        print(
            f"{self.name:18}{len(self.index):>9}{1e3 * self.per_window:>10.4f} ms"
            f"{1 / self.per_window:>11.1f}{self.compile_s:>9.1f} s",
            flush=True,
        )

    @property
    def per_window(self) -> float:
        """Seconds."""
        return self.seconds / len(self.index)


def run_identify(name: str, poses: jax.Array, repeats: int = 3) -> Row:
    """All windows in one call."""
    found, seconds, compiling = timed(lambda: rf.identify(poses, dt=DT), repeats)
    positions = np.asarray(found.candidates.linear.position, dtype=float)
    norms = np.concatenate([found.angular.norms, found.linear.norms], axis=1, dtype=float)
    if poses.dtype == jnp.float32:
        norms[:, 2:] = contestants.norms_at(np.asarray(poses, dtype=float), positions)
    return Row(name, np.arange(len(poses)), norms, positions, seconds, compiling)


def latencies(poses: np.ndarray) -> np.ndarray:
    """Seconds of every push of a stream, once the window is full and everything compiled."""
    online, seconds = rf.OnlineIdentifier(poses.shape[1], dt=DT), []
    for pose in poses[:6].reshape(-1, 4, 4):
        start = time.perf_counter()
        online.push(pose)
        seconds.append(time.perf_counter() - start)
    return np.array(seconds[poses.shape[1] :])


def floors(row: Row, bytes_per_window: int) -> dict[str, float]:
    """How far ``identify`` is from what this machine can copy and calculate."""
    copied, calculated = machine_floors()
    solver: Any = default_solver()
    descents = solver.restarts * (1 + solver.hops + solver.polish)
    flops = _MOMENT_FLOPS + descents * solver.inner.steps * 4 * _STEP_FLOPS
    memory, arithmetic = bytes_per_window / copied, flops / calculated
    print(
        f"floors of this machine: {1e6 * memory:.2f} us per window to copy {bytes_per_window} B at "
        f"{copied / 1e9:.0f} GB/s, {1e6 * arithmetic:.2f} us for {flops / 1e6:.1f} Mflop at "
        f"{calculated / 1e9:.0f} Gflop/s; identify takes {row.per_window / max(memory, arithmetic):.1f} "
        "times the larger",
        flush=True,
    )
    return {"bytes_floor_us": 1e6 * memory, "flops_floor_us": 1e6 * arithmetic}


def compare(size: Size) -> tuple[dict[str, Any], np.ndarray]:
    """Run the contestants and print the tables; returns the metrics, and the best norms known."""
    poses, labels = windows(size.windows)
    on_device = jnp.asarray(poses)
    print(f"{size.windows} windows of {poses.shape[1] - 1} velocities, six problems each; {machine()}")
    print(f"{'':18}{'windows':>9}{'per window':>13}{'windows/s':>11}{'compile':>11}")
    fast = run_identify("identify", on_device)
    found, peak = peak_above(lambda: rf.identify(on_device, dt=DT))
    single = run_identify("identify, float32", on_device.astype(jnp.float32))
    distinct = min(size.windows, _DISTINCT)
    middle = np.linspace(0, distinct - 1, min(size.general, distinct)).astype(int)
    few = np.linspace(0, distinct - 1, min(size.slow, distinct)).astype(int)
    general = Row("general search", middle, *contestants.general_search(poses[middle]))
    annealed = Row("dual annealing", few, *contestants.annealing(poses[few], few))
    rows = [fast, single, general, annealed]
    rows.append(Row("L-BFGS-B x 16", few, *contestants.lbfgs(poses[few], 16)))
    if size.full:
        try:
            rows.append(Row("CMA-ES x 4", few, *contestants.cma_es(poses[few], 4, 250)))
        except ImportError:
            print("CMA-ES left out: pip install 'reframe-jax[benchmark]'")

    judged = np.unique(np.linspace(0, distinct - 1, min(size.judged, distinct)).astype(int))
    best = np.full((size.windows, 6), np.inf)
    best[judged] = best_known(poses[judged])
    for row in rows:
        np.minimum.at(best, row.index, row.norms)
    misses = {}
    print(f"{'':18}{'x annealing':>13}{'missed':>10}{'median error':>16}{'98 %':>12}")
    for row in rows:
        judge = np.isin(row.index, judged) if len(row.index) > len(few) else np.full(len(few), True)
        misses[row.name] = float(np.mean(row.norms[judge] > MISS * best[row.index[judge]]))
        error = errors_mm(row.positions, [labels[i] for i in row.index])
        print(
            f"{row.name:18}{annealed.per_window / row.per_window:>13.1f}{misses[row.name]:>10.2%}"
            f"{np.median(error):>13.4f} mm{np.quantile(error, 0.98):>9.3f} mm",
            flush=True,
        )
    push = 1e3 * latencies(poses)
    print(
        f"a stream, a pose at a time: {np.median(push):.3f} ms, 98 % below {np.quantile(push, 0.98):.3f} ms; "
        f"memory above the input at {size.windows} windows: {peak:.0f} MB",
        flush=True,
    )
    written = sum(leaf.nbytes for leaf in jax.tree.leaves(found)) // size.windows
    return {
        "windows": size.windows,
        "windows_per_second": 1 / fast.per_window,
        "windows_per_second_float32": 1 / single.per_window,
        "speedup": annealed.per_window / fast.per_window,
        "speedup_over_general": general.per_window / fast.per_window,
        "miss_rate": misses["identify"],
        "miss_rate_float32": misses["identify, float32"],
        "miss_rate_general": misses["general search"],
        "dual_annealing_miss_rate": misses["dual annealing"],
        "latency_ms": float(np.median(push)),
        "latency_98_ms": float(np.quantile(push, 0.98)),
        "compile_s": fast.compile_s,
        "peak_memory_mb": peak,
        **floors(fast, poses[0].nbytes + written),
    }, best[judged]


def gate(metrics: dict[str, float], baseline: Path) -> list[str]:
    """What has become worse than the baseline allows: ratios within one run, never times."""
    stored = json.loads(baseline.read_text())["metrics"]
    problems = [
        f"{name} is {metrics[name]:.1f}, less than {share:.0%} of the baseline's {stored[name]:.1f}"
        for name, share in GATED.items()
        if metrics[name] < share * stored[name]
    ]
    if metrics["miss_rate"] > max(1e-3, 2 * stored["miss_rate"]):
        problems.append(f"miss_rate is {metrics['miss_rate']:.2%}, the baseline's {stored['miss_rate']:.2%}")
    return problems


def run(size: Size) -> tuple[dict[str, Any], scaling.Curves]:
    """The whole benchmark: metrics and curves."""
    metrics, best = compare(size)
    poses = windows(min(size.windows, _DISTINCT))[0]
    if size.full:
        metrics |= {f"share_{name}": share for name, share in scaling.spread_of_time(poses).items()}
    return metrics, scaling.curves(poses, best[:, 2:], full=size.full)


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the benchmark."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.identification",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--windows", type=int, default=Size.windows, help="windows to identify (12288)")
    add("--quick", action="store_true", help="under a minute: 1536 windows, and no curve that compiles")
    add("--cpu-devices", type=int, help="processors that JAX shows as so many devices, to spread over")
    add("--json", type=Path, help="file to write the metrics to")
    add("--plot", type=Path, help="file to draw the scaling curves to")
    add("--gate", action="store_true", help="exit with 1 if a ratio is worse than the committed baseline")
    add("--baseline", type=Path, default=BASELINE, help="the baseline, the --json of a --quick run")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    if options.cpu_devices:
        jax.config.update("jax_num_cpu_devices", options.cpu_devices)
    size = QUICK if options.quick else Size(windows=options.windows)
    metrics, curves = run(size)
    if options.json:
        record = {"machine": machine(), "metrics": metrics, "scaling_us": curves}
        options.json.write_text(json.dumps(record, indent=2) + "\n")
    if options.plot:
        scaling.plot(curves, options.plot)
    problems = gate(metrics, options.baseline) if options.gate else []
    for problem in problems:
        print(f"REGRESSION: {problem}")
    return 1 if problems else 0


if __name__ == "__main__":
    raise SystemExit(main())

"""Compare all solvers for the six problems of a window, in one run, on the same windows.

All solvers minimise the norm of velocities between consecutive poses, as ``identify`` with ``scales=1``. The
stream test uses the defaults. Methods, in float64 unless stated:

- ``identify``: the library's fast path, all windows in one call, with the poses on the device;
- ``general search``: basin hopping over orientation and origin together, without eliminating the rotation;
- ``dual annealing``: SciPy's, with the settings of the paper (100 iterations, no gradient);

on an accelerator also

- ``identify, host data`` and ``float32, host data``: the poses come from the host's memory;

and, without --quick,

- ``identify, float32``: in single precision; a norm that is 0.1 % too low also counts as missed;
- ``L-BFGS-B x 16``: SciPy's, from 16 random starts, with the exact gradient of the log norm;
- ``CMA-ES x 4``: evosax's, four runs of 250 generations (if evosax is installed).

A problem counts as missed if its norm is more than 0.1 % above the lowest norm of all methods and of a search
with 64 long restarts. Errors are errors of the origin, for windows with a unique type.
"""

import json
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import reframe_jax as rf
from benchmarks import contestants
from benchmarks.common import machine, new_parser, write_record
from benchmarks.dual_annealing import DT, MISS, best_known, errors_mm, make_windows
from benchmarks.timing import peak_above, timed

BASELINE = Path(__file__).with_name("results") / "identification_baseline.json"
GATED = {"speedup": 0.5, "speedup_general_search": 0.5}  # smallest fraction of the baseline that passes
_DISTINCT = 6144  # number of distinct windows; more windows are repetitions
_THRESHOLDS = rf.Thresholds()


@dataclass
class Size:
    """Size of a run: number of windows for ``identify``, and for slower methods."""

    windows: int = 12288
    judged: int = _DISTINCT
    general: int = 1536
    slow: int = 24
    full: bool = True


QUICK = Size(windows=1536, judged=96, general=96, slow=4, full=False)


@cache
def windows(count: int) -> tuple[np.ndarray, list[str]]:
    """Windows of all twelve constraints, with sigma from 1e-6 to 1e-3 m; 6144 windows are distinct."""
    distinct = min(count, _DISTINCT)
    poses, labels = make_windows(distinct)
    copies = -(-count // distinct)
    return np.tile(poses, (copies, 1, 1, 1))[:count], (labels * copies)[:count]


@dataclass
class Row:
    """Results of one method.

    Attributes:
        name: name of the method.
        index: (n,) indices of the solved windows.
        norms: (n, 6), two angular and four linear norms.
        positions: (n, 4, 3), m.
        seconds: run time for all windows without compilation, s.
        compile_s: compile time, s.
    """

    name: str
    index: np.ndarray
    norms: np.ndarray
    positions: np.ndarray
    seconds: float
    compile_s: float

    @property
    def per_window(self) -> float:
        """Seconds."""
        return self.seconds / len(self.index)


def ready(row: Row) -> Row:
    """Print the speed of a row immediately, and return the row."""
    print(
        f"{row.name:18}{len(row.index):>9}{1e3 * row.per_window:>10.4f} ms{1 / row.per_window:>11.1f}"
        f"{row.compile_s:>9.1f} s",
        flush=True,
    )
    return row


def run_identify(name: str, poses: jax.Array | np.ndarray, repeats: int = 3) -> Row:
    """Identify all windows in one call, with velocities of consecutive poses."""
    found, seconds, compiling = timed(
        lambda: rf.identify(poses, dt=DT, scales=1, thresholds=_THRESHOLDS), repeats
    )
    positions = np.asarray(found.candidates.linear.position, dtype=float)
    norms = np.concatenate([found.angular.norms, found.linear.norms], axis=1, dtype=float)
    return ready(Row(name, np.arange(len(poses)), norms, positions, seconds, compiling))


def time_defaults(poses: jax.Array) -> None:
    """Print the run time of the defaults; their norms use other velocities and cannot be compared."""
    _, seconds, compiling = timed(lambda: rf.identify(poses, dt=DT), 3)
    rate = len(poses) / seconds
    print(
        f"{'identify, defaults':18}{len(poses):>9}{1e3 / rate:>10.4f} ms{rate:>11.1f}{compiling:>9.1f} s",
        flush=True,
    )


def latencies(poses: np.ndarray) -> np.ndarray:
    """Time of every push of a stream, s, with a full window and compiled programs."""
    online, seconds = rf.OnlineIdentifier(poses.shape[1], dt=DT), []
    for pose in poses[:6].reshape(-1, 4, 4):
        start = time.perf_counter()
        online.push(pose)
        seconds.append(time.perf_counter() - start)
    return np.array(seconds[poses.shape[1] :])


def solve(size: Size, poses: np.ndarray) -> tuple[list[Row], float]:
    """Run all methods, ``identify`` first; return their rows and the memory of ``identify`` in MB."""
    on_device = jnp.asarray(poses)
    middle, few = spaced(poses, size.general), spaced(poses, size.slow)
    print(f"{'':18}{'windows':>9}{'per window':>13}{'windows/s':>11}{'compile':>11}")
    rows = [run_identify("identify", on_device)]
    time_defaults(on_device)
    _, peak = peak_above(lambda: rf.identify(on_device, dt=DT, scales=1, thresholds=_THRESHOLDS))
    rows.append(ready(Row("general search", middle, *contestants.general_search(poses[middle]))))
    rows.append(ready(Row("dual annealing", few, *contestants.annealing(poses[few], few))))
    if jax.default_backend() != "cpu":
        rows.append(run_identify("identify, host data", poses))
        rows.append(run_identify("float32, host data", poses.astype(np.float32)))
    if size.full:
        rows.append(run_identify("identify, float32", on_device.astype(jnp.float32)))
        rows.append(ready(Row("L-BFGS-B x 16", few, *contestants.lbfgs(poses[few], 16))))
        try:
            rows.append(ready(Row("CMA-ES x 4", few, *contestants.cma_es(poses[few], 4, 250))))
        except ImportError:
            print("CMA-ES left out: pip install 'reframe-jax[benchmark]'")
    return rows, peak


def spaced(poses: np.ndarray, count: int) -> np.ndarray:
    """Indices of at most ``count`` windows, evenly spaced over the distinct windows."""
    distinct = min(len(poses), _DISTINCT)
    return np.unique(np.linspace(0, distinct - 1, min(count, distinct)).astype(int))


def best_norms(size: Size, poses: np.ndarray, rows: Sequence[Row]) -> np.ndarray:
    """Lowest known norms, (N, 6); infinite for windows that are not scored."""
    # includes the windows of the slower methods
    judged = np.unique(np.concatenate([spaced(poses, size.judged), *(row.index for row in rows[1:3])]))
    best = np.full((len(poses), 6), np.inf)
    best[judged] = best_known(poses[judged])
    for row in rows:
        if "float32" in row.name:
            continue  # rounding errors of float32 may have lowered the norm
        mine = np.isin(row.index, judged)
        np.minimum.at(best, row.index[mine], row.norms[mine])
    return best


def judge(rows: Sequence[Row], best: np.ndarray, labels: Sequence[str]) -> dict[str, float]:
    """Print the quality of all methods; return their metrics, with no prefix for the first method."""
    slowest = next(row for row in rows if row.name == "dual annealing").per_window
    metrics: dict[str, float] = {}
    print(f"{'':18}{'x annealing':>13}{'missed':>10}{'median error':>16}{'98 %':>12}")
    for row in rows:
        known = np.isfinite(best[row.index, 0])
        above = np.log(row.norms[known] / best[row.index[known]])
        missed = float(np.mean(np.abs(above) > np.log(MISS)))
        distinct = row.index < _DISTINCT
        error = errors_mm(row.positions[distinct], [labels[i] for i in row.index[distinct]])
        median, tail = float(np.median(error)), float(np.quantile(error, 0.98))
        print(
            f"{row.name:18}{slowest / row.per_window:>13.1f}{missed:>10.2%}{median:>13.4f} mm{tail:>9.3f} mm",
            flush=True,
        )
        suffix = "" if row is rows[0] else "_" + re.sub(r"\W+", "_", row.name.lower())
        metrics |= {
            f"windows_per_second{suffix}": 1 / row.per_window,
            f"miss_rate{suffix}": missed,
            f"median_error_mm{suffix}": median,
            f"error_98_mm{suffix}": tail,
        }
    return metrics


def run(size: Size) -> dict[str, float]:
    """Run the whole benchmark, and return its metrics."""
    poses, labels = windows(size.windows)
    print(f"{size.windows} windows of {poses.shape[1] - 1} velocities, six problems each; {machine()}")
    rows, peak = solve(size, poses)
    best = best_norms(size, poses, rows)
    quality = judge(rows, best, labels)
    push = 1e3 * latencies(poses)
    print(
        f"a stream, a pose at a time: {np.median(push):.3f} ms, 98 % below {np.quantile(push, 0.98):.3f} ms; "
        f"memory above the input at {size.windows} windows: {peak:.0f} MB",
        flush=True,
    )
    fast, general, annealed = rows[:3]
    return {
        "windows": size.windows,
        "speedup": annealed.per_window / fast.per_window,
        "speedup_general_search": annealed.per_window / general.per_window,
        **quality,
        "latency_ms": float(np.median(push)),
        "latency_98_ms": float(np.quantile(push, 0.98)),
        "compile_s": fast.compile_s,
        "peak_memory_mb": peak,
    }


def gate(metrics: dict[str, float], baseline: Path) -> list[str]:
    """Regressions relative to the baseline, in ratios within one run, not in times."""
    stored = json.loads(baseline.read_text())["metrics"]
    problems = [
        f"{name} is {metrics[name]:.1f}, less than {fraction:.0%} of the baseline's {stored[name]:.1f}"
        for name, fraction in GATED.items()
        if metrics[name] < fraction * stored[name]
    ]
    if metrics["miss_rate"] > max(1e-3, 2 * stored["miss_rate"]):
        problems.append(f"miss_rate is {metrics['miss_rate']:.2%}, the baseline's {stored['miss_rate']:.2%}")
    return problems


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the benchmark."""
    parser = new_parser("identification", __doc__)
    add = parser.add_argument
    add("--windows", type=int, help="windows to identify (12288; with --quick, 1536)")
    add("--quick", action="store_true", help="under a minute: 1536 windows, and smaller sizes of all tests")
    add("--json", type=Path, help="file to write the metrics to")
    add("--gate", action="store_true", help="exit with 1 if a ratio is worse than the committed baseline")
    add("--baseline", type=Path, default=BASELINE, help="baseline: the --json file of a --quick run")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    size = QUICK if options.quick else Size()
    if options.windows:
        size = replace(size, windows=options.windows)
    metrics = run(size)
    write_record(options.json, {"machine": machine(), "metrics": metrics})
    problems = gate(metrics, options.baseline) if options.gate else []
    for problem in problems:
        print(f"REGRESSION: {problem}")
    return 1 if problems else 0


if __name__ == "__main__":
    raise SystemExit(main())

"""Sequences of constraints: segmentation against kernel change points and sliding windows.

    python -m benchmarks.segmentation [--quick] [--pairs N] [--singles N] [--long N] [--json FILE]

All ordered pairs of the twelve constraints and free motion, 5 s each at 100 Hz, with the noise of encoders
(10 um) and of markers (0.2 mm, 1 mrad); single constraints, in which no change may be found; and one long
recording for the time. The contestants are told that there is one change; ``segment`` is not.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import permutations
from pathlib import Path
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

import reframe_jax as rf
from benchmarks.common import machine, new_parser, write_metrics
from benchmarks.timing import peak_above
from reframe_jax.geometry.numpy_rotations import rotation_vectors
from reframe_jax.simulation.metrics import geometry_errors
from reframe_jax.simulation.motions import PoseErrors, disturb
from reframe_jax.simulation.sequences import SequenceSimulation, simulate_sequence

_T = TypeVar("_T")
Contestants = dict[str, Callable[[np.ndarray], list[int]]]

LABELS = ("A", "B", "C", "D", "E", "F", "G", "H", "I", "J", "K", "L", "unconstrained")
NOISE = {"encoders": PoseErrors(sigma=1e-5), "markers": PoseErrors(sigma=2e-4, rotation_ratio=5.0)}
EXCITATIONS = ("exciting", "hand")
DT = 0.01
CLOSE = 0.1  # s
_WINDOW, _STRIDE = 101, 10  # poses of the sliding windows
_ALL, _QUICK = (156, 8, 100_000), (13, 1, 10_000)  # pairs, recordings of each constraint, poses


def main() -> None:
    parser = new_parser("segmentation", __doc__)
    add = parser.add_argument
    add("--quick", action="store_true", help="13 pairs, each constraint once by itself, 10000 poses")
    add("--pairs", type=int, help="pairs of constraints for every noise (156: all)")
    add("--singles", type=int, help="recordings of each constraint by itself (8)")
    add("--long", type=int, help="poses of the long recording (100000)")
    add("--json", type=Path, help="write the figures to a file")
    options = parser.parse_args()
    given = options.pairs, options.singles, options.long
    usual = _QUICK if options.quick else _ALL
    pairs, singles, long = (a if b is None else b for a, b in zip(usual, given, strict=True))
    jax.config.update("jax_enable_x64", True)
    print(machine())
    contestants = available_contestants()
    metrics: dict[str, float] = {}
    for noise in NOISE:
        metrics |= compare(noise, pairs, contestants)
        metrics |= count_false_changes(noise, singles)
    metrics |= measure_time(long)
    write_metrics(options.json, metrics)


def available_contestants() -> Contestants:
    """What finds the boundary in some poses, given that there is one, by name."""
    contestants: Contestants = {"windows": from_windows}
    try:
        import ruptures  # noqa: F401
    except ImportError:
        print('Without ruptures, which needs: pip install "reframe-jax[benchmark]"')
        return contestants
    return {**contestants, "kernel": from_kernel}


def compare(noise: str, count: int, contestants: Contestants) -> dict[str, float]:
    """Boundaries of pairs by every contestant; segments against the parts that the truth cuts out."""
    # in an order in which every part of the pairs has all constraints
    pairs = sorted(permutations(range(len(LABELS)), 2), key=lambda pair: (pair[1] - pair[0]) % len(LABELS))
    misses: dict[str, list[float]] = {name: [] for name in ("segment", *contestants)}
    seconds = dict.fromkeys(misses, 0.0)
    right, named, held, widths = [], [], [], []
    frames: dict[str, list[np.ndarray]] = {"segment": [], "cut out": []}
    for trial, pair in enumerate(pairs[:count]):
        truth, poses = simulated([LABELS[i] for i in pair], trial, noise)
        (change,) = truth.boundaries
        found, taken = _timed(partial(rf.segment, poses, dt=DT))
        seconds["segment"] += taken
        misses["segment"].append(_miss([boundary.index for boundary in found.boundaries], change))
        right.append(len(found) == 2)
        alone = [rf.identify(part, dt=DT) for part in (poses[: change + 1], poses[change:])]
        named.append([segment.name for segment in found.segments] == [one.name for one in alone])
        if right[-1]:
            (boundary,) = found.boundaries
            held.append(boundary.earliest <= change <= boundary.latest)
            widths.append(DT * (boundary.latest - boundary.earliest))
            frames["segment"] += _errors([s.identification for s in found.segments], truth)
            frames["cut out"] += _errors(alone, truth)
        for name, find in contestants.items():
            indices, taken = _timed(partial(find, poses))
            seconds[name] += taken
            misses[name].append(_miss(indices, change))
    count = len(right)
    metrics = {
        "right number": float(np.mean(right)),
        "names as if cut out": float(np.mean(named)),
        "intervals that hold the change": float(np.mean(held)),
    }
    print(f"\n{count} pairs, noise of {noise}")
    for name, value in metrics.items():
        print(f"  {name:<32} {value:7.1%}")
    print(f"  {'median width of these intervals':<32} {np.median(widths):6.3f} s")
    print(f"  {'median error of axes, origins':<32} ", end="")
    for name, errors in frames.items():
        turn, shift = np.nanmedian([e[0] for e in errors]), np.nanmedian([e[1] for e in errors])
        print(f"{name} {np.degrees(turn):.4f} deg, {1e3 * shift:.4f} mm   ", end="")
        metrics |= {f"{name} axes rad": float(turn), f"{name} origins m": float(shift)}
    print(f"\n  {'':<10} {'median':>9} {'90 %':>9} {'within ' + str(CLOSE) + ' s':>13} {'s each':>8}")
    for name, errors_of in misses.items():
        median, most = np.quantile(errors_of, [0.5, 0.9])
        share = float(np.mean(np.asarray(errors_of) <= CLOSE + 1e-9))
        print(f"  {name:<10} {median:>7.3f} s {most:>7.3f} s {share:>13.1%} {seconds[name] / count:>8.2f}")
        metrics |= {f"{name} median s": float(median), f"{name} within": share}
    return {f"{noise} {name}": value for name, value in metrics.items()}


def count_false_changes(noise: str, count: int) -> dict[str, float]:
    """Share of recordings of a single constraint in which a change is found."""
    changed = []
    for trial in range(count):
        for place, label in enumerate(LABELS):
            _, poses = simulated([label], 1000 + trial * len(LABELS) + place, noise)
            changed.append(len(rf.segment(poses, dt=DT)) > 1)
    share = float(np.mean(changed))
    print(f"  changes in {len(changed)} single constraints {share:12.1%}")
    return {f"{noise} false changes": share}


def simulated(labels: list[str], trial: int, noise: str) -> tuple[SequenceSimulation, np.ndarray]:
    """A sequence of constraints, and the poses that are measured."""
    key, excitation = jax.random.key(trial), EXCITATIONS[trial % 2]
    truth = simulate_sequence(labels, key, dt=DT, excitation=excitation)
    return truth, np.asarray(disturb(truth.exact_poses, key, NOISE[noise], DT))


def _errors(found: Sequence[rf.Identification | None], truth: SequenceSimulation) -> list[np.ndarray]:
    """Errors (rad, m) of the linear frames of two parts; NaN where there is no such axis or origin."""
    errors = []
    for one, frame, start in zip(found, truth.truths, (0, *truth.boundaries), strict=True):
        if one is not None and frame.linear_dof != (1, 1, 1):
            error = geometry_errors(one, frame, start=truth.exact_poses[start])
            errors.append(np.array([float(error.linear), float(error.position)]))
    return errors


def _miss(indices: list[int], change: int) -> float:
    """Time from a change to the nearest boundary, s."""
    return DT * min((abs(index - change) for index in indices), default=np.inf)


def from_kernel(poses: np.ndarray) -> list[int]:
    """Kernel change point on body twists, given that there is one change."""
    import ruptures

    twists = _twists(poses)
    signal = twists / np.std(twists, axis=0)
    return [int(index) for index in ruptures.KernelCPD(kernel="rbf", min_size=10).fit(signal).predict(1)[:-1]]


def from_windows(poses: np.ndarray) -> list[int]:
    """The largest change of class probabilities between sliding windows, given that there is one."""
    found = rf.identify(rf.sliding_windows(poses, _WINDOW, _STRIDE), dt=DT)
    classes = np.asarray(found.class_probability).reshape(len(found.status_code), -1)
    apart = _WINDOW // _STRIDE
    change = np.sum(np.abs(classes[apart:] - classes[:-apart]), axis=1)
    return [int(np.argmax(change)) * _STRIDE + _WINDOW]


def _twists(poses: np.ndarray) -> np.ndarray:
    """Turns and shifts of the steps in the body, (K, 6) rad and m."""
    rotation, position = poses[:, :3, :3], poses[:, :3, 3]
    back = np.swapaxes(rotation[:-1], 1, 2)
    shifts = np.einsum("kij,kj->ki", back, np.diff(position, axis=0))
    return np.concatenate([rotation_vectors(back @ rotation[1:]), shifts], axis=1)


def measure_time(poses: int) -> dict[str, float]:
    """Time and memory of a long recording, compiled before."""
    truth = simulate_sequence(["A", "unconstrained", "K", "B", "L"], jax.random.key(4), dt=DT)
    exact = np.asarray(truth.exact_poses)
    there_and_back = np.concatenate([exact, exact[-2:0:-1]])
    repeats = -(-poses // len(there_and_back))
    long = jnp.asarray(np.concatenate([there_and_back] * repeats)[:poses])
    measured = np.asarray(disturb(long, jax.random.key(0), NOISE["encoders"], DT))
    first = _timed(lambda: rf.segment(measured, dt=DT))[1]
    cpu = time.process_time()
    (found, taken), memory = peak_above(lambda: _timed(lambda: rf.segment(measured, dt=DT)))
    cpu = time.process_time() - cpu
    print(f"\n{poses} poses: {taken:.1f} s ({first:.1f} s the first time), {len(found)} segments")
    print(f"  {cpu:.1f} s of processor time, {memory:.0f} MB of memory")
    return {"long s": taken, "long processor s": cpu, "long MB": memory}


def _timed(call: Callable[[], _T]) -> tuple[_T, float]:
    start = time.perf_counter()
    result = call()
    return result, time.perf_counter() - start


if __name__ == "__main__":
    main()

"""Sequences of constraints: segmentation against kernel change points and sliding windows.

    python -m benchmarks.segmentation [--sequences N] [--long N] [--json FILE]

Pairs of the twelve constraints and free motion, 5 s each at 100 Hz, with the noise of encoders (10 um) and of
markers (0.2 mm, 1 mrad); single constraints, in which no change may be found; and one long recording for the
time. Contestants are given the true number of changes; ``segment`` is not.
"""

import argparse
import resource
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

import reframe_jax as rf
from benchmarks.common import machine, write_metrics
from reframe_jax.geometry.numpy_rotations import rotation_vectors
from reframe_jax.simulation.motions import PoseErrors, disturb
from reframe_jax.simulation.sequences import simulate_sequence

LABELS = ("A", "B", "C", "D", "E", "F", "G", "H", "I", "J", "K", "L", "unconstrained")
NOISE = {"encoders": PoseErrors(sigma=1e-5), "markers": PoseErrors(sigma=2e-4, rotation_ratio=5.0)}
DT = 0.01
CLOSE = 0.1  # s
_WINDOW, _STRIDE = 101, 10  # poses of the sliding windows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sequences", type=int, default=52, help="pairs of constraints for every noise (52)")
    parser.add_argument("--long", type=int, default=100_000, help="poses of the long recording (100000)")
    parser.add_argument("--json", type=Path, help="write the figures to a file")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(machine())
    metrics: dict[str, float] = {}
    for noise, errors in NOISE.items():
        metrics |= compare(noise, errors, options.sequences)
    metrics |= measure_time(options.long)
    write_metrics(options.json, metrics)


def compare(noise: str, errors: PoseErrors, count: int) -> dict[str, float]:
    """Boundaries of pairs by every contestant, and false changes in single constraints."""
    contestants: dict[str, Callable[[np.ndarray], list[int]]] = {
        "segment": boundaries_of,
        "windows": from_windows,
    }
    try:
        import ruptures  # noqa: F401
    except ImportError:
        print('Without ruptures, which needs: pip install "reframe-jax[benchmark]"')
    else:
        contestants["kernel"] = from_kernel
    rng = np.random.default_rng(7)
    misses: dict[str, list[float]] = {name: [] for name in contestants}
    seconds = dict.fromkeys(contestants, 0.0)
    right = single = named = 0
    for trial in range(count):
        pair = [LABELS[i] for i in rng.choice(len(LABELS), 2, replace=False)]
        excitation = ("exciting", "hand")[trial % 2]
        truth = simulate_sequence(pair, jax.random.key(trial), dt=DT, excitation=excitation)
        poses = np.asarray(disturb(truth.exact_poses, jax.random.key(trial), errors, DT))
        (change,) = truth.boundaries
        for name, find in contestants.items():
            start = time.perf_counter()
            found = find(poses)
            seconds[name] += time.perf_counter() - start
            misses[name].append(DT * min((abs(index - change) for index in found), default=np.inf))
            right += name == "segment" and len(found) == 1
        parts = poses[: change + 1], poses[change:]
        single += sum(len(rf.segment(part, dt=DT)) == 1 for part in parts)
        alone = [rf.identify(part, dt=DT).name for part in parts]
        named += [part.name for part in rf.segment(poses, dt=DT).segments] == alone
    print(f"\n{count} pairs, noise of {noise}")
    print(f"  right number of segments       {right / count:7.1%}")
    print(f"  names as if cut out            {named / count:7.1%}")
    print(f"  changes in single constraints  {1 - single / (2 * count):7.1%}")
    metrics = {f"{noise} right number": right / count, f"{noise} false changes": 1 - single / (2 * count)}
    print(f"  {'':<10} {'median':>9} {'90 %':>9} {'within ' + str(CLOSE) + ' s':>13} {'s each':>8}")
    for name, errors_of in misses.items():
        median, most = np.quantile(errors_of, [0.5, 0.9])
        share = float(np.mean(np.asarray(errors_of) <= CLOSE))
        print(f"  {name:<10} {median:>7.3f} s {most:>7.3f} s {share:>13.1%} {seconds[name] / count:>8.2f}")
        metrics |= {f"{noise} {name} median s": float(median), f"{noise} {name} within": share}
    return metrics


def boundaries_of(poses: np.ndarray) -> list[int]:
    """Without knowing how many there are."""
    return [boundary.index for boundary in rf.segment(poses, dt=DT).boundaries]


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
    long = np.concatenate([there_and_back] * repeats)[:poses]
    measured = np.asarray(disturb(long, jax.random.key(0), NOISE["encoders"], DT))
    first, second = (_timed(measured) for _ in range(2))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"\n{poses} poses: {second[0]:.1f} s ({first[0]:.1f} s the first time), {second[1]} segments")
    print(f"  memory of the process at most {memory:.0f} MB")
    return {"long s": second[0]}


def _timed(poses: np.ndarray) -> tuple[float, int]:
    start = time.perf_counter()
    found = rf.segment(poses, dt=DT)
    return time.perf_counter() - start, len(found)


if __name__ == "__main__":
    main()

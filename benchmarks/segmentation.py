"""Sequences of constraints: segmentation against kernel change points and sliding windows.

    python -m benchmarks.segmentation [--quick] [--pairs N] [--singles N] [--arm N] [--long N] [--json FILE]

All ordered pairs of the twelve constraints and free motion, 5 s each at 100 Hz, with the noise of encoders
(10 um) and of markers (0.2 mm, 1 mrad); single constraints, in which no change may be found; tasks on the
simulated arm; and one long recording for the time. The contestants are told that there is one change;
``segment`` is not. "known frames" is told the true frames too, and within 0.5 s where the change is: what the
noise permits, by the likelihood that ``segment`` uses with the frames it has found.

The whole run takes about eight minutes. To run it in parts:

    python -m benchmarks.segmentation --noise encoders --arm 0 --long 0 --json encoders.json
    python -m benchmarks.segmentation --noise markers --first 0 --pairs 78 --json markers_0.json
    python -m benchmarks.segmentation --join encoders.json markers_0.json
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import permutations
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

import reframe_jax as rf
from benchmarks.common import add_files, machine, new_parser, read_parts, write_record
from benchmarks.segmentation_arm import arm_rows, show_arm
from benchmarks.timing import peak_above
from reframe_jax.constraints.types import LinearType
from reframe_jax.geometry.numpy_rotations import rotation_vectors
from reframe_jax.segmentation.chords import track_poses
from reframe_jax.segmentation.refine import Search, place_boundaries
from reframe_jax.segmentation.spans import Fits
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
_SEEDS = (
    20_000,
    50_000,
)  # of the first pair and the first single constraint; others served to choose constants
_NEAR = 50  # poses from the change within which it is sought with known frames
_ALL, _QUICK = (156, 16, 4, 100_000), (13, 1, 1, 10_000)  # pairs, recordings of a constraint, tasks, poses


def main() -> None:
    parser = new_parser("segmentation", __doc__)
    add = parser.add_argument
    add("--quick", action="store_true", help="13 pairs, each constraint once by itself, 10000 poses")
    add("--noise", nargs="+", choices=list(NOISE), default=list(NOISE), help="these only")
    add("--first", type=int, default=0, help="pairs to leave out before the first one")
    add("--pairs", type=int, help="pairs of constraints for every noise (156: all)")
    add("--singles", type=int, help="recordings of each constraint by itself (16)")
    add("--arm", type=int, help="tasks of the arm with each constraint (4)")
    add("--long", type=int, help="poses of the long recording (100000; 0: none)")
    add_files(parser)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    record = _joined(read_parts(options)) if options.join else _run(options)
    print(record["machine"])
    write_record(options.json, record | {"metrics": show(record)})


def _run(options: Any) -> dict[str, Any]:
    """What the benchmark measures, by row."""
    given = options.pairs, options.singles, options.arm, options.long
    usual = _QUICK if options.quick else _ALL
    pairs, singles, tasks, long = (a if b is None else b for a, b in zip(usual, given, strict=True))
    contestants = available_contestants()
    return {
        "machine": machine(),
        "pairs": [
            row for noise in options.noise for row in compare(noise, options.first, pairs, contestants)
        ],
        "singles": [row for noise in options.noise for row in count_false_changes(noise, singles)],
        "arm": arm_rows(tasks),
        "long": [measure_time(long)] if long else [],
    }


def _joined(parts: list[dict[str, Any]]) -> dict[str, Any]:
    """The rows of several runs together."""
    rows = {
        name: [row for part in parts for row in part[name]] for name in ("pairs", "singles", "arm", "long")
    }
    return {"machine": parts[0]["machine"], **rows}


def show(record: dict[str, Any]) -> dict[str, float]:
    """Print the figures of a record, and return them."""
    metrics: dict[str, float] = {}
    for noise in NOISE:
        if rows := [row for row in record["pairs"] if row["noise"] == noise]:
            metrics |= {f"{noise} {name}": value for name, value in _show_pairs(noise, rows).items()}
        if rows := [row for row in record["singles"] if row["noise"] == noise]:
            metrics[f"{noise} false changes"] = share = float(np.mean([row["changed"] for row in rows]))
            print(f"  changes in {len(rows)} single constraints {share:12.1%}")
    if record["arm"]:
        metrics |= show_arm(record["arm"])
    for row in record["long"]:
        print(f"\n{row['poses']} poses: {row['s']:.1f} s ({row['first s']:.1f} s the first time), ", end="")
        print(f"{row['segments']} segments")
        print(f"  {row['processor s']:.1f} s of processor time, {row['MB']:.0f} MB of memory")
        metrics |= {f"long {name}": row[name] for name in ("s", "processor s", "MB")}
    return metrics


def available_contestants() -> Contestants:
    """What finds the boundary in some poses, given that there is one, by name."""
    contestants: Contestants = {"windows": from_windows}
    try:
        import ruptures  # noqa: F401
    except ImportError:
        print('Without ruptures, which needs: pip install "reframe-jax[benchmark]"')
        return contestants
    return {**contestants, "kernel": from_kernel}


def compare(noise: str, first: int, count: int, contestants: Contestants) -> list[dict[str, Any]]:
    """Boundaries of pairs by every contestant; segments against the parts that the truth cuts out."""
    # in an order in which every part of the pairs has all constraints
    pairs = sorted(permutations(range(len(LABELS)), 2), key=lambda pair: (pair[1] - pair[0]) % len(LABELS))
    rows = []
    for trial, pair in list(enumerate(pairs))[first : first + count]:
        labels = [LABELS[i] for i in pair]
        truth, poses = simulated(labels, _SEEDS[0] + trial, noise)
        (change,) = truth.boundaries
        found, taken = _timed(partial(rf.segment, poses, dt=DT))
        alone = [rf.identify(part, dt=DT) for part in (poses[: change + 1], poses[change:])]
        row: dict[str, Any] = {
            "noise": noise,
            "labels": labels,
            "right": len(found) == 2,
            "named": [segment.name for segment in found.segments] == [one.name for one in alone],
            "misses": {"segment": _miss([boundary.index for boundary in found.boundaries], change)},
            "seconds": {"segment": taken},
        }
        if row["right"]:
            (boundary,) = found.boundaries
            row["held"] = boundary.earliest <= change <= boundary.latest
            row["width"] = DT * (boundary.latest - boundary.earliest)
            row["errors"] = {
                "segment": _errors([s.identification for s in found.segments], truth),
                "cut out": _errors(alone, truth),
            }
        own: Contestants = {"known frames": partial(from_known_frames, truth), **contestants}
        for name, find in own.items():
            indices, row["seconds"][name] = _timed(partial(find, poses))
            row["misses"][name] = _miss(indices, change)
        rows.append(row)
    return rows


def _show_pairs(noise: str, rows: list[dict[str, Any]]) -> dict[str, float]:
    """Print and return what was found in pairs."""
    right = [row for row in rows if row["right"]]
    metrics = {
        "right number": len(right) / len(rows),
        "names as if cut out": float(np.mean([row["named"] for row in rows])),
        "intervals that hold the change": float(np.mean([row["held"] for row in right])),
    }
    print(f"\n{len(rows)} pairs, noise of {noise}")
    for name, value in metrics.items():
        print(f"  {name:<32} {value:7.1%}")
    print(f"  {'median width of these intervals':<32} {np.median([row['width'] for row in right]):6.3f} s")
    print(f"  {'median error of axes, origins':<32} ", end="")
    for name in ("segment", "cut out"):
        errors = np.array([each for row in right for each in row["errors"][name]])
        turn, shift = np.nanmedian(errors, axis=0)
        print(f"{name} {np.degrees(turn):.4f} deg, {1e3 * shift:.4f} mm   ", end="")
        metrics |= {f"{name} axes rad": float(turn), f"{name} origins m": float(shift)}
    print(f"\n  {'':<12} {'median':>9} {'90 %':>9} {'within ' + str(CLOSE) + ' s':>13} {'s each':>8}")
    for name in rows[0]["misses"]:
        misses = np.array([row["misses"][name] for row in rows])
        median, most = np.quantile(misses, [0.5, 0.9])
        share = float(np.mean(misses <= CLOSE + 1e-9))
        seconds = np.mean([row["seconds"][name] for row in rows])
        print(f"  {name:<12} {median:>7.3f} s {most:>7.3f} s {share:>13.1%} {seconds:>8.2f}")
        metrics |= {f"{name} median s": float(median), f"{name} within": share}
    return metrics


def count_false_changes(noise: str, count: int) -> list[dict[str, Any]]:
    """Whether a change is found in recordings of a single constraint."""
    rows = []
    for trial in range(count):
        for place, label in enumerate(LABELS):
            _, poses = simulated([label], _SEEDS[1] + trial * len(LABELS) + place, noise)
            rows.append({"noise": noise, "label": label, "changed": len(rf.segment(poses, dt=DT)) > 1})
    return rows


def simulated(labels: list[str], trial: int, noise: str) -> tuple[SequenceSimulation, np.ndarray]:
    """A sequence of constraints, and the poses that are measured."""
    key, excitation = jax.random.key(trial), EXCITATIONS[trial % 2]
    truth = simulate_sequence(labels, key, dt=DT, excitation=excitation)
    return truth, np.asarray(disturb(truth.exact_poses, key, NOISE[noise], DT))


def _errors(found: Sequence[rf.Identification | None], truth: SequenceSimulation) -> list[list[float]]:
    """Errors (rad, m) of the linear frames of two parts; NaN where there is no such axis or origin."""
    errors = []
    for one, frame, start in zip(found, truth.truths, (0, *truth.boundaries), strict=True):
        if one is not None and frame.linear_dof != (1, 1, 1):
            error = geometry_errors(one, frame, start=truth.exact_poses[start])
            errors.append([float(error.linear), float(error.position)])
    return errors


def _miss(indices: list[int], change: int) -> float:
    """Time from a change to the nearest boundary, s."""
    return DT * min((abs(index - change) for index in indices), default=np.inf)


def from_known_frames(truth: SequenceSimulation, poses: np.ndarray) -> list[int]:
    """The likeliest place near the change, given the true frames of both sides."""
    tracks = track_poses(poses, DT * np.arange(len(poses)))
    frames = truth.truths
    on_ground = [frame.linear_type in (LinearType.GG, LinearType.BG) for frame in frames]
    fits = Fits(
        cost=np.zeros(2),
        angular_type=np.array([int(frame.angular_type) for frame in frames]),
        linear_type=np.array([int(frame.linear_type) for frame in frames]),
        angular_axes=np.stack([np.asarray(frame.angular_axes) for frame in frames]),
        linear_axes=np.stack([np.asarray(frame.linear_axes) for frame in frames]),
        position=np.stack(
            [
                np.asarray(frame.position) - ground * tracks.centre
                for frame, ground in zip(frames, on_ground, strict=True)
            ]
        ),
    )
    (change,) = truth.boundaries
    low, high = change - _NEAR, change + _NEAR
    (place,) = place_boundaries(tracks, fits, [Search(0, 0, len(poses), low, high, low, high)], _NEAR)
    return [place.index]


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


def measure_time(poses: int) -> dict[str, float | int]:
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
    return {
        "poses": poses,
        "segments": len(found),
        "s": taken,
        "first s": first,
        "processor s": cpu,
        "MB": memory,
    }


def _timed(call: Callable[[], _T]) -> tuple[_T, float]:
    start = time.perf_counter()
    result = call()
    return result, time.perf_counter() - start


if __name__ == "__main__":
    main()

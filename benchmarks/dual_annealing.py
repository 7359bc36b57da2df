"""Compare ``identify`` with SciPy's dual annealing, with the settings of the paper.

Both search the six problems of the same windows (two angular, four linear):

- dual annealing: ``scipy.optimize.dual_annealing`` with ``maxiter=100`` and defaults otherwise, bounds
  of 180 degrees and 1 m, on a vectorised NumPy objective over (rotation vector, position). It runs without a
  gradient, as in the paper, and with the exact gradient for its local search;
- ``reframe_jax.identify``, all windows in one call; the compile time is separate.

The reference is the lowest norm of all methods and of a search with 64 long restarts. The table has the
fraction of problems with a norm more than 0.1 % above the reference, and the error against the truth.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import dual_annealing

import reframe_jax as rf
from benchmarks.common import write_metrics
from benchmarks.timing import in_chunks, timed
from reframe_jax.identification.paper import velocity_map_moments
from reframe_jax.motion import kinematics
from reframe_jax.objectives.velocity import FrameObjective, PositionObjective
from reframe_jax.simulation import metrics, synthetic
from reframe_jax.solvers import Box

DT = 0.1
MISS = 1.001


def make_windows(count: int) -> tuple[np.ndarray, list[str]]:
    """Simulate windows (count, 51, 4, 4) of all twelve constraints, with sigma from 1e-6 to 1e-3 m."""
    labels = list(rf.CONSTRAINTS)
    per_label = -(-count // len(labels))
    sigmas = jnp.logspace(-6, -3, per_label)
    keys = jax.random.split(jax.random.key(2025), per_label)
    poses = []
    for label in labels:
        frame = rf.ConstraintFrame.named(label)
        simulate = jax.vmap(lambda key, sigma, f=frame: synthetic.simulate(f, key, noise=sigma).poses)
        poses.append(np.asarray(simulate(keys, sigmas)))
    order = np.stack(poses, axis=1).reshape(-1, *poses[0].shape[1:])
    return order[:count], (labels * per_label)[:count]


def rotation_matrix(rotvec: np.ndarray) -> np.ndarray:
    """Rodrigues' formula."""
    angle = np.linalg.norm(rotvec) + 1e-300
    x, y, z = rotvec / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k)


@jax.jit
def sampled_velocities(poses: jax.Array, dt: float | jax.Array) -> tuple[jax.Array, jax.Array]:
    """Angular velocities (2, K, 3) and linear velocity maps (4, K, 3, 4) of one window."""
    return kinematics.angular_velocities(poses, dt), kinematics.linear_velocity_maps(poses, dt)


def numpy_objectives(poses: np.ndarray, dt: float = DT) -> list[tuple[Callable[[np.ndarray], float], int]]:
    """The six objectives of one window as NumPy functions of the samples, and their dimensions."""
    rates, maps = (np.asarray(samples) for samples in sampled_velocities(jnp.asarray(poses), dt))

    def norm(velocity: np.ndarray, rotvec: np.ndarray) -> float:
        rms = np.sqrt(np.mean((velocity @ rotation_matrix(rotvec)) ** 2, axis=0))
        return float(np.prod(rms) ** (1 / 3))

    def angular(i: int) -> Callable[[np.ndarray], float]:
        return lambda x: norm(rates[i], x)

    def linear(i: int) -> Callable[[np.ndarray], float]:
        return lambda x: norm(maps[i, :, :, 0] + maps[i, :, :, 1:] @ x[3:], x[:3])

    return [(angular(i), 3) for i in range(2)] + [(linear(i), 6) for i in range(4)]


def jax_gradients(poses: np.ndarray, dt: float = DT) -> list[Callable[[np.ndarray], np.ndarray]]:
    """Gradients of the same six objectives, compiled once for all windows."""
    angular, linear = six_moments(jnp.asarray(poses)[None], dt)

    def of(moments: jax.Array) -> Callable[[np.ndarray], np.ndarray]:
        return lambda x: np.asarray(_gradient(moments, jnp.asarray(x)))

    return [of(angular[..., 0, i]) for i in range(2)] + [of(linear[..., 0, i]) for i in range(4)]


@jax.jit
def six_moments(poses: jax.Array, dt: float | jax.Array) -> tuple[jax.Array, jax.Array]:
    """Moments of single steps of windows (N, K+1, 4, 4): angular (6, 1, N, 2) and linear (6, 10, N, 4)."""
    return velocity_map_moments(poses, jnp.full((1, poses.shape[1] - 1), dt, poses.dtype), "chord")


@jax.jit
def _gradient(moments: jax.Array, x: jax.Array) -> jax.Array:
    return jax.grad(lambda x: jnp.exp(FrameObjective(moments).value(x)))(x)


def solve(poses: np.ndarray, seed: int, *, gradient: bool = False, dt: float = DT) -> tuple[list[Any], float]:
    """Run dual annealing on the six problems of one window: SciPy's results, and the time in s."""
    problems = numpy_objectives(poses, dt)
    gradients = jax_gradients(poses, dt) if gradient else [None] * 6
    for g, (_, dim) in zip(gradients, problems, strict=True):
        if g is not None:
            g(np.full(dim, 0.1))  # compile before the time measurement
    results = []
    start = time.perf_counter()
    for (objective, dim), g in zip(problems, gradients, strict=True):
        bounds = [(-np.pi, np.pi)] * 3 + [(-1.0, 1.0)] * (dim - 3)
        options = (
            {} if g is None else {"minimizer_kwargs": {"method": "L-BFGS-B", "jac": g, "bounds": bounds}}
        )
        results.append(dual_annealing(objective, bounds, maxiter=100, rng=seed, **options))
    return results, time.perf_counter() - start


def anneal(poses: np.ndarray, seed: int, *, gradient: bool) -> tuple[np.ndarray, np.ndarray, float]:
    """Run dual annealing on the six problems: norms (6,), linear positions (4, 3), and the time in s."""
    results, seconds = solve(poses, seed, gradient=gradient)
    return np.array([r.fun for r in results]), np.array([r.x[3:] for r in results[2:]]), seconds


_LONG = rf.BasinHopping(rf.ValleySteps(40), restarts=64, hops=0, refine=rf.ValleySteps(40))
_HALF = 1.5  # m, half width: dual annealing has bounds about the ground's origin, identify about the motion


def best_known(poses: np.ndarray) -> np.ndarray:
    """Norms (N, 6) of a search with 64 long restarts."""
    centred = np.array(poses)
    centred[:, :, :3, 3] -= poses[:, :, :3, 3].mean(axis=1)[:, None]
    return np.asarray(in_chunks(_best_of_chunk, centred))


@jax.jit
def _best_of_chunk(poses: jax.Array) -> jax.Array:
    angular, linear = six_moments(poses, DT)
    box = Box(jnp.full(3, -_HALF), jnp.full(3, _HALF))
    values = _LONG.minimise(PositionObjective(linear), box, jax.random.key(64)).value
    zero = jnp.zeros((3, *angular.shape[2:]))
    return jnp.exp(jnp.concatenate([PositionObjective(angular).value(zero), values], axis=-1))


def errors_mm(positions: np.ndarray, labels: Sequence[str]) -> np.ndarray:
    """Errors of the determined position components, for windows with a unique type."""
    errors = []
    for position, label in zip(positions, labels, strict=True):
        entry = rf.CONSTRAINTS[label]
        if entry.linear_type is not None:
            truth = np.asarray(rf.ConstraintFrame.named(label).position)
            errors.append(np.linalg.norm((position[int(entry.linear_type)] - truth)[list(entry.position)]))
    return 1e3 * np.array(errors)


def position_error(positions: np.ndarray, labels: Sequence[str]) -> float:
    """Median of :func:`errors_mm`; NaN if no window has a unique type."""
    errors = errors_mm(positions, labels)
    return float(np.median(errors)) if len(errors) else float("nan")


def run(count: int, annealed: int) -> dict[str, float]:
    """Run all contestants and print the table."""
    poses, labels = make_windows(count)
    array = jnp.asarray(poses)
    found, seconds, compiling = timed(
        lambda: rf.identify(array, dt=DT, scales=1, thresholds=rf.Thresholds()), 3
    )
    sample = np.linspace(0, count - 1, annealed).astype(int)
    plain = [anneal(poses[i], seed=int(i), gradient=False) for i in sample]
    steered = [anneal(poses[i], seed=int(i), gradient=True) for i in sample]
    ours = np.concatenate([found.angular.norms, found.linear.norms], axis=1)
    best = np.minimum(ours, best_known(poses))
    for j, i in enumerate(sample):
        best[i] = np.minimum(best[i], np.minimum(plain[j][0], steered[j][0]))

    def quality(norms: np.ndarray, best: np.ndarray) -> tuple[float, float]:
        ratio = norms / best
        return float(np.mean(ratio > MISS)), float(np.quantile(ratio, 0.98))

    our_positions = np.asarray(found.candidates.linear.position)
    subset = [labels[i] for i in sample]
    rows = [("identify", seconds / count, *quality(ours, best), position_error(our_positions, labels))]
    for name, runs in (("dual annealing", plain), ("dual annealing, gradient", steered)):
        norms = np.stack([r[0] for r in runs])
        positions = np.stack([r[1] for r in runs])
        elapsed = float(np.mean([r[2] for r in runs]))
        rows.append((name, elapsed, *quality(norms, best[sample]), position_error(positions, subset)))
    print(f"{count} windows of 50 velocities, six problems each; dual annealing on {annealed} of them")
    print(f"{'':26}{'per window':>12}{'windows/s':>12}{'> 0.1 % above':>15}{'98 % ratio':>12}{'error':>12}")
    for name, per_window, missed, worst, error in rows:
        print(
            f"{name:26}{1e3 * per_window:>9.3f} ms{1 / per_window:>12.1f}{100 * missed:>13.2f} %"
            f"{worst:>12.4f}{error:>9.3f} mm"
        )
    print(
        f"identify: first call {compiling:.1f} s longer (compilation); {rows[1][1] / rows[0][1]:.0f} x faster"
    )
    types, dof = [], []
    for i, label in enumerate(labels):
        truth = rf.ConstraintFrame.named(label)
        types.append(bool(metrics.types_correct(found[i], truth, ties=True)))
        dof.append(bool(metrics.dof_correct(found[i], truth)))
    return {
        "windows": count,
        "windows_per_second": count / seconds,
        "dual_annealing_windows_per_second": 1 / rows[1][1],
        "dual_annealing_gradient_windows_per_second": 1 / rows[2][1],
        "speedup": rows[1][1] / rows[0][1],
        "miss_rate": rows[0][2],
        "dual_annealing_miss_rate": rows[1][2],
        "dual_annealing_gradient_miss_rate": rows[2][2],
        "position_error_mm": rows[0][4],
        "dual_annealing_position_error_mm": rows[1][4],
        "types_correct": float(np.mean(types)),
        "dof_correct": float(np.mean(dof)),
        "compile_s": compiling,
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the benchmark."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.dual_annealing", description=__doc__)
    parser.add_argument("--windows", type=int, default=600, help="windows to identify (default 600)")
    parser.add_argument(
        "--annealed", type=int, default=24, help="windows to solve by dual annealing (default 24)"
    )
    parser.add_argument("--quick", action="store_true", help="96 windows, 12 of them by dual annealing")
    parser.add_argument("--json", type=Path, help="file to write the metrics to")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    count, annealed = (96, 12) if options.quick else (options.windows, options.annealed)
    result = run(count, min(annealed, count))
    write_metrics(options.json, result)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

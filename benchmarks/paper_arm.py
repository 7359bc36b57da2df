"""The paper's experiments on a robot, on a simulated one: Table 4, Figure 5, and sweeps of the noise."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import reframe_jax as rf
from reframe_jax import metrics, panda, synthetic
from reframe_jax.reproduction import compare

LABELS = tuple(rf.CONSTRAINTS)
PAPERS = ("A", "B", "D", "I", "K")
TASKS = ("A", "B", "I")
ROWS = ("exact", "literature", "identified")
SCORES = ("types", "dof", "axis", "position")


@dataclass(frozen=True)
class RobotSize:
    """How much to compute.

    Attributes:
        trials: demonstrations of each constraint in Table 4.
        reproductions: of each task in each kind of frame in Figure 5.
        demonstrations: of each constraint at each compliance in the sweeps.
        compliance: m/N, of the sweeps; the angular one is 25 times as many rad/(N m).
        noise: m, of the position; of the rotation vector 3 times as many rad.
        periods: s, between samples.
        lengths: s, of a window.
        seed: of all random numbers.
    """

    trials: int = 10
    reproductions: int = 30
    demonstrations: int = 16
    compliance: tuple[float, ...] = (0.0, 3e-5, 1e-4, 3e-4, 1e-3)
    noise: tuple[float, ...] = (0.0, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3)
    periods: tuple[float, ...] = (0.02, 0.05, 0.1)
    lengths: tuple[float, ...] = (1.0, 2.0, 5.0)
    seed: int = 2025

    @staticmethod
    def quick(seed: int) -> "RobotSize":
        """A tenth of it."""
        return RobotSize(
            trials=4,
            reproductions=16,
            demonstrations=8,
            compliance=(0.0, 1e-4, 1e-3),
            noise=(0.0, 1e-4, 1e-3),
            periods=(0.05,),
            lengths=(1.0, 5.0),
            seed=seed,
        )

    @property
    def recorded(self) -> float:
        """Sample time in s of the demonstrations, which divides all periods."""
        return self.periods[0] if len(self.periods) == 1 else 0.01

    @property
    def windows(self) -> int:
        """Windows of the sweeps."""
        levels = len(self.compliance) * len(self.noise) * len(self.periods) * len(self.lengths)
        return len(LABELS) * self.demonstrations * levels


def _joined(label: str, key: jax.Array, count: int, **options: Any) -> tuple[Any, np.ndarray]:
    """All demonstrations of one constraint, on the host, and their times."""
    parts = list(panda.demonstrations(label, key, count, chunk=16, spread=panda.SPREAD, **options))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts), np.asarray(parts[0].times)


def table4(size: RobotSize) -> dict[str, np.ndarray]:
    """Demonstrate and identify all constraints.

    Returns:
        ``norms`` and ``rms`` (labels, trials, 6), ``errors`` (labels, trials, 3) in degrees and mm,
        ``types`` and ``dof`` (labels, trials), right or not.
    """
    rows: dict[str, list[np.ndarray]] = {name: [] for name in ("norms", "rms", "errors", "types", "dof")}
    for label in LABELS:
        key = jax.random.fold_in(jax.random.key(size.seed), ord(label))
        made, times = _joined(label, key, size.trials, imperfections=panda.REALISTIC)
        found = jax.device_get(rf.identify(made.poses, times=times))
        rows["norms"].append(np.concatenate([found.angular.norms, found.linear.norms], axis=-1))
        rows["rms"].append(np.concatenate([found.angular.rms, found.linear.rms], axis=-1))
        errors = metrics.geometry_errors(found, made.truth, start=jnp.asarray(made.exact_poses[:, 0]))
        degrees = [np.degrees(errors.angular), np.degrees(errors.linear)]
        rows["errors"].append(np.stack([*degrees, 1e3 * np.asarray(errors.position)], axis=-1))
        rows["types"].append(np.asarray(metrics.types_correct(found, made.truth)))
        rows["dof"].append(np.asarray(metrics.dof_correct(found, made.truth)))
    return {name: np.stack(values) for name, values in rows.items()}


def threshold_range(rms: np.ndarray, labels: tuple[str, ...], group: str) -> tuple[float, float]:
    """Largest rms of a constrained and smallest of a free axis; any threshold between is right for all.

    Args:
        rms: (labels, trials, 6), ascending in each group of three.
        labels: those to take.
        group: "angular" or "linear".
    """
    columns = slice(0, 3) if group == "angular" else slice(3, 6)
    held, free = [0.0], [np.inf]
    for label in labels:
        entry = rf.CONSTRAINTS[label]
        number = sum(entry.angular_dof if group == "angular" else entry.linear_dof)
        of_label = rms[LABELS.index(label), :, columns]
        held += list(of_label[:, : 3 - number].max(axis=-1)) if number < 3 else []
        free += list(of_label[:, 3 - number :].min(axis=-1)) if number else []
    return max(held), min(free)


def figure5(size: RobotSize) -> dict[str, np.ndarray]:
    """Reproduce the tasks in exact, erroneous and identified frames.

    Returns:
        Arrays (tasks, rows, trials): ``moment`` (N m), ``force`` (N), ``completed``; and ``errors`` (tasks,
        trials, 3) of the identified frames in degrees and mm.
    """
    results: dict[str, list[Any]] = {name: [] for name in ("moment", "force", "completed", "errors")}
    for label in TASKS:
        key = jax.random.fold_in(jax.random.key(size.seed + 1), ord(label))
        outcome = jax.device_get(compare(label, key, size.reproductions))
        trials = [outcome.rows[name] for name in ROWS]
        results["moment"].append([trial.peak_moment for trial in trials])
        results["force"].append([trial.peak_force for trial in trials])
        results["completed"].append([trial.completed for trial in trials])
        results["errors"].append(outcome.errors)
    return {name: np.asarray(values) for name, values in results.items()}


def sweep_demonstrations(compliance: float, size: RobotSize) -> dict[str, np.ndarray]:
    """Demonstrations of all constraints, sampled as densely as needed: poses and the true geometry."""
    soft = panda.Imperfections(compliance=compliance, angular_compliance=25 * compliance)
    rows: dict[str, list[np.ndarray]] = {"poses": [], "angular": [], "linear": [], "position": []}
    for label in LABELS:
        key = jax.random.fold_in(jax.random.key(size.seed + 2), ord(label))
        made, _ = _joined(label, key, size.demonstrations, dt=size.recorded, imperfections=soft)
        rows["poses"].append(made.exact_poses)
        rows["angular"].append(made.truth.angular_rotvec)
        rows["linear"].append(made.truth.linear_rotvec)
        rows["position"].append(made.truth.position)
    return {name: np.stack(values) for name, values in rows.items()}


_add_noise = jax.jit(jax.vmap(synthetic.add_pose_noise, (0, 0, None)))


def sweep(
    demonstrations: list[dict[str, np.ndarray]], period: float, length: float, size: RobotSize
) -> dict[str, np.ndarray]:
    """Identify the windows of one sampling rate and length.

    Args:
        demonstrations: by compliance, of :func:`sweep_demonstrations`.
        period: s, between samples.
        length: s, of the window, which starts with the demonstration.
        size: levels of the noise.

    Returns:
        Arrays (compliance, noise, labels, demonstrations): ``types`` and ``dof``, right or not; ``axis``, the
        largest error of a unique axis in degrees, and ``position`` in mm, NaN where there is none.
    """
    every, count = round(period / size.recorded), round(length / period)
    scores: dict[str, list[Any]] = {name: [] for name in SCORES}
    for i, made in enumerate(demonstrations):
        poses = made["poses"][:, :, : every * count + 1 : every]
        flat = jnp.asarray(poses.reshape(-1, *poses.shape[2:]))
        key = jax.random.fold_in(jax.random.key(size.seed + 3), i)
        keys = jax.random.split(key, (len(size.noise), len(flat)))
        noisy = [_add_noise(flat, k, sigma) for k, sigma in zip(keys, size.noise, strict=True)]
        windows = jnp.stack(noisy).reshape(len(size.noise), *poses.shape)
        found = jax.device_get(rf.identify(windows, dt=period))
        for name, values in _scores(found, made).items():
            scores[name].append(values)
    return {name: np.stack(values) for name, values in scores.items()}


def _scores(found: rf.Identification, made: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Scores (noise, labels, demonstrations)."""
    rows: dict[str, list[Any]] = {name: [] for name in SCORES}
    for i, truth in enumerate(_truths(made)):
        mine = found[:, i]
        errors = metrics.geometry_errors(mine, truth, start=jnp.asarray(made["poses"][i, :, 0]))
        rows["types"].append(metrics.types_correct(mine, truth))
        rows["dof"].append(metrics.dof_correct(mine, truth))
        rows["axis"].append(np.degrees(np.fmax(errors.angular, errors.linear)))
        rows["position"].append(1e3 * np.asarray(errors.position))
    return {name: np.stack(values, axis=1) for name, values in rows.items()}


def _truths(made: dict[str, np.ndarray]) -> Iterator[rf.ConstraintFrame]:
    for i, label in enumerate(LABELS):
        frame = panda.frame_on_arm(label)
        yield replace(
            frame,
            angular_rotvec=jnp.asarray(made["angular"][i]),
            linear_rotvec=jnp.asarray(made["linear"][i]),
            position=jnp.asarray(made["position"][i]),
        )


def sweep_pieces(size: RobotSize) -> Iterator[tuple[float, float, Any]]:
    """Sampling period, window length and the function of the demonstrations, of every piece of the sweeps."""
    for period in size.periods:
        for length in size.lengths:
            yield period, length, partial(sweep, period=period, length=length, size=size)

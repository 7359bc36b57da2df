"""The paper's Figure 4: error against noise, for both generators, excitations and discretisations.

The motions of one seed are the same at every noise level, so that curves can be compared. An entry is
marked instead of scored where the motion does not determine it: where the best frame of the true type
has other degrees of freedom than the truth in most windows, because the motion happens to obey a
simpler constraint (the paper's velocities turn E and F into pure rotations about a point).
"""

import time
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import dual_annealing

import reframe_jax as rf
from benchmarks.dual_annealing import numpy_objectives, rotation_matrix
from reframe_jax import metrics, synthetic

DT = 0.1
DURATION = 5.0
QUANTITIES = ("angular", "linear", "position")
LABELS = tuple(rf.CONSTRAINTS)
GENERATORS = ("exact", "paper")
EXCITATIONS = ("paper", "exciting")
DISCRETIZATIONS = ("left", "chord")
CELLS = tuple((g, e, d) for g in GENERATORS for e in EXCITATIONS for d in DISCRETIZATIONS)
MISS = 1.001


@dataclass(frozen=True)
class Size:
    """How much of Figure 4 to compute."""

    seeds: int = 100
    levels: int = 10
    annealed: int = 24
    seed: int = 2025

    @property
    def noise(self) -> np.ndarray:
        """(levels,) m, the paper's standard deviations of the position noise."""
        return np.logspace(-6, -4, self.levels)

    @property
    def windows(self) -> int:
        """Windows of one cell."""
        return len(LABELS) * self.levels * self.seeds


def motions(generator: str, excitation: str, size: Size) -> np.ndarray:
    """Poses without noise, (labels, seeds, K+1, 4, 4)."""
    keys = jax.random.split(jax.random.key(size.seed), size.seeds)

    def poses(label: str) -> jax.Array:
        def one(key: jax.Array) -> jax.Array:
            made = synthetic.simulate(
                label, key, duration=DURATION, dt=DT, excitation=excitation, exact=generator == "exact"
            )
            return made.exact_poses

        return jax.vmap(one)(keys)

    return np.stack([np.asarray(poses(label)) for label in LABELS])


@jax.jit
def _noisy(poses: jax.Array, key: jax.Array, noise: jax.Array) -> jax.Array:
    """(labels, levels, seeds, K+1, 4, 4) of poses (labels, seeds, K+1, 4, 4)."""
    labels, seeds = poses.shape[:2]
    keys = jax.random.split(key, (labels, noise.shape[0], seeds))
    add = jax.vmap(synthetic.add_pose_noise, (0, 0, None))  # seeds
    add = jax.vmap(add, (None, 0, 0))  # levels
    return jax.vmap(add, (0, 0, None))(poses, keys, noise)


def windows(generator: str, excitation: str, size: Size) -> np.ndarray:
    """Noisy windows (labels, levels, seeds, K+1, 4, 4)."""
    key = jax.random.key(size.seed + 1)
    return np.asarray(_noisy(motions(generator, excitation, size), key, jnp.asarray(size.noise)))


def identify_cell(poses: np.ndarray, discretization: Any) -> dict[str, np.ndarray]:
    """Identify the windows of one cell and score them.

    Returns:
        Arrays (labels, levels, seeds): ``angular`` and ``linear`` in degrees, ``position`` in mm, NaN where
        Table 2 has no entry; ``types_correct``, ``dof_correct``; ``other``, whether the best frame of the
        true type has other degrees of freedom; the norms (..., 6); and the seconds.
    """
    start = time.perf_counter()
    found = jax.device_get(rf.identify(poses, dt=DT, discretization=discretization))
    seconds = time.perf_counter() - start
    scores: dict[str, list[Any]] = {
        name: [] for name in (*QUANTITIES, "types_correct", "dof_correct", "other")
    }
    for i, label in enumerate(LABELS):
        truth, mine = rf.ConstraintFrame.named(label), found[i]
        errors = metrics.geometry_errors(mine, truth)
        scores["angular"].append(np.degrees(errors.angular))
        scores["linear"].append(np.degrees(errors.linear))
        scores["position"].append(1e3 * np.asarray(errors.position))
        scores["types_correct"].append(metrics.types_correct(mine, truth, ties=True))
        scores["dof_correct"].append(metrics.dof_correct(mine, truth))
        of_type = mine.candidates.linear.dof[..., int(truth.linear_type), :]
        scores["other"].append(np.sum(of_type, axis=-1) != sum(truth.linear_dof))
    norms = np.concatenate([found.angular.norms, found.linear.norms], axis=-1)
    stacked = {name: np.stack([np.asarray(v) for v in values]) for name, values in scores.items()}
    return {**stacked, "norms": norms, "seconds": np.array(seconds)}


@dataclass(frozen=True)
class Entry:
    """One curve of Figure 4.

    Attributes:
        label: of the constraint.
        quantity: of :data:`QUANTITIES`.
        median: (levels,) degrees or mm.
        low, high: (levels,) 10 % and 90 % quantiles.
        slope: of log error against log noise, fitted over all levels.
        determined: whether the motion determines the quantity.
    """

    label: str
    quantity: str
    median: np.ndarray
    low: np.ndarray
    high: np.ndarray
    slope: float
    determined: bool


def entries(cell: dict[str, np.ndarray], noise: np.ndarray) -> list[Entry]:
    """The curves of one cell: those that Table 2 has an entry for."""
    curves = []
    for i, label in enumerate(LABELS):
        for quantity in QUANTITIES:
            errors = cell[quantity][i]
            if np.all(np.isnan(errors)):
                continue
            low, median, high = np.quantile(errors, [0.1, 0.5, 0.9], axis=-1)
            slope = float(np.polyfit(np.log10(noise), np.log10(median), 1)[0])
            determined = quantity == "angular" or bool(np.mean(cell["other"][i]) < 0.5)
            curves.append(Entry(label, quantity, median, low, high, slope, determined))
    return curves


def anneal_sample(poses: np.ndarray, norms: np.ndarray, size: Size) -> dict[str, np.ndarray]:
    """SciPy's dual annealing as the paper configures it on a sample of one cell.

    Args:
        poses: (labels, levels, seeds, K+1, 4, 4).
        norms: (labels, levels, seeds, 6) of ``identify``.
        size: of the sample.

    Returns:
        ``indices`` (n, 3) of the windows, ``seconds`` (n,) for the six problems of each, ``ratio`` (n, 6)
        of its norms to ours, and its errors: ``angular``, ``linear``, ``position``, (n,).
    """
    rng = np.random.default_rng(size.seed)
    number = max(size.annealed, 1)
    indices = np.stack(
        [
            np.arange(number) % len(LABELS),
            np.linspace(0, size.levels - 1, number).round().astype(int),
            rng.integers(0, size.seeds, number),
        ],
        axis=1,
    )
    results: dict[str, list[Any]] = {name: [] for name in ("seconds", "ratio", *QUANTITIES)}
    for order, (i, level, seed) in enumerate(indices):
        problems = numpy_objectives(poses[i, level, seed])
        start = time.perf_counter()
        found = [
            dual_annealing(f, [(-np.pi, np.pi)] * 3 + [(-1.0, 1.0)] * (dim - 3), maxiter=100, rng=order)
            for f, dim in problems
        ]
        results["seconds"].append(time.perf_counter() - start)
        results["ratio"].append([r.fun for r in found] / norms[i, level, seed])
        truth = rf.ConstraintFrame.named(LABELS[i])
        angular, linear = found[int(truth.angular_type)].x, found[2 + int(truth.linear_type)].x
        unique = list(rf.CONSTRAINTS[LABELS[i]].position)
        miss = (linear[3:] - np.asarray(truth.position))[unique]
        results["angular"].append(_axis_error(angular, truth.angular_dof))
        results["linear"].append(_axis_error(linear[:3], truth.linear_dof))
        results["position"].append(1e3 * np.linalg.norm(miss) if len(miss) else np.nan)
    return {"indices": indices, **{name: np.asarray(values) for name, values in results.items()}}


def _axis_error(rotvec: np.ndarray, dof: tuple[int, int, int]) -> float:
    """Degrees between the odd axis of the truth and the nearest axis found: their order is arbitrary."""
    if sum(dof) not in (1, 2):
        return float("nan")
    odd = np.eye(3)[dof.index(sum(dof) % 2)]
    cosine = np.max(np.abs(odd @ rotation_matrix(rotvec)))
    return float(np.degrees(np.arccos(min(1.0, cosine))))

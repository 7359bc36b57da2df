"""Run SciPy's dual annealing, with the settings of the paper, on a sample of the windows of Figure 4."""

import numpy as np

import reframe_jax as rf
from benchmarks.dual_annealing import MISS, rotation_matrix, solve
from benchmarks.paper_common import LABELS, number, table

__all__ = ["SYMBOLS", "anneal_sample", "annealing_metrics", "annealing_text"]

SYMBOLS = {"angular": "ΔR^φ, deg", "linear": "ΔR^ψ, deg", "position": "Δp^ψ, mm"}

_TEXT = """\
### Against dual annealing

SciPy's dual annealing with the settings of the paper (100 iterations, six problems per window) took
{seconds:.2f} s per window on {number} of these windows, or **{hours:.1f} hours** for all {total:,}.
`identify` took {ours:.0f} s for all windows, with compilation. Of the {problems} annealed problems,
{above:.0f} % ended more than 0.1 % above the norm of `identify`, and {below:.0f} % more than 0.1 % below.

"""


def anneal_sample(poses: np.ndarray, norms: np.ndarray, number: int, seed: int) -> dict[str, np.ndarray]:
    """Run dual annealing on windows spread over labels and noise levels.

    Args:
        poses: (labels, levels, seeds, K+1, 4, 4).
        norms: (labels, levels, seeds, 6), norms from ``identify``.
        number: number of windows in the sample.
        seed: seed of the random choice of windows.

    Returns:
        ``indices`` (n, 3) of the windows, ``seconds`` (n,) for the six problems of each window, ``ratio`` (n,
        6) of its norms to the norms of ``identify``, and its errors (n,): ``angular``, ``linear`` in deg,
        ``position`` in mm.
    """
    levels, seeds = poses.shape[1:3]
    indices = np.stack(
        [
            np.arange(number) % len(LABELS),
            np.linspace(0, levels - 1, number).round().astype(int),
            np.random.default_rng(seed).integers(0, seeds, number),
        ],
        axis=1,
    )
    results: dict[str, list[float | np.ndarray]] = {name: [] for name in ("seconds", "ratio", *SYMBOLS)}
    for order, (i, level, column) in enumerate(indices):
        found, seconds = solve(poses[i, level, column], order)
        results["seconds"].append(seconds)
        results["ratio"].append([r.fun for r in found] / norms[i, level, column])
        truth = rf.ConstraintFrame.named(LABELS[i])
        angular, linear = found[int(truth.angular_type)].x, found[2 + int(truth.linear_type)].x
        unique = list(rf.CONSTRAINTS[LABELS[i]].position)
        miss = (linear[3:] - np.asarray(truth.position))[unique]
        results["angular"].append(_axis_error(angular, truth.angular_dof))
        results["linear"].append(_axis_error(linear[:3], truth.linear_dof))
        results["position"].append(1e3 * float(np.linalg.norm(miss)) if len(miss) else float("nan"))
    return {"indices": indices, **{name: np.asarray(values) for name, values in results.items()}}


def _axis_error(rotvec: np.ndarray, dof: tuple[int, int, int]) -> float:
    """Angle, deg, between the true distinct axis and the nearest identified axis; the order is arbitrary."""
    if sum(dof) not in (1, 2):
        return float("nan")
    odd = np.eye(3)[dof.index(sum(dof) % 2)]
    cosine = np.max(np.abs(odd @ rotation_matrix(rotvec)))
    return float(np.degrees(np.arccos(min(1.0, cosine))))


def annealing_metrics(annealed: dict[str, np.ndarray], total: int) -> dict[str, float]:
    """Hours for all windows, and fractions of problems that end above and below ``identify``."""
    return {
        "dual_annealing_hours": float(np.mean(annealed["seconds"])) * total / 3600,
        "dual_annealing_above": float(np.mean(annealed["ratio"] > MISS)),
        "identify_above": float(np.mean(annealed["ratio"] < 1 / MISS)),
    }


def annealing_text(
    annealed: dict[str, np.ndarray], ours: dict[str, np.ndarray], total: int, seconds: float
) -> str:
    """Write the section that compares dual annealing with ``identify``.

    Args:
        annealed: results of :func:`anneal_sample`.
        ours: errors (labels, levels, seeds) of ``identify`` by quantity, for the windows of the sample.
        total: number of windows of Figure 4.
        seconds: time of ``identify`` for all windows.
    """
    at, metrics = tuple(annealed["indices"].T), annealing_metrics(annealed, total)
    text = _TEXT.format(
        number=len(annealed["indices"]),
        seconds=float(np.mean(annealed["seconds"])),
        hours=metrics["dual_annealing_hours"],
        total=total,
        ours=seconds,
        problems=annealed["ratio"].size,
        above=100 * metrics["dual_annealing_above"],
        below=100 * metrics["identify_above"],
    )
    rows = []
    for quantity, symbol in SYMBOLS.items():
        both = annealed[quantity], ours[quantity][at]
        cells = [number(float(f(errors))) for errors in both for f in (np.nanmedian, np.nanmax)]
        rows.append([symbol, *cells])
    head = ["error on the sample", "annealing: median", "largest", "identify: median", "largest"]
    return text + table(head, rows) + "\n"

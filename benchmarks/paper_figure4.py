"""The paper's Figure 4: error against noise, for both generators, excitations and discretizations.

The motions of one seed are the same at every noise level, so that curves can be compared. An entry that the
motion does not determine is marked, not scored. In most of its windows, the best frame of the true type has
other degrees of freedom than the truth, because the motion also obeys a simpler constraint. For example, the
paper's velocities make E and F pure rotations about a point.
"""

import time
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import reframe_jax as rf
from benchmarks.charts import Curve, plot_curves
from benchmarks.paper_annealing import SYMBOLS, anneal_sample, annealing_metrics, annealing_text
from benchmarks.paper_common import LABELS, Section, Store, number, plain, table
from reframe_jax.simulation import metrics, synthetic

__all__ = ["CELLS", "Entry", "Size", "entries", "identify_cell", "section", "windows"]

DT = 0.1
DURATION = 5.0
QUANTITIES = tuple(SYMBOLS)
GENERATORS = ("exact", "paper")
EXCITATIONS = ("paper", "exciting")
DISCRETIZATIONS = ("left", "chord")
CELLS = tuple((g, e, d) for g in GENERATORS for e in EXCITATIONS for d in DISCRETIZATIONS)
PLATEAU = "IJKL"
PAPERS = ("exact", "paper", "left")
OURS = {excitation: ("exact", excitation, "chord") for excitation in EXCITATIONS}

_INTRODUCTION = """\
## Figure 4: error against noise

This section identifies all twelve constraints at {levels} noise levels from 1e-6 to 1e-4 m, with {seeds}
seeds each: {windows:,} windows of 50 velocities. It varies the generator of the motion (exact between the
samples, or the paper's generator with one Euler step per sample), the velocities (those of the paper, or
exciting velocities: three sines along every free axis), and the discretization (`left`, of the paper's Table
3, or `chord`, the default). As in the paper, errors are those of the frame of the true type. The last table
shows how often the identified types and degrees of freedom are right.

ΔR^φ and ΔR^ψ are the angles between the identified and the true axes of the angular and the linear frame.
Δp^ψ is the distance of their origins. Both include only the axes and components that are unique in Table 2 of
the paper. The paper shows Figure 4 as a picture without numbers. It reports slopes of about 1, except for I,
J, K and L, whose ΔR^ψ and Δp^ψ are constant. With the paper's velocities, its discretization and exact motion
(the first columns of the next table), both errors are constant for K and L here as well; for I and J, the
error of the axis is constant, and that of the position is not.

A slope is the slope of the log median error against the log noise: with 1, the error is proportional to the
noise; with 0, it is constant. Entries in brackets are **not determined by the motion** and are not scored. In
most of their windows, the best frame of the true type has other degrees of freedom than the truth, because
the paper's velocities also obey a simpler constraint: E and F turn about a fixed point, and G has a second
point with one free axis fewer. H has a second point with the same degrees of freedom, 0.2 m away, whose norm
is nearly equal. This point wins in some windows and causes the wide band in the panel of H. The exciting
motion determines every entry of Table 2.
"""


@dataclass(frozen=True)
class Size:
    """Size of the computation of Figure 4.

    Attributes:
        seeds: number of motions per constraint.
        levels: number of noise levels.
        annealed: number of windows for SciPy's dual annealing.
        seed: random seed.
    """

    seeds: int = 100
    levels: int = 10
    annealed: int = 24
    seed: int = 2025

    @staticmethod
    def quick(seed: int) -> "Size":
        """A tenth of the full size."""
        return Size(seeds=10, annealed=6, seed=seed)

    @property
    def noise(self) -> np.ndarray:
        """(levels,) m, the paper's standard deviations of the position noise."""
        return np.logspace(-6, -4, self.levels)

    @property
    def windows(self) -> int:
        """Number of windows per cell."""
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
    """Add noise at all levels: poses (labels, seeds, K+1, 4, 4) to (labels, levels, seeds, K+1, 4, 4)."""
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
    thresholds = rf.Thresholds()
    found = rf.identify(poses, dt=DT, scales=1, thresholds=thresholds, discretization=discretization)
    found = jax.device_get(found)
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
        label: label of the constraint.
        quantity: one of :data:`QUANTITIES`.
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
    """The curves of one cell, for quantities with an entry in Table 2."""
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


def _cell(made: Any, generator: str, excitation: str, discretization: str) -> dict[str, np.ndarray]:
    return identify_cell(made(generator, excitation), discretization)


def section(store: Store, size: Size) -> Section:
    """Compute, or resume, and describe Figure 4."""
    # simulated on first use, for both discretizations
    made = cache(lambda generator, excitation: windows(generator, excitation, size))
    cells = {}
    for name in CELLS:
        cells[name] = store.piece("-".join(("figure4", *name)), partial(_cell, made, *name))
    best = OURS["exciting"]
    annealed = store.piece(
        "figure4-annealing",
        lambda: anneal_sample(made(*best[:2]), cells[best]["norms"], size.annealed, size.seed),
    )
    curves = {name: entries(cell, size.noise) for name, cell in cells.items()}
    total = size.windows * len(cells)
    seconds = sum(float(cell["seconds"]) for cell in cells.values())
    blocks = [_INTRODUCTION.format(levels=size.levels, seeds=size.seeds, windows=total)]
    for excitation, title in (("paper", "The paper's velocities"), ("exciting", "Exciting velocities")):
        figure = _picture(size.noise, curves, excitation, f"{title}, exact motion")
        blocks += [f"### {title}\n", store.picture(f"figure4-{excitation}", figure), ""]
        blocks += [_slopes(curves, excitation), ""]
    blocks += [_rates(cells), "", annealing_text(annealed, cells[best], total, seconds)]
    scores = {**_metrics(curves, cells), "windows": total, "identify_seconds": seconds}
    return Section("\n".join(blocks), {**scores, **annealing_metrics(annealed, total)}, _data(curves, size))


def _picture(noise: np.ndarray, curves: dict[Any, list[Entry]], excitation: str, title: str) -> Any:
    """Draw both discretizations of the exact motion, without entries that are not determined."""
    panels: dict[str, list[Curve]] = {}
    notes: dict[str, str] = {}
    for label, row in rf.CONSTRAINTS.items():
        panels[f"{label}  {row.name}"] = []
    for discretization in DISCRETIZATIONS:
        for entry in curves["exact", excitation, discretization]:
            panel = f"{entry.label}  {rf.CONSTRAINTS[entry.label].name}"
            if not entry.determined:
                notes[panel] = "not determined: see table"
                continue
            panels[panel].append(
                Curve(
                    f"{SYMBOLS[entry.quantity]} ({discretization})",
                    entry.median,
                    entry.low,
                    entry.high,
                    colour=QUANTITIES.index(entry.quantity),
                    dashed=discretization == "left",
                )
            )
    return plot_curves(
        noise,
        panels,
        xlabel="noise of the position σ [m]; of the rotation vector 3σ [rad]",
        ylabel="median error [deg, mm], band 10-90 %",
        title=title,
        notes=notes,
    )


def _slopes(curves: dict[Any, list[Entry]], excitation: str) -> str:
    shown = {
        "exact motion, left": ("exact", excitation, "left"),
        "exact motion, chord": ("exact", excitation, "chord"),
        "paper's generator, left": ("paper", excitation, "left"),
    }
    head = ["", "entry"]
    for title in shown:
        head += [f"{title}: at 1e-6 m", "at 1e-4 m", "slope"]
    rows = []
    for parallel in zip(*(curves[name] for name in shown.values()), strict=True):
        row = [parallel[0].label, SYMBOLS[parallel[0].quantity]]
        for entry in parallel:
            texts = [number(entry.median[0]), number(entry.median[-1]), f"{entry.slope:.2f}"]
            row += texts if entry.determined else [f"({text})" for text in texts]
        rows.append(row)
    return table(head, rows)


def _rates(cells: dict[Any, dict[str, np.ndarray]]) -> str:
    head = ["generator", "velocities", "discretization", "right or tied types", "right degrees of freedom"]
    rows = [
        [
            *name,
            f"{100 * np.mean(cell['types_correct']):.2f} %",
            f"{100 * np.mean(cell['dof_correct']):.2f} %",
        ]
        for name, cell in cells.items()
    ]
    text = (
        "### Classification\n\nFraction of all windows. A type counts as right if it is reported or tied. "
        "The entries in brackets cause the wrong degrees of freedom.\n\n"
    )
    return text + table(head, rows)


def _metrics(curves: dict[Any, list[Entry]], cells: dict[Any, dict[str, np.ndarray]]) -> dict[str, float]:
    ours = [entry for name in OURS.values() for entry in curves[name]]
    determined = [entry.slope for entry in ours if entry.determined]
    plateau = [e.slope for e in curves[PAPERS] if e.label in PLATEAU and e.quantity == "linear"]
    best = cells[OURS["exciting"]]
    return {
        "slope_min": min(determined),
        "slope_max": max(determined),
        "plateau_slope_max": max(abs(slope) for slope in plateau),
        "entries_determined": len(determined),
        "entries_not_determined": len(ours) - len(determined),
        "types_correct": float(np.mean(best["types_correct"])),
        "dof_correct": float(np.mean(best["dof_correct"])),
    }


def _data(curves: dict[Any, list[Entry]], size: Size) -> dict[str, Any]:
    return {
        "noise": size.noise.tolist(),
        "curves": [
            {
                "generator": name[0],
                "velocities": name[1],
                "discretization": name[2],
                "label": e.label,
                "quantity": e.quantity,
                "median": plain(e.median),
                "slope": round(e.slope, 4),
                "determined": e.determined,
            }
            for name, entries in curves.items()
            for e in entries
        ],
    }

"""The section of the report on Figure 4: tables and pictures of what paper_simulation computes."""

from functools import partial
from typing import Any

import numpy as np

import reframe_jax as rf
from benchmarks import paper_simulation as simulation
from benchmarks.paper_common import Section, Store, number, plain, table
from reframe_jax.plotting import Curve, plot_curves

__all__ = ["figure4"]

_SYMBOLS = {"angular": "ΔR^φ, deg", "linear": "ΔR^ψ, deg", "position": "Δp^ψ, mm"}
_PLATEAU = "IJKL"
_PAPERS = ("exact", "paper", "left")
_OURS = {excitation: ("exact", excitation, "chord") for excitation in simulation.EXCITATIONS}

_INTRODUCTION = """\
## Figure 4: error against noise

All twelve constraints at {levels} noise levels from 1e-6 to 1e-4 m, {seeds} seeds each, identified in
{windows:,} windows of 50 velocities: motion that is exact between the samples and the paper's generator
(one Euler step a sample), the paper's velocities and exciting ones (three sines along every free axis),
the discretisation of the paper's Table 3 (`left`) and ours (`chord`). As in the paper the frame type is
taken as known for the errors; how often the identified types and degrees of freedom are right is below.

Slopes are of log median error against log noise: 1 means that the error is proportional to the noise, 0
a plateau. Entries in brackets are **not determined by the motion** and are not scored: in most of
their windows the best frame of the true type has other degrees of freedom than the truth, because the
paper's velocities happen to obey a simpler constraint (E and F turn about a fixed point, G has a second
point with one axis less). H has a second point of the same class, 0.2 m away, whose norm is nearly the
same: it wins in some windows, hence the wide band of its panel. The exciting motion determines every
entry of Table 2.
"""

_AGAINST = """\
### Against dual annealing

SciPy's dual annealing as the paper configures it (100 iterations, six problems a window) on {number} of
these windows took {seconds:.2f} s a window: **{hours:.1f} hours** for all {total:,}. `identify` took
{ours:.0f} s for all of them, compilation included. Of the {problems} problems annealed, {above:.0f} % ended
more than 0.1 % above the norm that `identify` found, and {below:.0f} % more than 0.1 % below.

"""


def figure4(store: Store, size: simulation.Size) -> Section:
    """Compute, or resume, and describe Figure 4."""
    cells = {}
    for generator in simulation.GENERATORS:
        for excitation in simulation.EXCITATIONS:
            poses: list[np.ndarray] = []  # made once for both discretisations, and only if needed

            def windows(
                generator: str = generator, excitation: str = excitation, poses: list[np.ndarray] = poses
            ) -> np.ndarray:
                if not poses:
                    poses.append(simulation.windows(generator, excitation, size))
                return poses[0]

            for discretization in simulation.DISCRETIZATIONS:
                name = (generator, excitation, discretization)
                make = partial(_cell, windows, discretization)
                cells[name] = store.piece(f"figure4-{'-'.join(name)}", make)
            if (generator, excitation) == ("exact", "exciting"):
                norms = cells["exact", "exciting", "chord"]["norms"]
                annealed = store.piece("figure4-annealing", partial(_annealed, windows, norms, size))
    curves = {name: simulation.entries(cell, size.noise) for name, cell in cells.items()}
    total = size.windows * len(cells)
    blocks = [_INTRODUCTION.format(levels=size.levels, seeds=size.seeds, windows=total)]
    for excitation in simulation.EXCITATIONS:
        title = f"{'The paper' + chr(39) + 's' if excitation == 'paper' else 'Exciting'} velocities"
        figure = _picture(size.noise, curves, excitation, f"{title}, exact motion")
        blocks += [f"### {title}\n", store.picture(f"figure4-{excitation}", figure), ""]
        blocks += [_slopes(curves, excitation), ""]
    blocks += [_rates(cells), "", _annealing(annealed, cells, total)]
    return Section("\n".join(blocks), _metrics(curves, cells, annealed, total), _data(curves, size))


def _cell(windows: Any, discretization: str) -> dict[str, np.ndarray]:
    return simulation.identify_cell(windows(), discretization)


def _annealed(windows: Any, norms: np.ndarray, size: simulation.Size) -> dict[str, np.ndarray]:
    return simulation.anneal_sample(windows(), norms, size)


def _picture(
    noise: np.ndarray, curves: dict[Any, list[simulation.Entry]], excitation: str, title: str
) -> Any:
    """Both discretisations of the exact motion; entries that are not determined are left out."""
    panels: dict[str, list[Curve]] = {}
    notes: dict[str, str] = {}
    for label, row in rf.CONSTRAINTS.items():
        panels[f"{label}  {row.name}"] = []
    for discretization in simulation.DISCRETIZATIONS:
        for entry in curves["exact", excitation, discretization]:
            panel = f"{entry.label}  {rf.CONSTRAINTS[entry.label].name}"
            if not entry.determined:
                notes[panel] = "not determined: see table"
                continue
            panels[panel].append(
                Curve(
                    f"{_SYMBOLS[entry.quantity]} ({discretization})",
                    entry.median,
                    entry.low,
                    entry.high,
                    colour=simulation.QUANTITIES.index(entry.quantity),
                    dashed=discretization == "left",
                )
            )
    return plot_curves(
        noise,
        panels,
        xlabel="noise of the position σ [m]; of the rotation vector 3σ [rad/m]",
        ylabel="median error [deg, mm], band 10-90 %",
        title=title,
        notes=notes,
    )


def _slopes(curves: dict[Any, list[simulation.Entry]], excitation: str) -> str:
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
        row = [parallel[0].label, _SYMBOLS[parallel[0].quantity]]
        for entry in parallel:
            texts = [number(entry.median[0]), number(entry.median[-1]), f"{entry.slope:.2f}"]
            row += texts if entry.determined else [f"({text})" for text in texts]
        rows.append(row)
    return table(head, rows)


def _rates(cells: dict[Any, dict[str, np.ndarray]]) -> str:
    head = ["generator", "velocities", "discretisation", "types right or tied", "degrees of freedom right"]
    rows = [
        [
            *name,
            f"{100 * np.mean(cell['types_correct']):.2f} %",
            f"{100 * np.mean(cell['dof_correct']):.2f} %",
        ]
        for name, cell in cells.items()
    ]
    text = (
        "### Classification\n\nShare of all windows; a type counts as right if the result reports it as "
        "tied with the winner. Wrong degrees of freedom are those of the entries in brackets.\n\n"
    )
    return text + table(head, rows)


def _annealing(annealed: dict[str, np.ndarray], cells: dict[Any, dict[str, np.ndarray]], total: int) -> str:
    mine = cells["exact", "exciting", "chord"]
    at = tuple(annealed["indices"].T)
    seconds = float(np.mean(annealed["seconds"]))
    ours = sum(float(cell["seconds"]) for cell in cells.values())
    ratio = annealed["ratio"]
    above, below = np.mean(ratio > simulation.MISS), np.mean(ratio < 1 / simulation.MISS)
    text = _AGAINST.format(
        number=len(at[0]),
        seconds=seconds,
        hours=seconds * total / 3600,
        total=total,
        ours=ours,
        problems=ratio.size,
        above=100 * above,
        below=100 * below,
    )
    rows = []
    for quantity in simulation.QUANTITIES:
        theirs, own = annealed[quantity], mine[quantity][at]
        rows.append(
            [
                _SYMBOLS[quantity],
                *(number(float(f(errors))) for errors in (theirs, own) for f in (np.nanmedian, np.nanmax)),
            ]
        )
    head = ["error on the sample", "annealing: median", "largest", "identify: median", "largest"]
    return text + table(head, rows) + "\n"


def _metrics(
    curves: dict[Any, list[simulation.Entry]],
    cells: dict[Any, dict[str, np.ndarray]],
    annealed: dict[str, np.ndarray],
    total: int,
) -> dict[str, float]:
    determined = [e.slope for name in _OURS.values() for e in curves[name] if e.determined]
    plateau = [e.slope for e in curves[_PAPERS] if e.label in _PLATEAU and e.quantity == "linear"]
    seconds = float(np.mean(annealed["seconds"]))
    ours = sum(float(cell["seconds"]) for cell in cells.values())
    best = cells[_OURS["exciting"]]
    return {
        "slope_min": min(determined),
        "slope_max": max(determined),
        "plateau_slope_max": max(abs(slope) for slope in plateau),
        "entries_determined": len(determined),
        "entries_not_determined": sum(not e.determined for name in _OURS.values() for e in curves[name]),
        "types_correct": float(np.mean(best["types_correct"])),
        "dof_correct": float(np.mean(best["dof_correct"])),
        "windows": total,
        "identify_seconds": ours,
        "dual_annealing_hours": seconds * total / 3600,
        "dual_annealing_above": float(np.mean(annealed["ratio"] > simulation.MISS)),
        "identify_above": float(np.mean(annealed["ratio"] < 1 / simulation.MISS)),
    }


def _data(curves: dict[Any, list[simulation.Entry]], size: simulation.Size) -> dict[str, Any]:
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

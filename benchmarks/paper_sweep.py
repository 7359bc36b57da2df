"""Effect of noise, compliance, sampling rate and window length on identification, on the simulated Panda.

The arm is simulated once per constraint and compliance. Its poses are then sampled, divided into windows and
disturbed in every combination.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import reframe_jax as rf
from benchmarks.charts import plot_maps
from benchmarks.paper_common import LABELS, Section, Store, demonstrations, number, plain, table
from reframe_jax.simulation import arm as panda
from reframe_jax.simulation import metrics
from reframe_jax.simulation.synthetic import add_pose_noise

__all__ = ["SCORES", "Size", "factor_table", "identify_all", "section"]

SCORES = ("types", "tied", "dof", "axis", "position")
ANGULAR = 25  # ratio of angular to linear compliance, as in panda.REALISTIC

_INTRODUCTION = """\
## Large sweeps: noise, compliance, sampling, length

This section varies four factors, which needs more demonstrations than a person can record: {windows:,}
windows of the simulated arm, from {demonstrations} demonstrations of each of the twelve constraints. The
factors are the compliance of the mount (its angular compliance in rad/(N m) is 25 times the linear one in
m/N), the pose noise (its orientation noise in rad is 3 times the position noise in m), the sampling time and
the window length. Windows begin at random times. All windows are identified with the thresholds of the paper.
If differences amplify the noise beyond the thresholds, every axis counts as free; in a short window, a free
axis may stay below its threshold by chance. Each cell of a map summarizes all constraints: the fractions of
windows with the right type (a tie counts as wrong) and with the right degrees of freedom, and the medians of
the errors.

"""
_MAPS = {
    "types": ("Fraction of windows with the right type", "fraction"),
    "dof": ("Fraction of windows with the right degrees of freedom", "fraction"),
    "axis": ("Median error of the axes, the larger of the two", "deg"),
    "position": ("Median error of the position", "mm"),
}


@dataclass(frozen=True)
class Size:
    """Values of the varied factors.

    Attributes:
        demonstrations: number of demonstrations per constraint and compliance.
        compliance: m/N, compliance of the tool and its mount.
        noise: m, position noise; the rotation vector has 3 rad/m times this noise.
        periods: s, sample times; multiples of ``recorded``.
        lengths: s, lengths of the windows.
        recorded: s, sample time of the demonstrations.
        seed: random seed.
    """

    demonstrations: int = 16
    compliance: tuple[float, ...] = (0.0, 3e-5, 1e-4, 3e-4, 1e-3)
    noise: tuple[float, ...] = (0.0, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3)
    periods: tuple[float, ...] = (0.02, 0.05, 0.1)
    lengths: tuple[float, ...] = (1.0, 2.0, 5.0)
    recorded: float = 0.01
    seed: int = 2025

    @staticmethod
    def quick(seed: int) -> "Size":
        """A small part of the full size, with programs that other experiments also compile."""
        return Size(
            demonstrations=8,
            compliance=(0.0, 1e-4, 1e-3),
            noise=(1e-5, 1e-4, 1e-3),
            periods=(0.05,),
            lengths=(2.5, 5.0),
            recorded=0.05,
            seed=seed,
        )

    @property
    def windows(self) -> int:
        """Total number of windows."""
        levels = len(self.compliance) * len(self.noise) * len(self.periods) * len(self.lengths)
        return len(LABELS) * self.demonstrations * levels


_disturbed = jax.jit(jax.vmap(add_pose_noise, (0, 0, None)))


def identify_all(size: Size, compliance: float) -> dict[str, np.ndarray]:
    """Simulate the arm at one compliance, and identify its windows for all combinations of other factors.

    Returns:
        Arrays (labels, noise, periods, lengths, demonstrations) of :data:`SCORES`: ``types``, ``tied``
        (types right or tied) and ``dof`` bool; ``axis`` in degrees and ``position`` in mm, NaN if undefined.
    """
    made = [_demonstrations(size, compliance, label) for label in LABELS]
    noisy = np.stack(
        [
            _noisy(size, np.asarray(of_label.exact_poses), label)
            for label, of_label in zip(LABELS, made, strict=True)
        ]
    )
    rng = np.random.default_rng(size.seed)
    moments = rng.uniform(size=(len(LABELS), 1, size.demonstrations))
    steps = noisy.shape[3] - 1
    shape = (len(LABELS), len(size.noise), len(size.periods), len(size.lengths), size.demonstrations)
    results = {name: np.empty(shape, float if name in ("axis", "position") else bool) for name in SCORES}
    for j, period in enumerate(size.periods):
        for k, length in enumerate(size.lengths):
            stride, samples = round(period / size.recorded), round(length / period)
            first = np.round(moments * (steps - stride * samples)).astype(int)
            index = first[..., None] + stride * np.arange(samples + 1)
            windows = np.take_along_axis(noisy, index[..., None, None], axis=3)
            found = jax.device_get(rf.identify(windows, dt=period, scales=1, thresholds=rf.Thresholds()))
            for i, of_label in enumerate(made):
                for name, values in _scores(found[i], of_label).items():
                    results[name][i, :, j, k] = values
    return results


def _demonstrations(size: Size, compliance: float, label: str) -> panda.Demonstration:
    return demonstrations(
        label,
        jax.random.fold_in(jax.random.key(size.seed + 2), ord(label)),
        size.demonstrations,
        chunk=size.demonstrations,
        duration=max(size.lengths),
        dt=size.recorded,
        imperfections=panda.Imperfections(compliance=compliance, angular_compliance=ANGULAR * compliance),
    )


def _noisy(size: Size, poses: np.ndarray, label: str) -> np.ndarray:
    """Poses (demonstrations, K+1, 4, 4) at every level of the noise, (noise, demonstrations, K+1, 4, 4)."""
    key = jax.random.fold_in(jax.random.key(size.seed + 3), ord(label))
    keys = jax.random.split(key, (len(size.noise), len(poses)))
    return np.stack([_disturbed(poses, k, sigma) for k, sigma in zip(keys, size.noise, strict=True)])


def _scores(found: rf.Identification, made: panda.Demonstration) -> dict[str, Any]:
    """Scores (noise, demonstrations)."""
    truth = made.truth
    # the axes of body and ground agree at the start of the demonstration, not of the window
    errors = metrics.geometry_errors(found, truth, start=jnp.asarray(made.exact_poses[:, 0]))
    return {
        "types": metrics.types_correct(found, truth),
        "tied": metrics.types_correct(found, truth, ties=True),
        "dof": metrics.dof_correct(found, truth),
        "axis": np.degrees(np.fmax(errors.angular, errors.linear)),
        "position": 1e3 * np.asarray(errors.position),
    }


def section(store: Store, size: Size) -> Section:
    """Compute, or resume, and describe the sweeps."""
    parts = [store.piece(f"sweep-{level:g}", partial(identify_all, size, level)) for level in size.compliance]
    # (labels, compliance, noise, periods, lengths, demonstrations)
    scores = {name: np.stack([part[name] for part in parts], axis=1) for name in SCORES}
    maps = {name: _maps(scores[name], size) for name in _MAPS}
    blocks = [_INTRODUCTION.format(windows=size.windows, demonstrations=size.demonstrations)]
    blocks += [factor_table(scores, size), ""]
    for name, (title, unit) in _MAPS.items():
        is_fraction = unit == "fraction"
        figure = plot_maps(
            maps[name],
            columns=[f"{1e3 * level:g}" for level in size.noise],
            rows=[f"{1e3 * level:g}" for level in size.compliance],
            xlabel="noise of the position [mm]",
            ylabel="compliance [mm/N]",
            unit=unit,
            title=title,
            limits=(0, 1) if is_fraction else None,
            log=not is_fraction,
            form="{:.2f}" if is_fraction else "{:.2g}",
            across=len(size.lengths),
        )
        blocks += [f"### {title}\n", store.picture(f"sweep-{name}", figure), ""]
    shares = {f"sweep_{name}_correct": float(scores[name].mean()) for name in ("types", "dof")}
    data = {"noise_m": size.noise, "compliance_m_per_n": size.compliance}
    return Section(
        "\n".join(blocks),
        {"sweep_windows": float(size.windows), **shares},
        {**data, **{name: {title: plain(grid) for title, grid in maps[name].items()} for name in maps}},
    )


def _maps(values: np.ndarray, size: Size) -> dict[str, np.ndarray]:
    """Means of fractions and medians of errors, (compliance, noise) by sampling time and length."""
    grids = {}
    for j, period in enumerate(size.periods):
        for k, length in enumerate(size.lengths):
            cell = values[:, :, :, j, k]
            average = cell.mean if cell.dtype == bool else partial(np.nanmedian, cell)
            grids[f"{length:g} s at {period:g} s"] = average(axis=(0, 3))
    return grids


def factor_table(scores: Mapping[str, np.ndarray], size: Size) -> str:
    """Effect of each factor, averaged over all other factors."""
    head = ["factor", "value", "right types", "right or tied", "right degrees of freedom"]
    head += ["axes [deg]", "position [mm]"]
    rows = []
    for axis, (factor, values) in enumerate(
        {
            "constraint": LABELS,
            "compliance, mm/N": [1e3 * level for level in size.compliance],
            "noise, mm": [1e3 * level for level in size.noise],
            "sampling time, s": size.periods,
            "length, s": size.lengths,
        }.items()
    ):
        for i, value in enumerate(values):
            of_value = {name: np.take(scores[name], i, axis=axis) for name in SCORES}
            shares = [f"{100 * of_value[name].mean():.1f} %" for name in ("types", "tied", "dof")]
            errors = [_median(of_value[name]) for name in ("axis", "position")]
            shown = value if isinstance(value, str) else f"{value:g}"
            rows.append(["" if i else factor, shown, *shares, *errors])
    return table(head, rows)


def _median(values: np.ndarray) -> str:
    return "–" if np.isnan(values).all() else number(float(np.nanmedian(values)))

"""Reliability of reported probabilities: the fraction of right statements, by probability."""

import itertools
from pathlib import Path

import numpy as np

import reframe_jax as rf
from reframe_jax.plotting.style import BODY, LINES, new_figure
from reframe_jax.simulation.synthetic import Simulation

__all__ = [
    "KINDS",
    "Said",
    "draw_reliability",
    "merge_tables",
    "print_reliability",
    "probabilities_of",
    "reliability",
]

Said = dict[str, tuple[np.ndarray, np.ndarray]]
"""Probabilities by kind, and whether each statement was right."""

KINDS = {
    "name": "Probability of the name",
    "free axis": "Probability that an axis is free",
}
_BINS = (0.0, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 1.0)
_INTERVAL = 1.96


def probabilities_of(found: rf.Identification, made: Simulation, true_name: str) -> Said:
    """Probabilities of N identifications of one constraint, and whether each statement was right."""
    windows = np.shape(found.status_code)[0]
    free = [np.asarray(part.free_probability).ravel() for part in (found.angular, found.linear)]
    true = [np.sort(dof) for dof in (made.truth.angular_dof, made.truth.linear_dof)]
    said = {
        "name": (np.asarray(found.probability, float), np.asarray(found.name) == true_name),
        "free axis": (np.concatenate(free), np.concatenate([np.tile(dof, windows) for dof in true]) == 1),
    }
    return said


def reliability(said: list[Said], kind: str) -> list[dict[str, float]]:
    """For each bin: the number of probabilities, their mean, and the fraction of right statements."""
    parts = [each[kind] for each in said if kind in each]
    stated, right = (np.concatenate([part[i] for part in parts] or [np.zeros(0)]) for i in (0, 1))
    rows = []
    for low, high in itertools.pairwise(_BINS):
        here = (stated >= low) & ((stated < high) | (high == 1))
        if here.any():
            row = {"low": low, "high": high, "count": int(here.sum())}
            rows.append(row | {"stated": float(np.mean(stated[here])), "right": float(np.mean(right[here]))})
    return rows


def merge_tables(tables: list[list[dict[str, float]]]) -> list[dict[str, float]]:
    """Merge the tables of :func:`reliability` of several runs."""
    merged = []
    for low, high in itertools.pairwise(_BINS):
        rows = [row for table in tables for row in table if row["low"] == low]
        if rows:
            count = sum(row["count"] for row in rows)
            means = {k: sum(row["count"] * row[k] for row in rows) / count for k in ("stated", "right")}
            merged.append({"low": low, "high": high, "count": count} | means)
    return merged


def print_reliability(tables: dict[str, list[dict[str, float]]]) -> None:
    """Print tables of :func:`reliability`."""
    for kind, rows in tables.items():
        print(f"\n{KINDS[kind]}, and how often that was right")
        print(f"{'bin':>12}{'number':>10}{'stated':>10}{'right':>10}")
        for row in rows:
            bounds = f"{row['low']:>5.2f}-{row['high']:<6.2f}"
            print(f"{bounds}{row['count']:>10}{row['stated']:>10.3f}{row['right']:>10.3f}")


def draw_reliability(tables: dict[str, list[dict[str, float]]], file: Path) -> None:
    """Draw reported probabilities against the fraction of right statements."""
    figure = new_figure(4.4, 4.4)
    axes = figure.add_subplot()
    axes.plot([0, 1], [0, 1], color=BODY, linewidth=1, label="exact")
    for (name, rows), colour in zip(tables.items(), (*LINES, BODY), strict=False):
        right = np.array([row["right"] for row in rows])
        width = _INTERVAL * np.sqrt(right * (1 - right) / [row["count"] for row in rows])
        stated = [row["stated"] for row in rows]
        axes.errorbar(stated, right, yerr=width, marker="o", color=colour, label=name, capsize=2)
    axes.set_xlabel("reported probability")
    axes.set_ylabel("fraction of right statements")
    axes.set_aspect("equal")
    axes.legend(frameon=False)
    figure.savefig(file)

"""Helpers of all sections of the report: resumable results, demonstrations, numbers and tables."""

import hashlib
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

import reframe_jax
from reframe_jax.simulation import arm as panda
from reframe_jax.storage.parts import NPZ, read_part, remove_leftovers, write_part
from reframe_jax.storage.records import describe

__all__ = ["LABELS", "Section", "Store", "demonstrations", "number", "plain", "spread", "table"]

LABELS = tuple(reframe_jax.CONSTRAINTS)

_SECONDS = "seconds_in_all"
_START = time.perf_counter()


@dataclass
class Section:
    """A part of the report.

    Attributes:
        text: Markdown.
        metrics: flat numbers for the JSON document.
        data: additional numbers for the JSON document.
    """

    text: str
    metrics: dict[str, float] = field(default_factory=dict)
    data: dict[str, Any] = field(default_factory=dict)


class Store:
    """A folder of finished pieces, which are not computed again.

    ``seconds`` is the total compute time of all pieces, in this run and earlier runs.

    Args:
        folder: folder of the report; its subfolder ``cells`` contains the pieces.
        options: options that the pieces depend on; other options have separate pieces.
        fresh: whether to ignore existing pieces.
    """

    def __init__(self, folder: Path, options: Any, *, fresh: bool = False) -> None:
        self.folder = folder
        self._cells = folder / "cells"
        self._cells.mkdir(parents=True, exist_ok=True)
        self._options = {"version": reframe_jax.__version__, "size": describe(options)}
        self._suffix = hashlib.sha256(json.dumps(self._options).encode()).hexdigest()[:12]
        remove_leftovers(self._cells)
        self._fresh = fresh
        self.seconds = 0.0

    def print_progress(self, text: str) -> None:
        """Print a line of progress, with the time since the start."""
        print(f"{time.perf_counter() - _START:7.1f} s  {text}", file=sys.stderr, flush=True)

    def piece(self, name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Return the arrays of a piece, computed or read.

        Raises:
            ValueError: if the file is damaged or renamed; the message names the file.
        """
        file = self._cells / f"{name}-{self._suffix}.npz"
        if file.exists() and not self._fresh:
            arrays, _ = read_part(file, NPZ, self._options)
            self.seconds += float(arrays.pop(_SECONDS))
            self.print_progress(f"{name}: as computed before")
            return arrays
        self.print_progress(f"{name} ...")
        start = time.perf_counter()
        arrays = {key: np.asarray(value) for key, value in make().items()}
        seconds = time.perf_counter() - start
        write_part(file, NPZ, {**arrays, _SECONDS: seconds}, self._options)
        self.seconds += seconds
        self.print_progress(f"{name}: {seconds:.1f} s")
        return arrays

    def picture(self, name: str, figure: Any) -> str:
        """Save a figure as PNG; return the Markdown for the picture."""
        figure.savefig(self.folder / f"{name}.png", metadata={"Software": None})
        return f"![{name}]({name}.png)"


def demonstrations(label: str, key: jax.Array, count: int, **options: Any) -> panda.Demonstration:
    """Usable demonstrations of one constraint on the host, each with a random geometry."""
    parts = list(panda.demonstrations(label, key, count, spread=panda.SPREAD, **options))
    whole: Any = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    return replace(whole, times=parts[0].times)


def plain(array: Any) -> Any:
    """Convert numbers to nested lists with six digits for JSON, with null for NaN."""
    values = np.asarray(array, dtype=float)
    if values.ndim:
        return [plain(row) for row in values]
    return float(f"{float(values):.6g}") if np.isfinite(values) else None


def number(value: float, digits: int = 2) -> str:
    """Format a number with a few significant digits, in plain notation if it is short; a dash for NaN."""
    if not np.isfinite(value):
        return "–"
    if value == 0 or 1e-3 <= abs(value) < 1e4:
        exponent = 0 if value == 0 else int(np.floor(np.log10(abs(value))))
        return f"{value:.{max(digits - 1 - exponent, 0)}f}"
    return f"{value:.{digits - 1}e}"


def spread(values: np.ndarray, form: str = ".2f") -> str:
    """Format mean and standard deviation over trials; a dash without values."""
    if np.all(np.isnan(values)):
        return "–"
    return f"{np.mean(values):{form}} ± {np.std(values):{form.lstrip('+')}}"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table, with the first column left-aligned and the other columns right-aligned."""
    marks = [":--"] + ["--:"] * (len(head) - 1)
    lines = ["| " + " | ".join(row) + " |" for row in (head, marks, *rows)]
    return "\n".join(lines)

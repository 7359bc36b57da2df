"""Repeat every experiment of the paper, with additional sweeps, in one report.

The benchmark writes ``report.md``, pictures and ``report.json`` to a folder, with the values of the paper and
of this library side by side. Finished parts are stored in the folder, so an interrupted run resumes. A seed
always gives the same results, except for times.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

from benchmarks import paper_figure4, paper_figure5, paper_sweep, paper_table4
from benchmarks.common import machine, write_metrics
from benchmarks.paper_common import Section, Store

EXPERIMENTS: dict[str, Any] = {
    "figure4": paper_figure4,
    "table4": paper_table4,
    "figure5": paper_figure5,
    "sweep": paper_sweep,
}

_HEAD = """\
# The experiments of the paper

Overbeek, Dresscher, van der Kooij and Vlutters (2025), computed by

    {command}

in {seconds:.0f} s, with compilation, on {machine}.
"""


def run(folder: Path, *, quick: bool, seed: int, only: Sequence[str], fresh: bool) -> Section:
    """Compute missing parts and write the report."""
    folder.mkdir(parents=True, exist_ok=True)
    parts, seconds = {}, 0.0
    for name in only:
        experiment = EXPERIMENTS[name]
        size = experiment.Size.quick(seed) if quick else experiment.Size(seed=seed)
        store = Store(folder, size, fresh=fresh)
        parts[name] = experiment.section(store, size)
        seconds += store.seconds
    metrics = {name: value for part in parts.values() for name, value in part.metrics.items()}
    metrics["seconds"] = seconds
    command = "python -m benchmarks.paper" + (" --quick" if quick else "")
    head = _HEAD.format(command=command, seconds=seconds, machine=machine())
    text = "\n".join([head, *(part.text for part in parts.values())])
    whole = Section(text, metrics, {name: part.data for name, part in parts.items()})
    (folder / "report.md").write_text(text.rstrip() + "\n")
    document = {"metrics": metrics, "machine": machine(), **whole.data}
    (folder / "report.json").write_text(json.dumps(document, indent=1) + "\n")
    return whole


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the benchmark."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paper", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/paper"), help="folder (out/paper)")
    parser.add_argument(
        "--only",
        nargs="+",
        choices=EXPERIMENTS,
        default=list(EXPERIMENTS),
        help="experiments to report on (all)",
    )
    parser.add_argument("--seed", type=int, default=2025, help="random seed (2025)")
    parser.add_argument("--quick", action="store_true", help="a small part of every experiment")
    parser.add_argument("--fresh", action="store_true", help="ignore stored parts")
    parser.add_argument("--json", type=Path, help="file to write the metrics to")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    whole = run(
        options.out,
        quick=options.quick,
        seed=options.seed,
        only=options.only,
        fresh=options.fresh,
    )
    for name, value in whole.metrics.items():
        print(f"{name:32}{value:>14.6g}")
    print(f"\n{options.out / 'report.md'}")
    write_metrics(options.json, whole.metrics)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

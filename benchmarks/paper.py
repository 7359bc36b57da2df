"""Every experiment of the paper, and what it could not do, in one report.

Writes ``report.md``, its pictures and ``report.json`` to a folder, the paper's figures and ours side by
side. Finished pieces are kept there, so a run that was stopped goes on where it was; the results of a
given seed are always the same, times excepted.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import jax

from benchmarks.paper_arm import RobotSize
from benchmarks.paper_arm_report import figure5, sweeps, table4
from benchmarks.paper_common import Section, Store, machine
from benchmarks.paper_figure4 import figure4
from benchmarks.paper_simulation import Size

SECTIONS = ("figure4", "table4", "figure5", "sweeps")

_HEAD = """\
# The experiments of the paper

Overbeek, Dresscher, van der Kooij and Vlutters (2025), computed by

    {command}

in {seconds:.0f} s, compilation included, on {machine}.
"""


def run(folder: Path, *, quick: bool, seeds: int, seed: int, only: Sequence[str], fresh: bool) -> Section:
    """Compute what is missing and write the report."""
    folder.mkdir(parents=True, exist_ok=True)
    simulated = Size(seeds=10, annealed=6, seed=seed) if quick else Size(seeds=seeds, seed=seed)
    robot = RobotSize.quick(seed) if quick else RobotSize(seed=seed)
    parts = {}
    figures = Store(folder, simulated, fresh=fresh)
    if "figure4" in only:
        parts["figure4"] = figure4(figures, simulated)
    store = Store(folder, robot, fresh=fresh)
    for name, section in (("table4", table4), ("figure5", figure5), ("sweeps", sweeps)):
        if name in only:
            parts[name] = section(store, robot)
    seconds = figures.seconds + store.seconds
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
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=SECTIONS, help="sections (all)")
    parser.add_argument("--seeds", type=int, default=100, help="motions for each curve of Figure 4 (100)")
    parser.add_argument("--seed", type=int, default=2025, help="of all random numbers (2025)")
    parser.add_argument("--quick", action="store_true", help="a tenth of everything")
    parser.add_argument("--fresh", action="store_true", help="compute everything anew")
    parser.add_argument("--json", type=Path, help="file to write the metrics to")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    whole = run(
        options.out,
        quick=options.quick,
        seeds=options.seeds,
        seed=options.seed,
        only=options.only,
        fresh=options.fresh,
    )
    for name, value in whole.metrics.items():
        print(f"{name:32}{value:>14.6g}")
    print(f"\n{options.out / 'report.md'}")
    if options.json:
        options.json.write_text(json.dumps({"metrics": whole.metrics}, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

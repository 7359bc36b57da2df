"""Helpers of all benchmarks: command lines, a description of the machine, and files of metrics."""

import argparse
import json
import os
import platform
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

import reframe_jax

__all__ = [
    "add_files",
    "chosen_plan",
    "machine",
    "new_parser",
    "plan_parser",
    "read_parts",
    "write_metrics",
    "write_record",
]

_Plan = TypeVar("_Plan")


def new_parser(name: str, doc: str | None) -> argparse.ArgumentParser:
    """Make the parser of a benchmark, with the docstring of its module as help."""
    return argparse.ArgumentParser(
        prog=f"python -m benchmarks.{name}",
        description=doc,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def plan_parser(name: str, doc: str | None, *, quick: str) -> argparse.ArgumentParser:
    """Make the parser of a benchmark with a plan; ``quick`` is the help of ``--quick``."""
    parser = new_parser(name, doc)
    add = parser.add_argument
    add("--quick", action="store_true", help=quick)
    add(
        "--constraints",
        dest="labels",
        nargs="+",
        choices=list(reframe_jax.CONSTRAINTS),
        metavar="LABEL",
        help="constraints to run, A to L",
    )
    add("--sigmas", nargs="+", type=float, help="standard deviations of the position noise, m")
    add_files(parser)
    return parser


def add_files(parser: argparse.ArgumentParser) -> None:
    """Add the options of a benchmark that can run in parts: ``--json`` and ``--join``."""
    add = parser.add_argument
    add("--json", type=Path, help="file to write all figures to")
    add(
        "--join",
        nargs="+",
        type=Path,
        metavar="JSON",
        help="print the joined results of earlier runs, without a new run",
    )


def read_parts(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Read the records of the runs to join; an empty list without ``--join``."""
    return [json.loads(part.read_text()) for part in options.join or []]


def chosen_plan(options: argparse.Namespace, plan: _Plan, quick: _Plan) -> _Plan:
    """Choose the full or the quick plan, with fields replaced by the options of the same name."""
    start: Any = quick if options.quick else plan
    given = {name: value for name, value in vars(options).items() if value is not None}
    fields = {name: given[name] for name in given.keys() & vars(start).keys()}
    return replace(start, **{name: tuple(x) if isinstance(x, list) else x for name, x in fields.items()})


def write_record(file: Path | None, record: Mapping[str, Any]) -> None:
    """Write the results as JSON if a file is given."""
    if file is not None:
        file.write_text(json.dumps(record, indent=2) + "\n")


def machine() -> str:
    """Describe processor, accelerator and versions in one line."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        model = names[0].split(":", 1)[1].strip() if names else model
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    device = jax.devices()[0]
    where = "" if device.platform == "cpu" else f", {device.device_kind}"
    return (
        f"{model}, {cores} core{'s' if cores != 1 else ''}{where}; Python {platform.python_version()}, "
        f"jax {jax.__version__}, numpy {np.__version__}, reframe_jax {reframe_jax.__version__}"
    )


def write_metrics(file: Path | None, metrics: Mapping[str, float]) -> None:
    """Write metrics as JSON if a file is given."""
    write_record(file, {"metrics": dict(metrics)})

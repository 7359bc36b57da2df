"""What the benchmarks share: the machine they ran on, and their metrics in a file."""

import json
import os
import platform
from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np

import reframe_jax

__all__ = ["machine", "write_metrics"]


def machine() -> str:
    """Processor, accelerator and versions, in one line."""
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
    """Write metrics as JSON, if there is a file to write them to."""
    if file is not None:
        file.write_text(json.dumps({"metrics": dict(metrics)}, indent=2) + "\n")

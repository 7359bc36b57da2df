"""What the benchmarks share: timing, the machine they ran on, and their metrics in a file."""

import json
import os
import platform
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

import reframe_jax

__all__ = ["machine", "timed", "write_metrics"]


def timed(call: Callable[[], Any], repeats: int) -> tuple[Any, float, float]:
    """Result, seconds of the fastest of some warm calls, and how much longer the first one took."""
    start = time.perf_counter()
    result = jax.block_until_ready(call())
    first = time.perf_counter() - start
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - start)
    return result, min(times), first - min(times)


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

"""How the benchmarks take time and memory."""

import gc
import resource
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

__all__ = ["in_chunks", "peak_above", "timed", "timed_call"]


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


def timed_call(jitted: Any, *inputs: Any) -> tuple[Any, float, float]:
    """Result of a jitted function, seconds of its only call, and those of its compilation before."""
    start = time.perf_counter()
    compiled = jitted.lower(*inputs).compile()
    compiling = time.perf_counter() - start
    start = time.perf_counter()
    result = jax.block_until_ready(compiled(*inputs))
    return result, time.perf_counter() - start, compiling


def peak_above(call: Callable[[], Any]) -> tuple[Any, float]:
    """Result, and the resident memory in MB that the call needed at most above what was there before."""
    gc.collect()
    before, peak, running = _resident_mb(), 0.0, True

    def watch() -> None:
        nonlocal peak
        while running:
            peak = max(peak, _resident_mb())
            time.sleep(0.01)

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        result = jax.block_until_ready(call())
        peak = max(peak, _resident_mb())
    finally:
        running = False
        watcher.join()
    return result, max(0.0, peak - before)


def in_chunks(call: Callable[..., Any], *inputs: Any, size: int = 256) -> Any:
    """Results of a function of windows, N in front, on some at a time: all share a compilation.

    The last windows are repeated to fill the last chunk.
    """
    count = len(inputs[0])
    parts = []
    for start in range(0, count, size):
        rows = np.minimum(np.arange(start, start + size), count - 1)
        parts.append(call(*(x[rows] for x in inputs)))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *parts)


def _resident_mb() -> float:
    """Resident memory of this process now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20

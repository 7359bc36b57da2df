"""Measure time and memory of benchmarks."""

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
    """Return the result, the time of the fastest warm call, and the additional time of the first call, s."""
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
    """Return the result of one call of a jitted function, its run time, and its compile time, s."""
    start = time.perf_counter()
    compiled = jitted.lower(*inputs).compile()
    compiling = time.perf_counter() - start
    start = time.perf_counter()
    result = jax.block_until_ready(compiled(*inputs))
    return result, time.perf_counter() - start, compiling


def peak_above(call: Callable[[], Any]) -> tuple[Any, float]:
    """Return the result, and the peak increase of resident memory during the call, MB."""
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
    """Call a function of windows (N, ...) in chunks of one size, which need only one compilation.

    The last window is repeated to fill the last chunk.
    """
    count = len(inputs[0])
    parts = []
    for start in range(0, count, size):
        rows = np.minimum(np.arange(start, start + size), count - 1)
        parts.append(call(*(x[rows] for x in inputs)))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *parts)


def _resident_mb() -> float:
    """Current resident memory of this process, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20

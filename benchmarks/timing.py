"""How the benchmarks take time and memory."""

import gc
import resource
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from reframe_jax.compilation import compiler_options

__all__ = ["jit", "machine_floors", "peak_above", "timed", "timed_once"]


def jit(function: Callable[..., Any]) -> Any:
    """``jax.jit`` with the compiler options that ``identify`` uses."""
    return jax.jit(function, compiler_options=compiler_options())


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


def timed_once(jitted: Any, *inputs: Any) -> tuple[Any, float, float]:
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


def machine_floors() -> tuple[float, float]:
    """What this machine reaches by itself: copied bytes/s (read and written), and float64 flop/s.

    The first from adding 1 to 128 MB, the second from the product of two large matrices.
    """
    size = 1024 if jax.default_backend() == "cpu" else 8192
    long, square = jnp.zeros(2**24), jnp.ones((size, size))
    copy, product = jax.jit(lambda x: x + 1), jax.jit(lambda x: x @ x)
    return (
        2 * long.nbytes / timed(lambda: copy(long), 5)[1],
        2 * size**3 / timed(lambda: product(square), 3)[1],
    )


def _resident_mb() -> float:
    """Resident memory of this process now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20

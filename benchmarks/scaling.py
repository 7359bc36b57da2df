"""How the time per window grows with the windows, their samples, the search's starts, and the devices."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import reframe_jax as rf
from benchmarks.dual_annealing import DT, MISS
from benchmarks.timing import jit, timed
from reframe_jax.compilation import chunk_size
from reframe_jax.identification.entry import default_solver
from reframe_jax.identification.floored_moments import window_moments
from reframe_jax.simulation import synthetic

Curves = dict[str, dict[str, float]]

_BLOCK = 65536  # windows in memory at once
_ON_DEVICES = 2**23  # windows spread over accelerators
_SIMULATED = 64  # longer windows; they are repeated
_RESULT = 1200  # bytes of what is found in a window
LABELS = {
    "windows": "windows",
    "samples": "velocities per window",
    "starts": "starts of the search",
    "devices": "devices",
}


def identify_repeated(poses: np.ndarray, count: int) -> None:
    """Identify ``count`` windows, those given again and again; memory is that of one block."""
    for start in range(0, count, _BLOCK):
        rows = np.arange(start, min(start + _BLOCK, count)) % len(poses)
        jax.block_until_ready(rf.identify(poses[rows], dt=DT, compiled=True))


def _longer(samples: int) -> np.ndarray:
    """Simulated windows of so many velocities."""

    def simulate(key: jax.Array) -> jax.Array:
        return synthetic.simulate("K", key, noise=1e-5, duration=samples * DT, dt=DT).poses

    return np.asarray(jit(jax.vmap(simulate))(jax.random.split(jax.random.key(0), _SIMULATED)))


def curves(poses: np.ndarray, best: np.ndarray, *, full: bool, names: Sequence[str] | None = None) -> Curves:
    """Time per window in us along every curve; a line is printed for each point.

    Args:
        poses: (N, K+1, 4, 4) windows, repeated where a curve needs more.
        best: (N, 4) best known linear norms, to count misses along ``starts``.
        full: to a million windows.
        names: of the curves; by default all, but on an accelerator or in short none that compile for
            every point.
    """
    if names is None:
        every = full and jax.default_backend() == "cpu"
        names = tuple(LABELS) if every else ("windows", "devices")
    found: Curves = {name: {} for name in LABELS}

    def measure(curve: str, at: int, call: Callable[[], Any], count: int, repeats: int = 2) -> Any:
        result, seconds, _ = timed(call, repeats)
        found[curve][str(at)] = 1e6 * seconds / count
        print(f"  {curve:>8} {at:>8}: {1e6 * seconds / count:8.2f} us per window", end="", flush=True)
        return result

    print("scaling:")
    if "windows" in names:
        for count in (1024, 8192, 65536, 2**20) if full else (1024, 4096):
            call = partial(identify_repeated, poses, count)
            measure("windows", count, call, count, 1 if count > 1e5 else 2)
            print(flush=True)
    some = poses[np.arange(2048) % len(poses)]
    if "samples" in names:
        for samples in (25, 50, 100, 200, 400):
            long = _longer(samples)[np.arange(len(some)) % _SIMULATED]
            measure("samples", samples, partial(rf.identify, long, dt=DT), len(some))
            print(flush=True)
    if "starts" in names:
        judged = min(len(some), len(poses))
        for starts in (1, 2, 4, 6, 8, 16):
            default: Any = default_solver()
            solver = replace(default, restarts=starts)
            search = partial(rf.identify, some, dt=DT, lag=1, solver=solver)
            result = measure("starts", starts, search, len(some))
            norms = np.asarray(result.linear.norms)[:judged]
            print(
                f", {100 * np.mean(norms > MISS * best[:judged]):.2f} % of linear problems missed", flush=True
            )
    if "devices" in names:
        counts = _device_counts()
        if len(counts) == 1:
            print(f"   devices        1: {jax.devices()[0].device_kind}, no others to spread over")
        for count in counts if len(counts) > 1 else ():
            spread = _spread(poses, count, counts)
            measure("devices", count, partial(rf.identify, spread, dt=DT), len(spread))
            gain = found["devices"]["1"] / found["devices"][str(count)]
            print(f", {len(spread)} windows, {gain:.2f} times one device", flush=True)
            del spread  # so that the next fits
    return found


def _device_counts() -> list[int]:
    """1, 2, 4, ... and all devices."""
    count = len(jax.devices())
    return sorted({2**i for i in range(count.bit_length())} | {count})


def _spread(poses: np.ndarray, count: int, counts: list[int]) -> jax.Array:
    """Windows on the first devices together, as many whatever their number: what one device can hold."""
    mesh = jax.make_mesh((count,), ("windows",), devices=jax.devices()[:count])
    unit = int(np.lcm.reduce(counts)) * chunk_size()
    size = -(-_that_fit(poses[0].nbytes) // unit) * unit
    repeated = jax.jit(
        lambda poses: poses[jnp.arange(size) % len(poses)],
        out_shardings=jax.NamedSharding(mesh, jax.P("windows")),
    )
    return repeated(jax.device_put(poses, jax.NamedSharding(mesh, jax.P())))


def _that_fit(window: int) -> int:
    """Windows of so many bytes to spread: on accelerators 2**23, or what one has the memory for."""
    if jax.default_backend() == "cpu":
        return 4096
    count, limit = _ON_DEVICES, (jax.devices()[0].memory_stats() or {}).get("bytes_limit", 0)
    # beside the windows there are a piece of them, and results: the last, and this one before it is joined
    while count > chunk_size() and count * (1.3 * window + 3 * _RESULT) > limit:
        count //= 2
    return count


def spread_of_time(poses: np.ndarray) -> dict[str, float]:
    """Shares of ``identify``'s time: velocities with their moments, the search, and the rest.

    On as many windows as one processor works on in one piece, compiled in the same way. The search is
    what is saved by one that takes a single step.
    """
    chunk = chunk_size()
    windows = jnp.asarray(poses[np.arange(8 * chunk) % len(poses)])
    steps = jnp.full(windows.shape[1] - 1, DT, windows.dtype)
    chunks = windows.reshape(8, chunk, *windows.shape[1:])
    moments = jit(lambda chunks: jax.lax.map(lambda poses: window_moments(poses, steps), chunks))
    idle = rf.BasinHopping(rf.ValleySteps(1), restarts=1, hops=0, polish=0)
    whole = timed(lambda: rf.identify(windows, dt=DT, lag=1), 10)[1]
    least = timed(lambda: rf.identify(windows, dt=DT, lag=1, solver=idle), 10)[1]
    first = timed(lambda: moments(chunks), 10)[1]
    shares = {"moments": first / whole, "search": 1 - least / whole, "rest": (least - first) / whole}
    print(
        f"of the time, velocities and moments take {shares['moments']:.0%}, the search "
        f"{shares['search']:.0%}, the rest {shares['rest']:.0%}",
        flush=True,
    )
    return shares


def plot(found: Curves, file: Path) -> None:
    """Draw the curves that have at least two points."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    drawn = {name: curve for name, curve in found.items() if len(curve) > 1}
    figure, axes = plt.subplots(
        1, len(drawn), figsize=(3.4 * len(drawn), 3.2), layout="constrained", squeeze=False, sharey=True
    )
    for axis, (name, curve) in zip(axes[0], drawn.items(), strict=True):
        at = [int(point) for point in curve]
        axis.plot(at, list(curve.values()), "o-", color="#0072B2")
        axis.set_xscale("log")
        axis.set_xticks(at, [f"{point:,}" for point in at])
        axis.minorticks_off()
        axis.set_xlabel(LABELS[name])
        axis.grid(alpha=0.3)
    axes[0, 0].set_ylim(0, 1.05 * max(max(curve.values()) for curve in drawn.values()))
    axes[0, 0].set_ylabel("time per window (µs)")
    figure.savefig(file, dpi=150)
    plt.close(figure)

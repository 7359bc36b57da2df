"""Identify a million windows of one long recording with :func:`reframe_jax.identify_many`.

The recording is a memory-mapped file. Its overlapping windows are a view of the file, so a million windows of
51 poses need 128 MB on disk; copies would need 6.5 GB. At the end, the benchmark reads the results part by
part. It checks that every window has a result, and that random windows give the same result in a single call.

To resume an interrupted run, start the benchmark again with the same ``--out``.
"""

import json
import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

import reframe_jax as rf
from benchmarks.common import machine, new_parser
from benchmarks.timing import peak_above
from reframe_jax.simulation import synthetic

DT = 0.1
LENGTH = 51
_BLOCK = 10_000  # poses per simulated block


def write_recording(file: Path, poses: int) -> None:
    """Write a recording of a pin on a plane (K) with 0.1 mm of noise, as a .npy file (poses, 4, 4).

    Every block starts from the same pose, so windows across two blocks contain a jump.
    """
    out = np.lib.format.open_memmap(file, mode="w+", dtype=np.float64, shape=(poses, 4, 4))
    simulate = jax.jit(lambda key: synthetic.simulate("K", key, noise=1e-4, duration=(_BLOCK - 1) * DT).poses)
    starts = range(0, poses, _BLOCK)
    for start, key in zip(starts, jax.random.split(jax.random.key(0), len(starts)), strict=True):
        stop = min(start + _BLOCK, poses)
        out[start:stop] = np.asarray(simulate(key))[: stop - start]
    out.flush()


def check(folder: Path, windows: np.ndarray, part_size: int, again: int) -> dict[str, Any]:
    """Check that every window has a result, and that some windows give the same result in a single call.

    Raises:
        AssertionError: if a check fails.
    """
    parts = -(-len(windows) // part_size)
    rows, usable = 0, 0
    picked = np.sort(np.random.default_rng(0).choice(len(windows), min(again, len(windows)), replace=False))
    single = rf.identify(np.array(windows[picked]), dt=DT)
    worst = 0.0
    for number in range(parts):
        found = rf.load_results(folder, parts=[number])
        good = found.status_code < 10
        if not np.all(np.isfinite(found.linear.norm[good])):
            raise AssertionError(f"part {number} holds norms that are not finite in windows without a status")
        here = np.flatnonzero(picked // part_size == number)
        stored = found.linear.norm[picked[here] - number * part_size]
        worst = max(worst, float(np.max(np.abs(stored / single.linear.norm[here] - 1), initial=0)))
        rows, usable = rows + len(good), usable + int(good.sum())
    if rows != len(windows):
        raise AssertionError(f"{rows} of {len(windows)} windows have results")
    if worst > 1e-6:
        raise AssertionError(f"norms differ from those of the windows by themselves by {worst:.1e}")
    return {"usable": usable, "worst_difference": worst, "compared": len(picked)}


def run(count: int, part_size: int, folder: Path, again: int = 256) -> dict[str, Any]:
    """Identify the windows, check the results, and print and return the metrics."""
    recording = folder / "recording.npy"
    if not recording.exists():
        temporary = recording.with_name(f".{recording.name}")
        write_recording(temporary, count + LENGTH - 1)
        os.replace(temporary, recording)
    windows = rf.sliding_windows(np.load(recording, mmap_mode="r"), LENGTH)
    if len(windows) != count:
        raise ValueError(f"{recording} has {len(windows)} windows, not {count}: give another --out.")
    existing = len(list((folder / "results").glob("part-*.parquet")))
    start = time.perf_counter()
    results, peak = peak_above(
        lambda: rf.identify_many(windows, folder / "results", dt=DT, part_size=part_size, progress=True)
    )
    seconds = time.perf_counter() - start
    computed = max(0, count - existing * part_size)
    checked = check(results, windows, part_size, again)
    stored = sum(file.stat().st_size for file in results.glob("part-*.parquet"))
    print(machine())
    print(
        f"{count} windows of {LENGTH - 1} velocities, {computed} of them computed by this call in "
        f"{seconds:.1f} s: {computed / seconds:.0f} windows/s, compilation, checksums and writing included\n"
        f"peak memory {peak:.0f} MB above that before the call, the file's pages included; "
        f"results {stored / 2**20:.0f} MB\n"
        f"complete: every window has a result, {checked['usable']} are usable; {checked['compared']} "
        f"identified by themselves differ by at most {checked['worst_difference']:.0e} in norm"
    )
    return {
        "windows": count,
        "seconds": seconds,
        "windows_per_second": computed / seconds,
        "peak_memory_mb": peak,
        "results_mb": stored / 2**20,
        **checked,
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the benchmark."""
    parser = new_parser("million", __doc__)
    add = parser.add_argument
    add("--windows", type=int, default=1_000_000, help="windows to identify (1,000,000)")
    add("--part-size", type=int, default=8192, help="windows in a part (8192)")
    add("--out", type=Path, help="folder to keep recording and results in (temporary)")
    add("--json", type=Path, help="file to write the metrics to")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.out or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        metrics = run(options.windows, options.part_size, folder)
    if options.json:
        options.json.write_text(json.dumps({"machine": machine(), "metrics": metrics}, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

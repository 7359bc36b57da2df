"""Identify the sliding windows of a long recording on many machines, with Dask.

    python examples/many_machines.py RECORDING.npy OUT                 # two processes of this machine
    python examples/many_machines.py RECORDING.npy OUT --scheduler tcp://HOST:8786

RECORDING is an array of (poses, 4, 4) poses, and OUT a folder, both on a disk that every machine can read.

Start one Dask worker with one thread on every machine (or one per GPU), because identify uses all processors.
The scheduler sends only the numbers of parts, never the windows. It assigns the part of a lost worker to
another worker. An interrupted run resumes.

Dask's scheduler has no authentication: use a trusted network, or configure TLS.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from distributed import Client, LocalCluster, as_completed

import reframe_jax as rf


def open_windows(recording: Path, length: int) -> np.ndarray:
    """Open windows (length, 4, 4) as a view of the file."""
    return rf.sliding_windows(np.load(recording, mmap_mode="r"), length)


def identify_part(number: int, recording: Path, out: Path, length: int, part_size: int, dt: float) -> int:
    """Identify one part on a worker; return the number of the part."""
    rf.identify_many(
        open_windows(recording, length), out, dt=dt, part_size=part_size, parts=[number], progress=False
    )
    return number


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the example."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("recording", type=Path)
    add("out", type=Path)
    add("--dt", type=float, default=0.1, help="sample time, s (0.1)")
    add("--window", type=int, default=51, help="poses in a window (51)")
    add("--part-size", type=int, default=8192, help="windows in a part (8192)")
    add("--scheduler", help="address of a running Dask scheduler")
    add("--workers", type=int, default=2, help="processes on this machine, without a scheduler (2)")
    options = parser.parse_args(argv)
    recording, out = options.recording.resolve(), options.out.resolve()
    count = len(open_windows(recording, options.window))
    parts = -(-count // options.part_size)
    local = {"n_workers": options.workers, "threads_per_worker": 1, "dashboard_address": None}
    with Client(options.scheduler or LocalCluster(**local)) as client:
        tasks = client.map(
            identify_part,
            range(parts),
            recording=recording,
            out=out,
            length=options.window,
            part_size=options.part_size,
            dt=options.dt,
            retries=2,
        )
        for done, (_, number) in enumerate(as_completed(tasks, with_results=True), 1):
            print(f"part {number} is done, {done} of {parts}", flush=True)
    print(f"{count} windows in {out}; read them with reframe_jax.load_results")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

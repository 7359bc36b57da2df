"""The example that spreads windows over machines, on a cluster of two processes of this one."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.simulation import synthetic

pytest.importorskip("pyarrow")
pytest.importorskip("distributed", reason="needs Dask: the extra distributed")

# workers of Dask keep their programs where this process does, and find those that it compiled
PRELOAD = "import os, reframe_jax; reframe_jax.cache_programs(os.environ['JAX_COMPILATION_CACHE_DIR'])"
EXAMPLE = Path(__file__).parent.parent / "examples" / "many_machines.py"


def test_a_cluster_finds_what_one_process_finds(tmp_path):
    recording = np.asarray(synthetic.simulate("K", jax.random.key(0), noise=1e-4, duration=6.0).poses)
    np.save(tmp_path / "recording.npy", recording)
    arguments = ["recording.npy", "cluster", "--window", "21", "--part-size", "8", "--workers", "2"]
    single = rf.identify_many(
        rf.sliding_windows(recording, 21), tmp_path / "alone", dt=0.1, part_size=8, progress=False
    )
    done = subprocess.run(
        [sys.executable, EXAMPLE, *arguments],
        cwd=tmp_path,
        env=os.environ | {"DASK_DISTRIBUTED__WORKER__PRELOAD": repr([PRELOAD])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "41 windows" in done.stdout
    assert sorted(line for line in done.stdout.splitlines() if "of 6" in line)[0].startswith("part 0 is done")
    ours, theirs = rf.load_results(single), rf.load_results(tmp_path / "cluster")
    assert len(theirs.status_code) == 41
    for x, y in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_array_equal(x, y)

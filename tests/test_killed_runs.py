"""Runs that were killed: what is on disk is whole, and the rest is made when they go on."""

import os
import signal
import subprocess
import sys
import textwrap
import time

import jax
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.simulation import synthetic
from reframe_jax.storage.parts import remove_leftovers

pytest.importorskip("pyarrow")


@pytest.fixture(scope="module")
def windows():
    """(24, 21, 4, 4): enough for three parts of eight, which are computed one by one."""
    keys = jax.random.split(jax.random.key(0), 24)
    simulate = jax.vmap(lambda key: synthetic.simulate("K", key, noise=1e-4, duration=2.0).poses)
    return np.asarray(jax.jit(simulate)(keys))


CHILD = """
    import os, signal, sys
    import numpy as np
    import reframe_jax as rf
    from reframe_jax.storage import parts, results

    def die(*_):
        os.kill(os.getpid(), signal.SIGKILL)

    def half_a_file(file, write):
        write(file)
        with open(file, "r+b") as stream:
            stream.truncate(os.path.getsize(file) // 2)
        die()

    def second(file):
        return "00000001" in str(file)

    do_part, write_whole, rename = results._do_part, parts.write_whole, os.replace
    moment = sys.argv[3]
    if moment == "computing":
        calls = []
        results._do_part = lambda *a: (calls.append(a), die if len(calls) == 2 else do_part)[1](*a)
    elif moment == "writing":
        parts.write_whole = lambda file, write: write_whole(
            file, (lambda half: half_a_file(half, write)) if second(file) else write
        )
    elif moment == "renaming":
        os.replace = lambda old, new: (die if second(new) else rename)(old, new)
    rf.cache_programs(os.environ["JAX_COMPILATION_CACHE_DIR"])
    rf.identify_many(np.load(sys.argv[1], mmap_mode="r"), sys.argv[2], dt=0.1, part_size=8)
"""


def run_killed(stored, out, moment):
    """A run in a process of its own, which dies at a moment; returns its exit code."""
    arguments = [str(stored), str(out), moment]
    return subprocess.run([sys.executable, "-c", textwrap.dedent(CHILD), *arguments], check=False).returncode


def run_whole(stored, out):
    """The same run, to its end and with JAX's own settings, in this process."""
    with jax.enable_x64(False), jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        rf.identify_many(np.load(stored, mmap_mode="r"), out, dt=0.1, part_size=8)


@pytest.fixture(scope="module")
def uninterrupted(windows, tmp_path_factory):
    """The windows in a file, and the results of a run that nobody killed."""
    home = tmp_path_factory.mktemp("uninterrupted")
    np.save(home / "windows.npy", windows)
    run_whole(home / "windows.npy", home / "out")
    return home / "windows.npy", home / "out"


@pytest.mark.parametrize("moment", ["computing", "writing", "renaming"])
def test_a_run_killed_at_any_moment_redoes_one_part_at_most(moment, uninterrupted, tmp_path):
    stored, whole = uninterrupted
    killed = tmp_path / "out"
    assert run_killed(stored, killed, moment) == -signal.SIGKILL
    # the second of three parts was in flight: the first is there, and nothing that looks like the others
    (first,) = killed.glob("part-*.parquet")
    assert first.name == "part-00000000.parquet"
    before = first.stat().st_mtime_ns, first.stat().st_ino
    with pytest.raises(ValueError, match="2 parts are missing"):
        rf.load_results(killed)
    run_whole(stored, killed)
    assert (first.stat().st_mtime_ns, first.stat().st_ino) == before
    for file in sorted(whole.iterdir()):
        assert (killed / file.name).read_bytes() == file.read_bytes(), file.name
    for x, y in zip(*(jax.tree.leaves(rf.load_results(run)) for run in (whole, killed)), strict=True):
        np.testing.assert_array_equal(x, y)


def test_what_killed_writers_left_goes_when_it_is_old(uninterrupted):
    """A young file may be another machine's, at work; and other people's files are left alone."""
    stored, out = uninterrupted
    old, young, other = (
        out / name
        for name in (
            ".part-00000007.parquet.0123456789abcdef",
            ".part-00000008.parquet.fedcba9876543210",
            ".notes.txt",
        )
    )
    for file in (old, young, other):
        file.write_bytes(b"half")
    for file in (old, other):
        os.utime(file, (time.time() - 7200,) * 2)
    run_whole(stored, out)
    assert [file.exists() for file in (old, young, other)] == [False, True, True]
    for file in (young, other):
        file.unlink()


def test_a_file_that_goes_while_it_is_looked_at(tmp_path):
    """Two machines may clean up the same folder."""
    ghost = tmp_path / ".part-00000007.parquet.0123456789abcdef"
    ghost.symlink_to(tmp_path / "nowhere")
    remove_leftovers(tmp_path)
    remove_leftovers(tmp_path / "no folder")

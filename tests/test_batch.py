"""Any number of windows: parts, resuming, and what is refused."""

import subprocess
import sys
import textwrap
import threading

import jax
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.simulation import synthetic

pytest.importorskip("pyarrow")


@pytest.fixture(scope="module")
def windows():
    """(40, 33, 4, 4): enough for three parts, the last one smaller; other tests have the same program."""
    keys = jax.random.split(jax.random.key(0), 40)
    simulate = jax.vmap(lambda key: synthetic.simulate("K", key, noise=1e-4, duration=3.2).poses)
    return np.asarray(jax.jit(simulate)(keys))


@pytest.fixture(scope="module")
def expected(windows):
    return jax.device_get(rf.identify(windows, dt=0.1))


def equal(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)


def test_parts_hold_what_identify_returns(windows, expected, tmp_path):
    seen = []
    folder = rf.identify_many(
        windows, tmp_path / "out", dt=0.1, part_size=15, progress=lambda *counts: seen.append(counts)
    )
    assert seen == [(15, 40), (30, 40), (40, 40)]
    found = rf.load_results(folder)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    np.testing.assert_array_equal(found.name, expected.name)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-6)


def test_an_interrupted_run_resumes_and_ends_with_the_same_bytes(windows, tmp_path):
    whole = rf.identify_many(windows, tmp_path / "whole", dt=0.1, part_size=15)

    def killed(done, total):
        if done == 15:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rf.identify_many(windows, tmp_path / "resumed", dt=0.1, part_size=15, progress=killed)
    first = tmp_path / "resumed" / "part-00000000.parquet"
    before = first.stat().st_mtime_ns
    resumed = rf.identify_many(windows, tmp_path / "resumed", dt=0.1, part_size=15)
    assert first.stat().st_mtime_ns == before
    equal(rf.load_results(whole), rf.load_results(resumed))


def test_no_windows_have_an_empty_result(windows):
    none = windows[:0]
    found = rf.identify(none, dt=0.1)
    assert (found.linear.position.shape, found.name.shape, found.counted.shape) == (
        (0, 3),
        (0,),
        none.shape[:2],
    )
    assert rf.covariance(found, none, dt=0.1).matrix.shape == (0, 9, 9)
    assert rf.identify(none[None], dt=0.1).linear.position.shape == (1, 0, 3)


def test_an_iterator_that_breaks_keeps_its_parts_and_can_resume(windows, tmp_path):
    def broken():
        yield from windows[:20]
        raise OSError("the disk is gone")

    with pytest.raises(OSError, match="gone"):
        rf.identify_many(broken(), tmp_path / "out", dt=0.1, part_size=15)
    assert len(rf.load_results(tmp_path / "out").status_code) == 15
    rf.identify_many(iter(windows[:25]), tmp_path / "out", dt=0.1, part_size=15)
    assert len(rf.load_results(tmp_path / "out").status_code) == 25
    (tmp_path / "out" / "part-00000000.parquet").unlink()
    with pytest.raises(ValueError, match="incomplete"):
        rf.load_results(tmp_path / "out")


def test_parts_can_be_loaded_one_by_one(windows, tmp_path):
    folder = rf.identify_many(windows, tmp_path / "out", dt=0.1, part_size=15)
    whole, last = rf.load_results(folder), rf.load_results(folder, parts=[2])
    equal(jax.tree.map(lambda leaf: leaf[30:], whole), last)
    with pytest.raises(ValueError, match=r"\[3\] among them"):
        rf.load_results(folder, parts=[0, 3])


def test_the_next_part_is_read_while_one_is_computed(windows, tmp_path, monkeypatch):
    from reframe_jax.storage import results as batch

    read = threading.Event()
    do_part = batch._do_part

    def patient(*arguments):
        assert read.wait(60), "the second part was not read before the first was done"
        return do_part(*arguments)

    def source():
        for i, window in enumerate(windows[:30]):
            if i == 29:
                read.set()
            yield window

    monkeypatch.setattr(batch, "_do_part", patient)
    rf.identify_many(source(), tmp_path / "out", dt=0.1, part_size=15)


def test_the_bar_shows_the_share_done(windows, tmp_path, capsys):
    rf.identify_many(windows, tmp_path / "out", dt=0.1, part_size=20, progress=True)
    first, second = capsys.readouterr().err.strip("\r\n").split("\r")
    assert first.startswith("[##########----------] 20 of 40 windows, ")
    assert second.startswith("[####################] 40 of 40 windows, ")
    assert second.rstrip().endswith(", 0 s left")


def test_machines_can_share_the_parts(windows, tmp_path):
    whole = rf.identify_many(windows, tmp_path / "whole", dt=0.1, part_size=15)
    rf.identify_many(windows, tmp_path / "shared", dt=0.1, part_size=15, parts=[0, 2])
    with pytest.raises(ValueError, match=r"1 parts are missing, \[1\]"):
        rf.load_results(tmp_path / "shared")
    rf.identify_many(windows, tmp_path / "shared", dt=0.1, part_size=15, parts=[1])
    equal(rf.load_results(whole), rf.load_results(tmp_path / "shared"))


def test_memory_mapped_windows_and_times_of_every_window(windows, expected, tmp_path):
    np.save(tmp_path / "windows.npy", windows)
    mapped = np.load(tmp_path / "windows.npy", mmap_mode="r")
    times = np.tile(0.1 * np.arange(33), (40, 1))
    found = rf.load_results(rf.identify_many(mapped, tmp_path / "out", times=times, part_size=20))
    np.testing.assert_allclose(found.linear.norm, expected.linear.norm, rtol=1e-6)


def test_a_bad_window_is_stored_with_its_status(windows, tmp_path):
    bad = windows[:16].copy()
    bad[3, 4] = np.nan
    found = rf.load_results(rf.identify_many(bad, tmp_path / "out", dt=0.1))
    assert np.flatnonzero(found.status_code).tolist() == [3]
    assert found.status_code[3] == rf.Status.NOT_FINITE


def test_other_windows_or_options_are_not_mixed_in(windows, tmp_path):
    out = tmp_path / "out"
    rf.identify_many(windows[:16], out, dt=0.1)
    with pytest.raises(ValueError, match=r"other options \(bounds\)"):
        rf.identify_many(windows[:16], out, dt=0.1, bounds=0.5)
    with pytest.raises(ValueError, match="results of other windows"):
        rf.identify_many(windows[1:17], out, dt=0.1)
    with pytest.raises(ValueError, match="results of other windows"):
        rf.identify_many(windows[:16], out, dt=0.2)


def test_bad_input_is_refused_in_words(windows, tmp_path):
    with pytest.raises(ValueError, match="window 1 has"):
        rf.identify_many([windows[0], windows[1, :9]], tmp_path / "a", dt=0.1)
    with pytest.raises(ValueError, match="one row per window"):
        rf.identify_many(windows, tmp_path / "b", times=np.zeros((39, 33)))
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="is a file; expected a folder"):
        rf.identify_many(windows, tmp_path / "file", dt=0.1)
    with pytest.raises(ValueError, match="part_size"):
        rf.identify_many(windows, tmp_path / "c", dt=0.1, part_size=0)
    with pytest.raises(ValueError, match="no results"):
        rf.load_results(tmp_path)
    with pytest.raises(ValueError, match="part_size must be a whole number"):
        rf.identify_many(windows, tmp_path / "d", dt=0.1, part_size=2.5)
    with pytest.raises(ValueError, match="at least one part"):
        rf.load_results(rf.identify_many(windows[:16], tmp_path / "e", dt=0.1), parts=[])


def test_float64_is_kept_where_jax_is_set_to_float32(windows, expected, tmp_path):
    script = """
        import os, sys, numpy as np, reframe_jax as rf
        rf.cache_programs(os.environ["JAX_COMPILATION_CACHE_DIR"])
        rf.identify_many(np.load(sys.argv[1]), sys.argv[2], dt=0.1, part_size=16)
    """
    np.save(tmp_path / "windows.npy", windows[:16])
    arguments = [str(tmp_path / "windows.npy"), str(tmp_path / "out")]
    subprocess.run([sys.executable, "-c", textwrap.dedent(script), *arguments], check=True)
    found = rf.load_results(tmp_path / "out")
    assert found.linear.norm.dtype == np.float64
    np.testing.assert_allclose(found.linear.norm, expected.linear.norm[:16], rtol=1e-9)

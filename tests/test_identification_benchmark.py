"""The benchmark of identify: what it measures with, its gate, and the whole of it in miniature."""

import json
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import identification, million, timing

ROOT = Path(__file__).parent.parent
METRICS = {"speedup": 9000.0, "speedup_general_search": 300.0, "miss_rate": 0.001}


@pytest.fixture
def baseline(tmp_path):
    """A file of metrics, changed as asked."""

    def write(**changes):
        file = tmp_path / "baseline.json"
        file.write_text(json.dumps({"metrics": METRICS | changes}))
        return file

    return write


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({}, []),
        ({"speedup": 17999.0}, []),
        ({"speedup": 18001.0}, ["speedup is"]),
        ({"speedup_general_search": 1000.0}, ["speedup_general_search is"]),
        ({"miss_rate": 0.0}, []),
    ],
)
def test_the_gate_names_what_became_worse(baseline, changes, named):
    problems = identification.gate(METRICS, baseline(**changes))
    assert len(problems) == len(named)
    assert all(problem.startswith(name) for problem, name in zip(problems, named, strict=True))


def test_the_gate_names_misses(baseline):
    assert identification.gate(METRICS | {"miss_rate": 0.0021}, baseline())
    assert not identification.gate(METRICS | {"miss_rate": 0.0019}, baseline())


def test_the_command_exits_with_1_on_a_doctored_baseline(baseline, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(identification, "run", lambda size: METRICS)
    arguments = ["--quick", "--gate", "--baseline"]
    assert identification.main([*arguments, str(baseline())]) == 0
    assert identification.main([*arguments, str(baseline(speedup=1e6))]) == 1
    assert "REGRESSION: speedup" in capsys.readouterr().out
    file = tmp_path / "out.json"
    assert identification.main(["--quick", "--json", str(file)]) == 0
    assert json.loads(file.read_text())["metrics"] == METRICS


def test_the_committed_baseline_has_what_the_gate_reads():
    stored = json.loads(identification.BASELINE.read_text())["metrics"]
    assert {*identification.GATED, "miss_rate"} <= set(stored)
    nothing = dict.fromkeys(identification.GATED, 0.0) | {"miss_rate": 1.0}
    problems = identification.gate(nothing, identification.BASELINE)
    assert [problem.split()[0] for problem in problems] == list(nothing)


def test_peak_memory_is_that_of_the_call():
    _, none = timing.peak_above(lambda: None)
    _, some = timing.peak_above(lambda: np.ones(2**25).sum())
    assert some - none > 200  # of 256 MB


def test_chunks_of_one_size():
    seen = []

    def double(x):
        seen.append(x.shape)
        return 2 * x

    x = np.arange(19.0)
    np.testing.assert_array_equal(timing.in_chunks(double, x, size=8), 2 * x)
    assert seen == [(8,)] * 3


def test_compilation_is_apart_from_the_call():
    traced = []

    def double(x):
        traced.append(x)
        return 2 * x

    result, seconds, compiling = timing.timed_call(jax.jit(double), jnp.ones(3))
    np.testing.assert_array_equal(result, [2, 2, 2])
    assert len(traced) == 1
    assert seconds > 0
    assert compiling > 0


def test_a_few_of_a_million_windows(tmp_path, monkeypatch):
    pytest.importorskip("pyarrow")
    monkeypatch.setattr(million, "_BLOCK", 30)
    metrics = million.run(75, 32, tmp_path, again=10)
    assert metrics["windows"] == metrics["usable"] == 75
    assert metrics["compared"] == 10
    last = tmp_path / "results" / "part-00000002.parquet"
    last.unlink()
    with pytest.raises(ValueError, match="incomplete"):
        million.check(
            tmp_path / "results", million.rf.sliding_windows(np.load(tmp_path / "recording.npy"), 51), 32, 10
        )


@pytest.mark.slow
def test_the_quick_benchmark_prints_and_writes_its_metrics(tmp_path):
    command = [sys.executable, "-m", "benchmarks.identification", "--quick"]
    done = subprocess.run(
        [*command, "--json", str(tmp_path / "out.json")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    record = json.loads((tmp_path / "out.json").read_text())
    metrics = record["metrics"]
    named = {"windows_per_second", "speedup", "miss_rate", "latency_ms", "compile_s", "peak_memory_mb"}
    assert named <= set(metrics)
    assert metrics["miss_rate"] <= 0.02 < metrics["miss_rate_dual_annealing"]
    for contestant in ("identify", "general search", "dual annealing"):
        assert contestant in done.stdout

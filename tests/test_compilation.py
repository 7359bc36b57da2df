"""The number of compiled programs and their size, and the indices of batches."""

import os
import subprocess
import sys
from typing import Any

import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax import compilation
from reframe_jax.compilation import PROGRAMS, Program, _take_row, _take_rows, index_leaves, pipeline
from reframe_jax.identification.pipeline import prepare
from reframe_jax.simulation import synthetic


@pytest.fixture
def on_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Index arrays as on a GPU."""
    monkeypatch.setattr(compilation, "_on_one_cpu", lambda _: False)


def test_a_row_of_all_arrays_is_taken_by_one_program(on_gpu: None) -> None:
    batch = {"one": jnp.arange(8.0), "two": jnp.arange(24).reshape(8, 3) > 4, "three": jnp.ones((8, 2, 2))}
    before = _take_row._cache_size()
    for row in (0, 3, -1, 7):
        taken = index_leaves(batch, row)
        for name, leaf in batch.items():
            assert taken[name].dtype == leaf.dtype
            np.testing.assert_array_equal(taken[name], np.asarray(leaf)[row])
    assert _take_row._cache_size() == before + 1
    np.testing.assert_array_equal(index_leaves(batch, np.int64(5))["one"], 5.0)


def test_consecutive_rows_too(on_gpu: None) -> None:
    batch = {"one": jnp.arange(8.0), "two": jnp.ones((8, 2))}
    before = _take_rows._cache_size()
    for rows in (slice(0, 3), slice(2, 5), slice(-3, None)):
        np.testing.assert_array_equal(index_leaves(batch, rows)["one"], np.arange(8.0)[rows])
    assert _take_rows._cache_size() == before + 1
    assert index_leaves(batch, slice(5, 2))["two"].shape == (0, 2)
    assert index_leaves(batch, slice(6, 100))["two"].shape == (2, 2)


@pytest.mark.parametrize(
    "index", [slice(None, None, 2), np.array([0, 2]), (Ellipsis, 0), None, np.array([True, False, True])]
)
@pytest.mark.parametrize("place", ["cpu", "gpu"])
def test_other_indices_are_those_of_arrays(index: Any, place: str, request: pytest.FixtureRequest) -> None:
    if place == "gpu":
        request.getfixturevalue("on_gpu")
    values = np.arange(12.0).reshape(3, 4)
    taken = index_leaves({"one": jnp.asarray(values)}, index)["one"]
    assert isinstance(taken, jax.Array)
    np.testing.assert_array_equal(taken, values[index])


def test_numpy_arrays_stay_what_they_are() -> None:
    assert isinstance(index_leaves({"one": np.ones((2, 2))}, 0)["one"], np.ndarray)
    with pytest.raises(IndexError):  # of a single window there is no first one
        index_leaves({"one": jnp.ones(())}, 0)


def test_rows_that_do_not_exist_are_refused() -> None:
    batch = {"one": jnp.arange(8.0), "two": jnp.ones((8, 2))}
    for row in (8, -9):
        with pytest.raises(IndexError, match=rf"no row {row}: the arrays have 8 rows"):
            index_leaves(batch, row)


def count_equations(jaxpr: jax.extend.core.Jaxpr) -> int:
    """Equations of a program and of the programs in it."""
    inner = [
        getattr(value, "jaxpr", value)
        for equation in jaxpr.eqns
        for values in equation.params.values()
        for value in (values if isinstance(values, list | tuple) else [values])
    ]
    programs = [value for value in inner if isinstance(value, jax.extend.core.Jaxpr)]
    return len(jaxpr.eqns) + sum(map(count_equations, programs))


def test_the_program_stays_small() -> None:
    """The time of the compiler grows with the number of equations, most of all of long windows."""
    shape = jax.ShapeDtypeStruct((1024, 4, 4), jnp.float64)
    with jax.enable_x64(True):
        program = jax.make_jaxpr(lambda window: rf.identify(window, dt=0.1))(shape)
    assert 1_000 < count_equations(program.jaxpr) <= 12_000


@pytest.mark.parametrize("options", [{}, {"scales": 1, "thresholds": rf.Thresholds()}])
def test_programs_do_not_call_lapack(options: dict[str, Any]) -> None:
    """Its calls wait for threads that may all wait in other programs, which run at the same time."""

    def run(poses: jax.Array) -> Any:
        found = rf.identify(poses, dt=0.1, **options)
        return found, rf.covariance(found, poses, dt=0.1), rf.excitation(found, poses, dt=0.1)

    with jax.enable_x64(True):
        program = jax.jit(run).lower(jax.ShapeDtypeStruct((16, 51, 4, 4), jnp.float64))
    assert "lapack" not in program.as_text()
    inverse = jax.jit(jnp.linalg.inv).lower(jnp.zeros((2, 3, 3)))
    assert jax.default_backend() != "cpu" or "lapack" in inverse.as_text()


PRINT_HASH = """
import hashlib, jax, jax.numpy as jnp, reframe_jax as rf
jax.config.update("jax_enable_x64", True)
window = jax.ShapeDtypeStruct((51, 4, 4), jnp.float64)
program = str(jax.make_jaxpr(lambda poses: rf.identify(poses, dt=0.1))(window))
print(hashlib.sha256(program.encode()).hexdigest())
"""


def test_every_process_builds_the_same_program() -> None:
    """Otherwise a later process does not find the program in the compilation cache."""
    hashes = set()
    for seed in ("1", "2"):
        environment = os.environ | {"PYTHONHASHSEED": seed}
        run = [sys.executable, "-c", PRINT_HASH]
        done = subprocess.run(run, env=environment, check=True, capture_output=True, text=True)
        hashes.add(done.stdout.strip())
    assert len(hashes) == 1


def test_all_programs_of_a_pipeline_are_traced_before_the_first_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    # a program that the last run kept is not traced
    monkeypatch.setattr(compilation, "can_keep", lambda static: False)
    calls: list[str] = []

    def double(x: jax.Array) -> dict[str, jax.Array]:
        calls.append("trace double")
        return {"twice": 2 * x}

    def add(x: jax.Array, *, more: int) -> jax.Array:
        calls.append("trace add")
        return x + more

    doubled, added = Program(double, ()), Program(add, ("more",))

    def function(x: Any, *, more: int) -> Any:
        twice = doubled(x)["twice"]
        calls.append("shape" if isinstance(twice, jax.ShapeDtypeStruct) else "number")
        return added(twice, more=more)

    whole = pipeline(function)
    for x in (np.arange(3.0), np.arange(3.0) + 1):
        np.testing.assert_array_equal(whole(x, more=1), 2 * x + 1)
    assert calls == ["trace double", "shape", "trace add", "number", "number"]
    np.testing.assert_array_equal(jax.vmap(lambda x: whole(x, more=1))(np.eye(2)), 2 * np.eye(2) + 1)


def test_error_bars_prepare_windows_with_the_program_of_identify() -> None:
    poses = np.asarray(synthetic.simulate("K", jax.random.key(0), noise=1e-4).poses)

    def programs() -> int:
        return sum(program is prepare for program, *_ in PROGRAMS)

    for windows in (poses, np.tile(poses, (20, 1, 1, 1))):
        found = rf.identify(windows, dt=0.1)
        before = programs()
        rf.covariance(found, windows, dt=0.1)
        assert programs() == before > 0


def test_the_first_call_compiles_few_programs(caplog: pytest.LogCaptureFixture) -> None:
    """Operations on constants are part of the program, and not programs of their own."""
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 0, 3] = np.arange(6) ** 2
    with jax.log_compiles():
        rf.identify(poses, dt=0.1)
    compiled = [record for record in caplog.records if "Finished XLA compilation" in record.getMessage()]
    assert len(compiled) <= 10


def test_other_lengths_numbers_of_windows_and_scales_compile_nothing(
    caplog: pytest.LogCaptureFixture,
) -> None:
    poses = np.asarray(synthetic.simulate("K", jax.random.key(0), noise=1e-4).poses)

    def use(length: int, number: int, scales: Any) -> None:
        window, windows = poses[:length], np.tile(poses[:length], (number, 1, 1, 1))
        found = rf.identify(window, dt=0.1, scales=scales)
        rf.covariance(found, window, dt=0.1, scales=scales)
        batch = rf.identify(windows, dt=0.1, scales=scales)
        for part in (batch[3], batch[2:5], batch[np.asarray(batch.status_code) == 0]):
            assert set(np.ravel(part.name)) == {"Pin-plane contact"}

    with jax.enable_x64(False):  # as JAX is set by default: results are rounded
        use(51, 20, "auto")
        caplog.clear()
        with jax.log_compiles():
            use(47, 23, (2, 4))
            use(51, 20, "mean")
    assert not [record for record in caplog.records if "Finished XLA compilation" in record.getMessage()]

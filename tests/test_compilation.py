"""Options of the compiler, kernels, and programs that take windows out of a batch."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from reframe_jax.compilation import (
    _take_row,
    _take_rows,
    as_one_kernel,
    compiler_options,
    index_leaves,
    once,
    pack,
    unpack,
    with_kernels,
)
from reframe_jax.identification import programs
from reframe_jax.identification.entry import default_solver
from reframe_jax.identification.options import make_space

_NOT_IN_KERNELS = {"scatter", "scatter-add", "scatter_add", "sort", "top_k", "dot_general"}


@pytest.mark.parametrize(
    ("flags", "level"),
    [(None, 1), ("--xla_cpu_enable_fast_math=false", 1), ("--xla_backend_optimization_level=0", None)],
)
def test_a_level_that_the_caller_chose_wins(
    flags: str | None, level: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    if flags is None:
        monkeypatch.delenv("XLA_FLAGS", raising=False)
    else:
        monkeypatch.setenv("XLA_FLAGS", flags)
    assert compiler_options("cpu", single=True).get("xla_backend_optimization_level") == level
    assert "xla_backend_optimization_level" not in compiler_options("cpu")


def test_a_row_of_all_arrays_is_taken_by_one_program() -> None:
    batch = {"one": jnp.arange(8.0), "two": jnp.arange(24).reshape(8, 3) > 4, "three": jnp.ones((8, 2, 2))}
    before = _take_row._cache_size()
    for row in (0, 3, -1, 7):
        taken = index_leaves(batch, row)
        for name, leaf in batch.items():
            assert taken[name].dtype == leaf.dtype
            np.testing.assert_array_equal(taken[name], np.asarray(leaf)[row])
    assert _take_row._cache_size() == before + 1
    np.testing.assert_array_equal(index_leaves(batch, np.int64(5))["one"], 5.0)


def test_consecutive_rows_too() -> None:
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
def test_other_indices_are_those_of_arrays(index: Any) -> None:
    values = np.arange(12.0).reshape(3, 4)
    np.testing.assert_array_equal(index_leaves({"one": jnp.asarray(values)}, index)["one"], values[index])


def test_numpy_arrays_stay_what_they_are() -> None:
    assert isinstance(index_leaves({"one": np.ones((2, 2))}, 0)["one"], np.ndarray)
    with pytest.raises(IndexError):  # of a single window there is no first one
        index_leaves({"one": jnp.ones(())}, 0)


def _halve_and_add(values: jax.Array, more: dict[str, jax.Array]) -> tuple[jax.Array, jax.Array]:
    """With marks, a loop and a sum; ``more["unused"]`` is not used."""
    halves = once(values / 2)
    total = jax.lax.fori_loop(0, 3, lambda _, x: once(jnp.sin(x)) + halves, values)
    return total * more["factor"], jnp.sum(once(halves), axis=0)


def _kernels_in_a_loop(values: jax.Array, more: dict[str, jax.Array]) -> tuple[jax.Array, jax.Array]:
    """What is constant in a loop is an argument that the kernel need not use."""

    def step(_: int, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        return as_one_kernel(_halve_and_add, carry[0], more)

    return jax.lax.fori_loop(0, 4, step, (values, jnp.zeros(values.shape[1:])))


def test_a_kernel_computes_what_its_function_does() -> None:
    values, more = (
        jnp.linspace(0, 1, 12).reshape(3, 4),
        {"factor": jnp.full((1, 4), 0.5), "unused": jnp.ones(7)},
    )
    plain = jax.jit(_kernels_in_a_loop)
    kernels = jax.jit(with_kernels(_kernels_in_a_loop), compiler_options=compiler_options("cpu"))
    assert "xla_cpu_small_call" not in plain.lower(values, more).as_text()
    assert "xla_cpu_small_call" in kernels.lower(values, more).as_text()
    for found, expected in zip(kernels(values, more), plain(values, more), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-15)


def test_large_arrays_are_no_kernel() -> None:
    large = jnp.ones((2, 1 << 18))
    program = jax.jit(with_kernels(lambda values: as_one_kernel(jnp.sin, values)))
    assert "xla_cpu_small_call" not in program.lower(large).as_text()
    assert "xla_cpu_small_call" in program.lower(large[:, :9]).as_text()


def _operations(jaxpr: Any, inside: bool = False) -> Iterator[str]:
    """Names of all operations inside kernels."""
    for equation in jaxpr.eqns:
        if inside:
            yield equation.primitive.name
        called = equation.primitive.name == "xla_metadata_call"
        marks = {name: value for name, value in equation.params.items() if name != "jaxpr"}
        kernel = inside or (called and "xla_cpu_small_call" in str(marks))
        for value in equation.params.values():
            for inner in value if isinstance(value, tuple | list) else (value,):
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from _operations(inner, kernel)


@pytest.mark.parametrize(("dtype", "norm"), [(np.float64, 0.0), (np.float32, 1.0)])
def test_kernels_hold_what_they_may(dtype: np.dtype, norm: float) -> None:
    """XLA refuses programs with other operations in a kernel, in some versions of JAX."""
    poses, steps = np.broadcast_to(np.eye(4, dtype=dtype), (1, 21, 4, 4)), np.ones(20, dtype)
    reduced = programs.reduce_one.trace(poses, steps, None, None, rule="auto", discretization="chord")
    evidence, _ = reduced.out_info
    searched = {"rule": "auto", "exponent": norm, "solver": default_solver(norm)}
    solved = programs.solve_one.trace(evidence, None, make_space(None, dtype), None, **searched)
    found = set(_operations(reduced.jaxpr)) | set(_operations(solved.jaxpr))
    assert {"mul", "scan", "reduce_sum"} <= found
    assert not found & _NOT_IN_KERNELS


def test_packed_arrays_come_back() -> None:
    tree = {"one": jnp.arange(6.0).reshape(2, 3), "two": [jnp.ones((), bool), jnp.arange(4)], "none": None}
    packed = jax.jit(pack)(tree)
    assert {name: vector.shape for name, vector in packed.vectors.items()} == {
        "bool": (1,),
        "float64": (6,),
        "int64": (4,),
    }
    back = jax.jit(unpack)(packed)
    assert jax.tree.structure(back) == jax.tree.structure(tree)
    for one, other in zip(jax.tree.leaves(back), jax.tree.leaves(tree), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)

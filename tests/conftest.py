"""Configuration of every test: double precision.

A test of single precision asks for it by dtype; nothing in the library reads these settings.

Most of the time of a run goes into compiling. Every program, however small, is therefore kept in
``.jax_cache`` of the checkout, which workers, child processes (notebooks, scripts) and later runs share;
``make clean`` deletes it. The largest are not even traced again: do not replace a function or a constant that
a traced function uses. XLA takes the faster of its code generators, and LLVM optimises nothing: programs
compile in a third of the time, and the tests run each of them few times. ``XLA_FLAGS= make test`` tests the
machine code that users run. Variables set by the caller win.
"""

import builtins
import ctypes
import gc
import os
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

# LLVM gets a program whole: splitting it for threads saves nothing where workers fill the processors
_FLAGS = "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
# as reframe_jax.compilation.COMPILER_OPTIONS and the command line
if version("jax").startswith("0.10."):
    _FLAGS += " --xla_cpu_use_fusion_emitters=false"
else:
    _FLAGS += " --xla_backend_extra_options=xla_cpu_disable_new_fusion_emitters"

# JAX reads these when it is imported; child processes inherit them
for _name, _value in {
    "JAX_COMPILATION_CACHE_DIR": str(Path(__file__).parent.parent / ".jax_cache"),
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    "REFRAME_JAX_CACHE": "0",  # or else later tests keep their programs in the user's cache
    "XLA_FLAGS": _FLAGS,
}.items():
    os.environ.setdefault(_name, _value)

import hypothesis
import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import reframe_jax as rf
from reframe_jax.compilation import PROGRAMS

jax.config.update("jax_enable_x64", True)
rf.cache_programs(os.environ["JAX_COMPILATION_CACHE_DIR"])

# in this order, first of all: no worker waits for them at the end, and two that run at the same time share
# few programs, which both workers would compile
_LONGEST = (
    "test_documentation.py",
    "test_global.py",
    "test_notebooks.py",
    "test_covariance.py",
    "test_devices.py",
    "test_viewer.py",
    "test_derivatives.py",
)


# bytes that a process may hold after a module. A module adds up to 1.2 GB; a process stays below 3 GB
_MOST_MEMORY = 2e9

hypothesis.settings.register_profile("repeatable", derandomize=True, database=None, deadline=None)
hypothesis.settings.load_profile("repeatable")


# JAX makes millions of objects while it traces. Python would look through all of them again and again for
# cycles, for a sixth of the time; nothing that is imported ever goes away.
gc.collect()
gc.freeze()
gc.set_threshold(100_000, 50, 1000)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest files: a worker gets a whole file at a time."""
    rank = {name: number for number, name in enumerate(_LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.name, len(rank)))


@pytest.fixture(scope="module", autouse=True)
def _free_programs(request: pytest.FixtureRequest) -> Iterator[None]:
    """Programs are kept for the modules that follow, until they fill the memory.

    What a module compiled for itself goes with it.
    """
    yield
    for value in vars(request.module).values():
        if hasattr(value, "clear_cache") and getattr(value, "__module__", None) == request.module.__name__:
            value.clear_cache()
    if _resident_memory() > _MOST_MEMORY:
        _trim_memory()  # compiling leaves a quarter of it behind, free but not given back
    if _resident_memory() > _MOST_MEMORY:
        jax.clear_caches()
        PROGRAMS.clear()
        gc.collect()
        _trim_memory()


def _trim_memory() -> None:
    """Give free memory back to the system, where the C library can: glibc's does when asked to."""
    libc = ctypes.CDLL(None)
    if hasattr(libc, "malloc_trim"):
        libc.malloc_trim(0)


def _resident_memory() -> float:
    """Bytes that this process holds; infinite where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return float("inf")
    return float(pages * os.sysconf("SC_PAGE_SIZE"))


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers that are the same in every run, whatever other tests draw."""
    return np.random.default_rng(20250101)


@pytest.fixture
def no_matplotlib(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if Matplotlib were not installed."""
    real = builtins.__import__

    def without(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)


@pytest.fixture
def table(rng: np.random.Generator) -> np.ndarray:
    """(9, 8): t, x, y, z, qx, qy, qz, qw of a wandering body."""
    times = np.cumsum(rng.uniform(0.02, 0.1, 9))
    return np.column_stack([times, rng.normal(size=(9, 3)), Rotation.random(9, rng).as_quat()])

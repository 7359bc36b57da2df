"""Configuration of every test: double precision, and no silent promotion of types or ranks.

A test of single precision asks for it by dtype; nothing in the library reads these settings. Programs that
several processes need (workers, notebooks, scripts) are compiled once and kept in a folder of this run.
"""

import builtins
import os
import tempfile
from typing import Any

CACHE = "JAX_COMPILATION_CACHE_DIR"  # JAX reads it when it is imported; child processes inherit it
if CACHE not in os.environ:
    _folder = tempfile.TemporaryDirectory(prefix="reframe-jax-")
    os.environ[CACHE] = _folder.name

import hypothesis
import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

hypothesis.settings.register_profile("repeatable", derandomize=True, database=None, deadline=None)
hypothesis.settings.load_profile("repeatable")


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

"""Programs that are kept between processes."""

import os
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax import program_cache
from reframe_jax.compilation import Program
from reframe_jax.motion.kinematics import split_poses

pytest.importorskip("flatbuffers")

PROCESS = """
import sys
import jax.numpy as jnp
import reframe_jax as rf
from reframe_jax.compilation import Program

traced = 0

def add(arrays, last, *, power):
    global traced
    traced += 1
    return {"sum": (arrays["x"] + last) ** power, "last": (last,)}

rf.cache_programs(sys.argv[1])
program = Program(add, ("power",))
for x in (jnp.arange(3.0), jnp.arange(3.0) + 1, jnp.arange(4.0)):
    found = program({"x": x}, jnp.float32(1), power=2)
    assert found["sum"].tolist() == ((x + 1) ** 2).tolist()
    assert found["last"][0] == 1
print(traced)
"""


def run(folder: Path) -> tuple[str, str]:
    """What a new process prints."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    command = [sys.executable, "-c", PROCESS, str(folder)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return done.stdout.strip(), done.stderr


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a first process; tests that damage it also see it repaired."""
    folder = tmp_path_factory.mktemp("first")
    assert run(folder)[0] == "2"
    return folder


def test_a_later_process_does_not_trace(first: Path) -> None:
    assert len(list((first / "programs").iterdir())) == 2
    assert run(first)[0] == "0"


def test_a_damaged_file_is_replaced(first: Path) -> None:
    one, other = (first / "programs").iterdir()
    whole = one.read_bytes()
    one.write_bytes(whole[:-10])
    other.write_bytes(b"")
    assert run(first)[0] == "2"
    assert len(one.read_bytes()) == len(whole)
    assert run(first)[0] == "0"


def test_a_compiled_program_that_cannot_be_read_is_replaced(first: Path) -> None:
    entries = list(first.glob("jit_*-cache"))
    whole = [entry.read_bytes() for entry in entries]
    for entry in entries:
        entry.write_bytes(b"damaged")
    assert run(first) == ("0", "")
    for entry, content in zip(entries, whole, strict=True):
        assert len(entry.read_bytes()) > len(content) / 2


def test_a_folder_that_cannot_be_written_costs_no_answer(tmp_path: Path) -> None:
    (tmp_path / "programs").write_text("a file, not a folder")
    assert run(tmp_path)[0] == "2"


def test_results_and_other_arrays_use_one_program(caplog: pytest.LogCaptureFixture) -> None:
    """JAX binds results to a device, and would compile a second program for arrays that are not bound."""
    program = Program(lambda x: [2 * x], ())
    (result,) = program(np.arange(3.0))
    assert result.committed
    free = jnp.arange(3.0)
    with jax.log_compiles():
        for array in (result, free):
            np.testing.assert_array_equal(program(array)[0], 2 * np.asarray(array))
    assert not [record for record in caplog.records if "jit(call)" in record.getMessage()]


@pytest.fixture
def settings(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What is set in ``jax.config``, which stays as it is."""
    changed: dict[str, Any] = {}
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)  # put back afterwards
    monkeypatch.setattr(program_cache, "_folder", None)
    monkeypatch.setattr(jax.config, "update", changed.__setitem__)
    return changed


def test_the_default_folder_is_where_caches_belong(
    monkeypatch: pytest.MonkeyPatch, settings: dict[str, Any], tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert rf.cache_programs() == tmp_path / "reframe_jax"
    assert settings["jax_compilation_cache_dir"] == str(tmp_path / "reframe_jax")
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    assert rf.cache_programs() == tmp_path / ".cache" / "reframe_jax"


def test_other_warnings_are_shown(
    monkeypatch: pytest.MonkeyPatch, settings: dict[str, Any], tmp_path: Path
) -> None:
    shown: list[str] = []
    monkeypatch.setattr(warnings, "showwarning", lambda message, *_, **__: shown.append(str(message)))
    rf.cache_programs(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.warn("something else", stacklevel=1)
    assert shown == ["something else"]


def test_programs_with_code_of_others_are_not_kept(settings: dict[str, Any], tmp_path: Path) -> None:
    plain = {"scales": (1, 2), "exponent": 0.0, "solver": None, "function": split_poses}
    assert not program_cache.can_keep(plain)
    rf.cache_programs(tmp_path)
    assert program_cache.can_keep(plain)
    assert not program_cache.can_keep(plain | {"solver": rf.BasinHopping(rf.ValleySteps(6))})
    assert not program_cache.can_keep(plain | {"function": run})
    assert not program_cache.can_keep(plain | {"function": lambda x: x})

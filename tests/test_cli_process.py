"""The command line as a process: interruptions, broken streams, and how soon it answers."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import reframe_jax

LONG = 120  # s, after which a process hangs

STUCK = """
import ctypes
from reframe_jax.cli import program

def compile():
    libc, mutex = ctypes.CDLL(None), ctypes.create_string_buffer(128)
    libc.pthread_mutex_lock(mutex)
    print("compiling", flush=True)
    libc.pthread_mutex_lock(mutex)  # never returns, whatever signals come

program.main = compile
program.run_process()
"""

EARLY = """
import sys
from reframe_jax.cli import program

for arguments in (["--version"], ["--help"]):
    try:
        program.main(arguments)
    except SystemExit as left:
        assert left.code == 0
assert not {"jax", "numpy"} & sys.modules.keys()
"""

Streams = dict[str, int | None]


def start(*arguments: str | Path, **streams: int) -> "subprocess.Popen[str]":
    command = [sys.executable, *map(str, arguments)]
    return subprocess.Popen(command, text=True, **{"stderr": subprocess.PIPE, **streams})  # type: ignore[call-overload,no-any-return]


def test_interruptions_do_not_wait_for_the_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a child inherits what is ignored
    try:
        process = start("-c", STUCK, stdout=subprocess.PIPE)
    finally:
        signal.signal(signal.SIGINT, before)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "compiling\n"
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=LONG)
    finally:
        process.kill()
    assert (process.returncode, out, err) == (-signal.SIGINT, "", "")  # shells report 130


def test_help_and_version_need_neither_jax_nor_numpy() -> None:
    """Nor are they imported before interruptions are dealt with."""
    process = start("-c", EARLY, stdout=subprocess.PIPE)
    out, err = process.communicate(timeout=LONG)
    assert (process.returncode, err) == (0, "")
    assert f"reframe-jax {reframe_jax.__version__}" in out
    assert "identify the constraint in recordings" in out


@pytest.mark.parametrize("arguments", [["constraints"], ["--help"]])
def test_pipes_that_nobody_reads(arguments: list[str]) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    process = start("-m", "reframe_jax", *arguments, stdout=writing)
    os.close(writing)
    _, err = process.communicate(timeout=LONG)
    assert (process.returncode, err) == (1, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize("arguments", [["constraints"], ["--help"]])
def test_outputs_that_are_full(arguments: list[str]) -> None:
    with Path("/dev/full").open("w") as full:
        process = start("-m", "reframe_jax", *arguments, stdout=full.fileno())
        _, err = process.communicate(timeout=LONG)
    problem = "reframe-jax: error: standard output cannot be written: No space left on device.\n"
    assert (process.returncode, err) == (1, problem)


def test_outputs_that_are_closed() -> None:
    script = 'exec "$0" -m reframe_jax constraints >&-'
    done = subprocess.run(
        ["sh", "-c", script, sys.executable], capture_output=True, text=True, timeout=LONG, check=False
    )
    assert (done.returncode, done.stderr) == (1, "reframe-jax: error: standard output is closed.\n")


def test_names_that_are_no_text_are_printed(tmp_path: Path) -> None:
    name = os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9.csv")
    arguments = ["simulate", "--no-cache", "--constraint", "A", "--duration", "1", "--out", name]
    process = start("-m", "reframe_jax", *arguments, stdout=subprocess.PIPE)
    out, err = process.communicate(timeout=LONG)
    assert (process.returncode, err) == (0, "")
    assert out.endswith("caf\\udce9.csv: Revolute joint, 11 poses\n")

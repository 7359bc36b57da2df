"""Attacks on everything that takes input, counted: no crash, no hang, no NaN, nothing but refusals in words.

- *files*: mutated recordings, CSV, TUM, ``.npy`` and ``.npz``, are read, or refused with a ``RecordingError``
  (the tests mutate those of the other formats);
- *windows*: batches with NaN, infinities, huge and tiny numbers, flipped bits, repeated and swapped poses. A
  window has a failed status, or only finite numbers, and its sound neighbours keep theirs to the last bit;
- *arguments*: arrays of every type, shape and byte order, and options that are none, give a result or a
  ``ValueError``;
- *stores*: a mutated folder of results loads as it was, or is refused with a ``ValueError``;
- *commands*: mutated command lines and files end with exit code 0, 1 or 2, and with messages;
- *kills*: runs of ``identify_many`` killed at random moments end with the same bytes.

Each part prints what came of its inputs and how many faults there were; the first of these are listed. The
exit code is 1 if there were any. ``--count 1000000 --kills 100`` is the full run; ``--only`` splits it among
processes, each with its own ``--json``, and ``--join`` shows their files as one.
"""

import contextlib
import io
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import numpy as np

import reframe_jax as rf
from benchmarks.attacks import (
    DT,
    POSES,
    Standstill,
    Tally,
    attack_arguments,
    attack_windows,
    attempt,
    sound_windows,
)
from benchmarks.common import add_files, machine, new_parser, read_parts, write_record
from benchmarks.mutations import FORMATS, TOKENS, make_recording, mutated
from reframe_jax.cli import program

SHARES = {"files": 0.2, "windows": 0.7, "arguments": 0.05, "stores": 0.04, "commands": 0.01}
LISTED = 5  # faults printed of each part
FIRST = 5000  # inputs before the memory of the process is watched
GROWTH = 500  # MB that the memory of the process may grow by from then on


def attack_files(count: int, folder: Path) -> Tally:
    """Mutated recordings: read or refused."""
    tally, suffixes = Tally(), list(FORMATS)
    for seed in range(count):
        suffix = suffixes[seed % len(suffixes)]
        path = folder / f"a{suffix}"
        path.write_bytes(make_recording(np.random.default_rng([seed, *suffix.encode()]), suffix))
        attempt(tally, f"file {seed}{suffix}", partial(_read, path), (rf.RecordingError,))
    return tally


def _read(path: Path) -> str:
    recording = rf.load_recording(path)
    assert np.all(np.isfinite(recording.poses)), "poses that are not finite"
    assert np.all(np.diff(recording.times) > 0), "times that do not increase"
    return "read"


def attack_stores(count: int, folder: Path) -> Tally:
    """Folders of results with bytes flipped, cut, repeated and replaced, and with parts moved."""
    tally, whole = Tally(), folder / "whole"
    rf.identify_many(sound_windows(24), whole, dt=DT, part_size=8, progress=False, solver=Standstill())
    expected = jax.tree.leaves(rf.load_results(whole))
    files = sorted(file.name for file in whole.iterdir())
    for seed in range(count):
        rng = np.random.default_rng([seed, 3])
        store = folder / "mutated"
        shutil.copytree(whole, store)
        name = str(rng.choice(files))
        action = rng.integers(8)
        if action == 0:
            (store / name).unlink()
        elif action == 1:
            shutil.copy(store / str(rng.choice([file for file in files if file != name])), store / name)
        else:
            (store / name).write_bytes(mutated(rng, (store / name).read_bytes()))
        attempt(tally, f"store {seed} ({name})", partial(_load, store, expected))
        shutil.rmtree(store)
    return tally


def _load(store: Path, expected: list[Any]) -> str:
    loaded = jax.tree.leaves(rf.load_results(store))
    same = all(
        np.array_equal(x, y, equal_nan=x.dtype.kind == "f") for x, y in zip(loaded, expected, strict=True)
    )
    assert same, "other results than were stored"
    return "loaded"


def attack_commands(count: int, folder: Path) -> Tally:
    """Command lines with odd words, on sound and on mutated files."""
    tally = Tally()
    sound = folder / "sound.csv"
    rf.save_recording(sound, DT * np.arange(POSES), sound_windows(1)[0])
    quickly = partial(rf.identify, solver=Standstill())
    with mock.patch("reframe_jax.cli.identify.identify", quickly):
        for seed in range(count):
            rng = np.random.default_rng([seed, 4])
            path = folder / "mutated.csv"
            path.write_bytes(make_recording(rng, ".csv"))
            words = _command(rng, sound, path, folder)
            attempt(tally, f"command {seed} {words}", partial(_run, words))
    return tally


def _command(rng: np.random.Generator, sound: Path, spoilt: Path, folder: Path) -> list[str]:
    if rng.random() < 0.1:
        return [
            "constraints",
            *([str(rng.choice(["--json", "x", "--no-cache"]))] if rng.random() < 0.5 else []),
        ]
    words = ["identify", "--no-cache", str(sound if rng.random() < 0.3 else spoilt)]
    options = ["--dt", "--lag", "--unit", "--window", "--stride", "--norm", "--discretization", "--bounds"]
    options += ["--angular-threshold", "--linear-threshold", "--json"]
    values = [
        "1",
        "0",
        "-1",
        "nan",
        "inf",
        "1e200",
        "1e-200",
        "auto",
        "0.5s",
        "mm",
        "left",
        "9",
        "12",
        "",
        "x",
    ]
    odd = [token.decode("utf-8", "replace").replace("\0", "") for token in TOKENS if len(token) < 500]
    for _ in range(rng.integers(0, 3)):
        option = str(rng.choice(options))
        value = str(rng.choice(odd if rng.random() < 0.3 else values))
        if option == "--json":
            value = str(
                rng.choice(["-", str(folder / "out.json"), str(folder), "/dev/full", "/nowhere/a.json"])
            )
        words += [option, value] if rng.random() < 0.5 else [f"{option}={value}"]
    return words


def _run(words: list[str]) -> str:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = program.main(words)
        except SystemExit as done:
            code = done.code if isinstance(done.code, int) else 1
    assert code in (0, 1, 2), f"exit code {code}"
    assert "Traceback" not in err.getvalue(), "a traceback"
    assert code == 0 or err.getvalue().strip(), "a failure without words"
    for kind in ("TypeError", "AttributeError", "KeyError", "IndexError", "XlaRuntimeError", "OverflowError"):
        assert f"{kind}:" not in err.getvalue(), f"an error of the program: {err.getvalue()[-300:]}"
    return f"exit code {code}"


_CHILD = """
import sys
import numpy as np
import reframe_jax as rf
from benchmarks.attacks import Standstill
windows = np.load(sys.argv[1], mmap_mode="r")
rf.identify_many(windows, sys.argv[2], dt=0.1, part_size=8, progress=False, solver=Standstill())
"""


def attack_runs(kills: int, folder: Path) -> Tally:
    """Runs killed at random moments, and resumed until they end."""
    tally = Tally()
    np.save(folder / "windows.npy", sound_windows(512))

    def start(out: Path) -> "subprocess.Popen[bytes]":
        command = [sys.executable, "-c", _CHILD, str(folder / "windows.npy"), str(out)]
        return subprocess.Popen(command, stderr=subprocess.PIPE)

    def succeeds(out: Path) -> bool:
        child = start(out)
        child.communicate()
        return child.returncode == 0

    whole, killed = folder / "uninterrupted", folder / "killed"
    for out in (
        whole,
        folder / "again",
    ):  # the second time, compiled programs come from the cache, as for all
        began = time.monotonic()
        if not succeeds(out):
            tally.add("fault", "an uninterrupted run failed")
            return tally
    duration = time.monotonic() - began
    rng = np.random.default_rng(5)
    for number in range(kills):
        child = start(killed)
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(timeout=float(rng.uniform(0.3, 1.0) * duration))
        child.kill()
        _, words = child.communicate()
        ended = child.returncode == 0
        fault = child.returncode not in (0, -signal.SIGKILL)
        tally.add("ended" if ended else "killed", f"kill {number}: {words[-200:]!r}" if fault else None)
        if ended:
            _compare(tally, number, killed, whole)
            shutil.rmtree(killed)
    if not succeeds(killed):
        tally.faults["the last run failed"] += 1
    _compare(tally, kills, killed, whole)
    return tally


def _compare(tally: Tally, number: int, killed: Path, whole: Path) -> None:
    """Count files of a resumed run that differ from those of an uninterrupted one."""
    for file in sorted(whole.iterdir()):
        if not (killed / file.name).exists() or (killed / file.name).read_bytes() != file.read_bytes():
            tally.faults[f"after kill {number}: {file.name} differs"] += 1


def memory() -> float:
    """Most memory that the process has used so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def attack(count: int, kills: int, only: Sequence[str]) -> dict[str, Any]:
    """Run the parts, print what came of each, and return it as JSON."""
    report: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        parts: dict[str, Callable[[int], Tally]] = {
            "files": lambda n: attack_files(n, folder),
            "windows": attack_windows,
            "arguments": attack_arguments,
            "stores": lambda n: attack_stores(n, folder),
            "commands": lambda n: attack_commands(n, folder),
            "kills": lambda n: attack_runs(n, folder),
        }
        for part, run in parts.items():
            if part not in only:
                continue
            number = kills if part == "kills" else max(1, round(SHARES[part] * count))
            began = time.monotonic()
            watched = (
                number >= 1000 and part != "commands"
            )  # each of which takes its programs along at its end
            if watched:
                run(min(number // 10, FIRST))  # compiles, and fills pools of memory
            before = memory()
            tally = run(number)
            grown = memory() - before if watched else None
            if grown is not None and grown > GROWTH:
                tally.faults[f"memory grew by {grown:.0f} MB"] += 1
            report[part] = {
                "outcomes": dict(tally.outcomes.most_common()),
                "faults": dict(tally.faults),
                "grown_mb": grown,
                "seconds": time.monotonic() - began,
            }
            show(part, report[part])
    return report


def show(part: str, counts: dict[str, Any]) -> None:
    """Print what came of the inputs of a part, and the first of its faults."""
    outcomes = ", ".join(f"{n:,} {outcome}" for outcome, n in counts["outcomes"].items())
    total, faults, grown = sum(counts["outcomes"].values()), counts["faults"], counts["grown_mb"]
    growth = "" if grown is None else f"memory grew by {grown:.0f} MB; "
    number = f"{sum(faults.values())} faults"
    print(f"{part:10}{total:9,}: {outcomes}; {number}; {growth}{counts['seconds']:.0f} s", flush=True)
    for fault in list(faults)[:LISTED]:
        print(f"          {fault}", flush=True)


def join(reports: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Show what runs of different parts wrote, and return it as one report."""
    report: dict[str, Any] = {}
    for one in reports:
        if twice := report.keys() & one.keys():
            raise SystemExit(f"Each part once: {', '.join(sorted(twice))} is in two files.")
        report |= one
    for part in (*SHARES, "kills"):
        if part in report:
            show(part, report[part])
    return report


def main(argv: Sequence[str] | None = None) -> int:
    """Run the attacks; returns the exit code."""
    parser = new_parser("faults", __doc__)
    parser.add_argument("--count", type=int, default=5000, help="mutated inputs in all (5000)")
    parser.add_argument("--kills", type=int, default=3, help="runs that are killed (3)")
    parser.add_argument("--quick", action="store_true", help="a few inputs of every part, none killed")
    parser.add_argument("--only", nargs="+", choices=[*SHARES, "kills"], help="parts to run (all)")
    add_files(parser)
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    count, kills = (300, 0) if options.quick else (options.count, options.kills)
    only = options.only or [*SHARES, *(["kills"] if kills else [])]
    if options.join:
        report = join(read_parts(options))
    else:
        print(machine())
        report = attack(count, kills, only)
    write_record(options.json, report)
    faults = sum(sum(part["faults"].values()) for part in report.values())
    print(f"{faults} faults")
    return int(faults > 0)


if __name__ == "__main__":
    sys.exit(main())

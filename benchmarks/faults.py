"""Test the library with mutated input, and count faults: crashes, hangs, NaN, errors without a message.

- *files*: mutated recordings, CSV, TUM, ``.npy`` and ``.npz``, are read, or raise a ``RecordingError`` (the
  tests mutate files of the other formats);
- *windows*: batches with NaN, infinities, huge and tiny numbers, flipped bits, repeated and swapped poses. A
  window must have a failed status or finite numbers, and the results of intact windows must not change by a
  bit;
- *arguments*: arrays of every type, shape and byte order, and invalid options, give a result or a
  ``ValueError``;
- *stores*: a mutated folder of results loads with its original contents, or raises a ``ValueError``;
- *commands*: mutated command lines and files end with exit code 0, 1 or 2, and with messages.

Each part prints the number of each outcome and of faults, and lists the first faults. The exit code is 1
after a fault. ``--count 1000000`` is the full run.
"""

import contextlib
import functools
import io
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

import reframe_jax as rf
from benchmarks.common import machine, new_parser, write_record
from benchmarks.mutations import FORMATS, TOKENS, make_recording, mutated
from reframe_jax.cli import program
from reframe_jax.objectives import Objective
from reframe_jax.simulation import synthetic
from reframe_jax.solvers import Box, Solution

FRACTIONS = {"files": 0.2, "windows": 0.7, "arguments": 0.05, "stores": 0.04, "commands": 0.01}
LISTED = 5  # most faults to print per part
PATIENCE = 600.0  # s, time limit of one input, including compilation on a busy machine
POSES, DT = 33, 0.1
_LABELS, _MOST = "AEGK", 1024


@dataclass
class Tally:
    """Outcomes of the inputs of one part.

    Attributes:
        outcomes: number of inputs by outcome.
        faults: number of faults by description, with one example each.
    """

    outcomes: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)

    def add(self, outcome: str, fault: str | None = None) -> None:
        """Count an input."""
        self.outcomes[outcome] += 1
        if fault is not None:
            self.faults[fault] += 1


@dataclass(frozen=True)
class Standstill:
    """A solver that does not search, for tests of the arguments only."""

    def minimise(self, objective: Objective, box: Box, key: jax.Array) -> Solution:
        """Return the centre of the box."""
        x = jnp.zeros((objective.dim, *objective.batch), objective.dtype)
        return Solution(x, objective.value(x), jnp.ones(objective.batch, objective.dtype))


class Hang(BaseException):
    """An input took longer than :data:`PATIENCE`."""


@contextlib.contextmanager
def _in_time() -> Iterator[None]:
    def stop(*_: Any) -> None:
        raise Hang

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def attempt(
    tally: Tally, name: str, act: Callable[[], str], allowed: tuple[type[Exception], ...] = (ValueError,)
) -> None:
    """Run a test, and count its outcome.

    Args:
        tally: counts of the part.
        name: name of the input, to reproduce a fault.
        act: function that returns the outcome; an ``AssertionError`` is a fault.
        allowed: errors that count as a valid refusal if they have a message.
    """
    try:
        with _in_time(), warnings.catch_warnings():
            warnings.simplefilter("error")
            tally.add(act())
    except allowed as error:
        words = str(error)
        wordless = not words.strip() or len(words) > 4000
        tally.add("refused", f"{name}: a refusal without words: {words[:80]!r}" if wordless else None)
    except Hang:
        tally.add("fault", f"{name}: no end within {PATIENCE:g} s")
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{Path(where.filename).name}:{where.lineno}"
        tally.add("fault", f"{name}: {type(error).__name__} at {place}: {str(error)[:200]}")


@functools.cache
def _windows() -> np.ndarray:
    poses = []
    for label in _LABELS:
        make = partial(synthetic.simulate, label, noise=1e-4, duration=(POSES - 1) * DT, dt=DT)
        keys = jax.random.split(jax.random.key(0), _MOST // len(_LABELS))
        poses.append(np.asarray(jax.jit(jax.vmap(lambda key, make=make: make(key).poses))(keys)))
    return np.stack(poses, axis=1).reshape(_MOST, POSES, 4, 4)


def sound_windows(count: int) -> np.ndarray:
    """Intact poses (count, 33, 4, 4) of several constraints in turn; at most 1024 windows."""
    return _windows()[:count].copy()


def _mutate_window(rng: np.random.Generator, poses: np.ndarray) -> np.ndarray:
    """Apply one to three mutations to a window."""
    poses = poses.copy()
    for _ in range(rng.integers(1, 4)):
        where = int(rng.integers(len(poses)))
        kind = rng.integers(9)
        if kind == 0:
            poses[where, rng.integers(4), rng.integers(4)] = rng.choice([np.nan, np.inf, -np.inf, 0, 1e300])
        elif kind == 1:
            poses[:, :3, 3] *= 10.0 ** rng.uniform(-200, 200)
        elif kind == 2:
            poses[where:, :3, 3] += 10.0 ** rng.uniform(-20, 160)
        elif kind == 3:
            bits = poses.reshape(-1).view(np.uint64 if poses.itemsize == 8 else np.uint32)
            bits[rng.integers(bits.size)] ^= bits.dtype.type(1 << int(rng.integers(8 * poses.itemsize)))
        elif kind == 4:
            poses[where:] = poses[where]
        elif kind == 5:
            poses[rng.permutation(len(poses))] = poses.copy()
        elif kind == 6:
            poses[:, rng.integers(3), 3] = rng.choice([0.0, 1e4])
        elif kind == 7:
            poses[:, :3, :3] = np.eye(3)
        else:
            poses[:, :3, 3] = np.round(poses[:, :3, 3], int(rng.integers(5)))
    return poses


def attack_windows(count: int) -> Tally:
    """Test batches that contain mutated and intact windows."""
    tally = Tally()
    size = _MOST if count >= 1000 else 32
    sound = sound_windows(size)

    @functools.cache
    def expected(kind: str) -> rf.Identification:
        return _identify_batch(sound.astype(kind), DT)

    for number in range(-(-2 * count // size)):
        rng = np.random.default_rng([number, 1])
        kind = "float32" if number % 4 == 3 and count >= 1000 else "float64"
        batch = sound.astype(kind)
        spoilt = np.flatnonzero(rng.random(size) < 0.5)
        with np.errstate(all="ignore"):
            for row in spoilt:
                batch[row] = _mutate_window(rng, batch[row])
        before = expected(kind)
        try:
            with _in_time():
                found = _identify_batch(batch, DT)
        except Exception as error:
            tally.add("fault", f"batch {number}: {type(error).__name__}: {str(error)[:200]}")
            continue
        for fault in faults_of_batch(np.asarray(found.status_code), found, before, spoilt):
            tally.faults[f"batch {number} of {kind}: {fault}"] += 1
        for code in found.status_code[spoilt]:
            tally.outcomes[rf.Status(int(code)).name] += 1
    return tally


def _identify_batch(poses: np.ndarray, dt: Any) -> rf.Identification:
    return jax.device_get(rf.identify(poses, dt=dt))


def faults_of_batch(status: np.ndarray, found: Any, expected: Any, spoilt: np.ndarray) -> Iterator[str]:
    """Find the faults in the results of a batch.

    Args:
        status: (N,) status codes.
        found: pytree of arrays (N, ...), the results.
        expected: the results of the intact windows.
        spoilt: indices of the mutated windows.
    """
    good, untouched = status < 10, np.ones(len(status), bool)
    untouched[spoilt] = False
    leaves = jax.tree_util.tree_leaves_with_path(found)
    for (path, leaf), before in zip(leaves, jax.tree.leaves(expected), strict=True):
        name = jax.tree_util.keystr(path)
        if np.issubdtype(leaf.dtype, np.floating):
            finite = np.isfinite(leaf).reshape(len(leaf), -1).all(axis=1)
            # NaN for other joints
            if np.any(good & ~finite) and name not in (".pitch", ".universal_axes"):
                yield f"{name} is not finite in window {np.flatnonzero(good & ~finite)[0]}"
        if not np.array_equal(leaf[untouched], before[untouched], equal_nan=leaf.dtype.kind == "f"):
            yield f"{name} of a sound window changed"


def attack_arguments(count: int) -> Tally:
    """Test values of every type and shape for every argument of ``identify``."""
    tally, window = Tally(), sound_windows(1)[0]
    for seed in range(count):
        rng = np.random.default_rng([seed, 2])
        arguments: dict[str, Any] = {"poses": window, "dt": DT}
        for _ in range(rng.integers(1, 3)):
            name = str(
                rng.choice(
                    ["poses", "times", "dt", "scales", "assume", "norm", "thresholds", "bounds", "key"]
                )
            )
            arguments[name] = _odd_value(rng, window if name == "poses" else DT * np.arange(POSES))
        if "times" in arguments and rng.random() < 0.8:
            arguments.pop("dt")
        attempt(tally, f"arguments {seed}", partial(_identify_one, arguments))
    return tally


def _identify_one(arguments: dict[str, Any]) -> str:
    found = rf.identify(arguments.pop("poses"), **arguments, solver=Standstill())
    number = (
        found.noise.position
    )  # replaces the NaN of results without a screw, universal joint or probability
    known = replace(found, pitch=number, universal_axes=number, entry_probability=number)
    for leaf in jax.tree.leaves(known):
        finite = np.issubdtype(leaf.dtype, np.floating) and not np.all(np.isfinite(np.asarray(leaf)))
        assert not finite or np.ndim(found.status_code), "NaN under a good status"
    return "identified"


def _odd_value(rng: np.random.Generator, usual: np.ndarray) -> Any:
    types = ["f2", "f4", "f8", ">f8", ">f4", "f16", "i1", "u1"]
    types += ["u4", ">u8", "i8", "c16", "?", "U8", "S4", "O"]
    kind = rng.integers(10)
    if kind < 5:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return usual.astype(str(rng.choice(types)))
    if kind == 5:
        return usual[None] if usual.ndim == 1 else usual[..., :3]
    if kind == 6:
        return usual[: int(rng.integers(5))]
    if kind == 7:
        return usual.tolist()
    odd: list[Any] = [None, "a", b"a", True, 1j, {}, [], (), [[1], [1, 2]], object(), np.ma.masked]
    odd += [np.nan, np.inf, -1, 0, 1e300, 1e-300, 2**80, (1.0, 2.0), (1, 2, 3), (-1.0, np.ones(3))]
    odd += [np.datetime64("2020"), np.timedelta64(1, "s"), np.array(0.5), lambda: 1, "hinge"]
    every: list[Any] = [*odd, rf.Thresholds(0.1, 0.1)]
    return every[int(rng.integers(len(every)))]


def attack_files(count: int, folder: Path) -> Tally:
    """Test mutated recordings: the reader must read them or raise an error."""
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
    """Test folders of results with flipped, deleted, repeated and replaced bytes, and with moved parts."""
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
    """Test command lines with unusual words, on intact and on mutated files."""
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
    options = ["--dt", "--scales", "--unit", "--window", "--stride", "--norm", "--discretization", "--bounds"]
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


def attack(count: int, only: Sequence[str]) -> dict[str, Any]:
    """Run the parts, print their outcomes, and return the outcomes as JSON."""
    report: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        parts: dict[str, Callable[[int], Tally]] = {
            "files": lambda number: attack_files(number, folder),
            "windows": attack_windows,
            "arguments": attack_arguments,
            "stores": lambda number: attack_stores(number, folder),
            "commands": lambda number: attack_commands(number, folder),
        }
        for part in only:
            began = time.monotonic()
            tally = parts[part](max(1, round(FRACTIONS[part] * count)))
            seconds = time.monotonic() - began
            outcomes = dict(tally.outcomes.most_common())
            report[part] = {"outcomes": outcomes, "faults": dict(tally.faults), "seconds": seconds}
            words = ", ".join(f"{number:,} {outcome}" for outcome, number in outcomes.items())
            faults = sum(tally.faults.values())
            print(
                f"{part:10}{sum(outcomes.values()):9,}: {words}; {faults} faults; {seconds:.0f} s", flush=True
            )
            for fault in list(tally.faults)[:LISTED]:
                print(f"          {fault}", flush=True)
    return report


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tests; return the exit code."""
    parser = new_parser("faults", __doc__)
    parser.add_argument("--count", type=int, default=5000, help="total number of mutated inputs (5000)")
    parser.add_argument("--quick", action="store_true", help="a few inputs per part")
    parser.add_argument("--only", nargs="+", choices=list(FRACTIONS), help="parts to run (all)")
    parser.add_argument("--json", type=Path, help="file to write all figures to")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    print(machine())
    report = attack(300 if options.quick else options.count, options.only or list(FRACTIONS))
    write_record(options.json, report)
    faults = sum(sum(part["faults"].values()) for part in report.values())
    print(f"{faults} faults")
    return int(faults > 0)


if __name__ == "__main__":
    sys.exit(main())

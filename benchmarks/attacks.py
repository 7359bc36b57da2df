"""Attacks on ``identify``, and what all attacks share: a tally, a time limit, an idle solver."""

import contextlib
import functools
import signal
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import reframe_jax as rf
from reframe_jax.objectives import Objective
from reframe_jax.simulation import synthetic
from reframe_jax.solvers import Box, Solution

__all__ = [
    "DT",
    "POSES",
    "Standstill",
    "Tally",
    "attack_arguments",
    "attack_windows",
    "attempt",
    "faults_of_batch",
    "sound_windows",
]

PATIENCE = 600.0  # s that one input may take, compilation on a busy machine included
POSES, DT = 21, 0.1
_LABELS, _MOST = "AEGK", 1024


@dataclass
class Tally:
    """What came of the inputs of one part.

    Attributes:
        outcomes: how many inputs came out how.
        faults: how many there were of each, in words, with one example each.
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
    """A solver that does not search: the arguments are under attack, not the search."""

    def minimise(self, objective: Objective, box: Box, key: jax.Array) -> Solution:
        """The middle of the box."""
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
    """Do something, and count what came of it.

    Args:
        tally: to count in.
        name: of the input, to find it again.
        act: returns the outcome; an ``AssertionError`` is a fault.
        allowed: errors that are refusals, if they say something.
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
    """(count, 21, 4, 4) poses of several constraints in turn; at most 1024 windows."""
    return _windows()[:count].copy()


def _spoil(rng: np.random.Generator, poses: np.ndarray) -> np.ndarray:
    """A window with one to three mutations."""
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
    """Batches of spoilt windows beside sound ones."""
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
                batch[row] = _spoil(rng, batch[row])
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
    """What is wrong with a batch.

    Args:
        status: (N,) codes.
        found: pytree of arrays (N, ...).
        expected: the same of sound windows.
        spoilt: rows of windows that were not sound.
    """
    good, untouched = status < 10, np.ones(len(status), bool)
    untouched[spoilt] = False
    leaves = jax.tree_util.tree_leaves_with_path(found)
    for (path, leaf), before in zip(leaves, jax.tree.leaves(expected), strict=True):
        name = jax.tree_util.keystr(path)
        if np.issubdtype(leaf.dtype, np.floating):
            finite = np.isfinite(leaf).reshape(len(leaf), -1).all(axis=1)
            # NaN where the constraint is no such joint
            if np.any(good & ~finite) and name not in (".pitch", ".universal_axes"):
                yield f"{name} is not finite in window {np.flatnonzero(good & ~finite)[0]}"
        if not np.array_equal(leaf[untouched], before[untouched], equal_nan=leaf.dtype.kind == "f"):
            yield f"{name} of a sound window changed"


def attack_arguments(count: int) -> Tally:
    """Values of every type and shape as every argument of ``identify``."""
    tally, window = Tally(), sound_windows(1)[0]
    for seed in range(count):
        rng = np.random.default_rng([seed, 2])
        arguments: dict[str, Any] = {"poses": window, "dt": DT}
        for _ in range(rng.integers(1, 3)):
            name = str(rng.choice(["poses", "times", "dt", "lag", "norm", "thresholds", "bounds", "key"]))
            arguments[name] = _odd_value(rng, window if name == "poses" else DT * np.arange(POSES))
        if "times" in arguments and rng.random() < 0.8:
            arguments.pop("dt")
        attempt(tally, f"arguments {seed}", partial(_identify_one, arguments))
    return tally


def _identify_one(arguments: dict[str, Any]) -> str:
    found = rf.identify(arguments.pop("poses"), **arguments, solver=Standstill())
    for leaf in jax.tree.leaves(replace(found, pitch=found.noise.position)):  # NaN says that it is no screw
        finite = np.issubdtype(leaf.dtype, np.floating) and not np.all(np.isfinite(np.asarray(leaf)))
        assert not finite or np.ndim(found.status_code), "NaN under a good status"
    return "identified"


def _odd_value(rng: np.random.Generator, usual: np.ndarray) -> Any:
    types = [
        "f2",
        "f4",
        "f8",
        ">f8",
        ">f4",
        "f16",
        "i1",
        "u1",
        "u4",
        ">u8",
        "i8",
        "c16",
        "?",
        "U8",
        "S4",
        "O",
    ]
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
    odd: list[Any] = [
        None,
        "a",
        b"a",
        True,
        1j,
        {},
        [],
        (),
        [[1], [1, 2]],
        np.nan,
        np.inf,
        -1,
        0,
        1e300,
        1e-300,
        2**80,
    ]
    more = [
        (1.0, 2.0),
        (1, 2, 3),
        (-1.0, np.ones(3)),
        np.datetime64("2020"),
        np.timedelta64(1, "s"),
        object(),
    ]
    every: list[Any] = [*odd, *more, np.ma.masked, np.array(0.5), lambda: 1, rf.Thresholds(0.1, 0.1)]
    return every[int(rng.integers(len(every)))]

"""Demonstrations on disk: numbered parts, written completely or not at all, that a later run resumes."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Unpack

import jax
import numpy as np

from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.types import AngularType, Dof, LinearType
from reframe_jax.simulation.arm.demonstration import DemonstrateOptions, Demonstration, demonstrate
from reframe_jax.simulation.arm.redraw import draw_good
from reframe_jax.simulation.arm.status import RolloutStatus
from reframe_jax.storage.codecs import NPZ
from reframe_jax.storage.parts import Run
from reframe_jax.storage.progress import Progress, make_meter
from reframe_jax.storage.records import describe, describe_options

__all__ = ["load_demonstrations", "store_demonstrations", "stored_demonstrations", "to_arrays"]

_KIND = "demonstrations"
_UNIT = "demonstrations"
_GEOMETRY = ("angular_rotvec", "linear_rotvec", "position")
_FIELDS = tuple(name for name in Demonstration.__dataclass_fields__ if name not in ("times", "truth"))


def to_arrays(made: Demonstration) -> dict[str, Any]:
    """A batch of demonstrations as named arrays, as in the files; the truth's names begin with true_."""
    truth = made.truth
    return {
        "times": made.times,
        **{name: getattr(made, name) for name in _FIELDS},
        **{f"true_{name}": getattr(truth, name) for name in _GEOMETRY},
        "true_angular_type": str(truth.angular_type),
        "true_linear_type": str(truth.linear_type),
        "true_angular_dof": np.array(truth.angular_dof),
        "true_linear_dof": np.array(truth.linear_dof),
    }


def store_demonstrations(
    constraint: str | ConstraintFrame,
    key: jax.Array,
    count: int,
    folder: str | Path,
    *,
    chunk: int = 64,
    redraw: bool = True,
    progress: Progress | bool | None = None,
    **options: Unpack[DemonstrateOptions],
) -> Path:
    """Simulate usable demonstrations into a folder, and resume from the parts already there.

    Repeat the call with the same ``count`` or a larger one to add what is missing. The chunk bounds the
    memory.

    Args:
        constraint: as for :func:`reframe_jax.simulation.arm.demonstrate`.
        key: JAX random key.
        count: number of demonstrations.
        folder: made if missing; read it with :func:`load_demonstrations`, or part by part with
            :func:`stored_demonstrations`.
        chunk: number simulated at once, and in a part before those with a status are left out.
        redraw: replace demonstrations whose status is not OK by new ones.
        progress: called with the number of demonstrations so far and ``count``, after every part; True for a
            bar on standard error, the default where that is a terminal.
        **options: of :func:`reframe_jax.simulation.arm.demonstrate`.

    Returns:
        The folder.

    Raises:
        ValueError: if the folder holds other data, demonstrations with other options, or a damaged part; or
            if more than 9 in 10 demonstrations are unusable.
        TypeError: for an option that :func:`reframe_jax.simulation.arm.demonstrate` does not have.
    """
    run = Run(Path(folder), NPZ, _KIND, _UNIT, _describe_run(constraint, key, chunk, redraw, options))
    run.resume()

    def draw(number: int) -> tuple[int, np.ndarray]:
        if run.has(number):
            stored = run.read(number)["status_code"]
            return number, stored if redraw else np.zeros_like(stored)
        made = jax.device_get(demonstrate(constraint, key, batch=chunk, first=number * chunk, **options))
        kept = made[np.flatnonzero(made.status_code == RolloutStatus.OK)] if redraw else made
        run.write(number, to_arrays(kept))
        return number, made.status_code if redraw else np.zeros_like(made.status_code)

    for _ in draw_good(draw, count, chunk, progress=make_meter(progress, _UNIT)):
        pass
    if run.parts:
        run.finish()
    return run.folder


def stored_demonstrations(folder: str | Path) -> Iterator[Demonstration]:
    """Iterate over the parts of a folder, as batches of NumPy arrays; one part bounds the memory.

    ``rf.identify_many((poses for part in stored_demonstrations(folder) for poses in part.poses), ...)``
    identifies all of them.

    Args:
        folder: written by :func:`store_demonstrations`.

    Raises:
        ValueError: if there are no parts, a part between others is missing, or a file is damaged.
    """
    run = Run.open(Path(folder), NPZ, _KIND, _UNIT)
    numbers = list(run.parts)
    missing = sorted(set(range(numbers[-1])) - set(numbers))
    if missing:
        raise ValueError(
            f"{folder} is incomplete: parts {missing[:8]} are missing. Run store_demonstrations again."
        )
    for number in numbers:
        yield _from_arrays(run.read(number))


def _from_arrays(part: dict[str, Any]) -> Demonstration:
    truth = ConstraintFrame(
        angular_type=AngularType[str(part["true_angular_type"])],
        angular_dof=_dof(part["true_angular_dof"]),
        linear_type=LinearType[str(part["true_linear_type"])],
        linear_dof=_dof(part["true_linear_dof"]),
        **{name: part[f"true_{name}"] for name in _GEOMETRY},
    )
    return Demonstration(times=part["times"], truth=truth, **{name: part[name] for name in _FIELDS})


def load_demonstrations(folder: str | Path, count: int | None = None) -> Demonstration:
    """Load the demonstrations of a folder as one batch of NumPy arrays.

    Args:
        folder: written by :func:`store_demonstrations`.
        count: number to load, from the first; all by default, which may exceed the number requested.

    Raises:
        ValueError: if there are none, or fewer than ``count``.
    """
    parts: list[Demonstration] = []
    total = 0
    for part in stored_demonstrations(folder):
        parts.append(part)
        total += len(part.status_code)
        if count is not None and total >= count:
            break
    if count is not None and total < count:
        raise ValueError(f"{folder} holds {total} demonstrations, fewer than {count}.")
    made: Demonstration = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    return replace(made, times=parts[0].times)[:count]


def _dof(values: np.ndarray) -> Dof:
    x, y, z = (int(value) for value in values)
    return x, y, z


def _describe_run(
    constraint: str | ConstraintFrame, key: jax.Array, chunk: int, redraw: bool, options: Mapping[str, Any]
) -> dict[str, Any]:
    """What the demonstrations depend on."""
    return {
        "constraint": describe(constraint),
        "key": describe(key),
        "chunk": chunk,
        "redraw": redraw,
        **describe_options(demonstrate, options, without=("batch", "first")),
    }

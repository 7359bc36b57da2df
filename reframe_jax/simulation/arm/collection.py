"""Collect any number of feasible demonstrations, in memory or on disk; an interrupted run can resume."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar, Unpack

import jax
import numpy as np

from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.simulation.arm.demonstration import DemonstrateOptions, Demonstration, demonstrate
from reframe_jax.simulation.arm.rollout import RolloutStatus
from reframe_jax.storage.parts import NPZ, Run
from reframe_jax.storage.progress import Progress, make_meter
from reframe_jax.storage.records import describe, describe_options

_PATIENCE = 10  # chunks before an error, if more than 9 in 10 draws are unusable
_KIND = "demonstrations"
_TYPES: dict[str, Any] = {"angular_type": AngularType, "linear_type": LinearType}

Batch = TypeVar("Batch")


def draw_usable(
    draw: Callable[[int], tuple[Batch, np.ndarray]],
    count: int,
    chunk: int,
    *,
    redraw: bool = True,
    subject: str = "demonstrations are usable",
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[tuple[Batch, np.ndarray]]:
    """Draw chunks until enough draws are usable; yield every chunk with the indices of its usable draws.

    ``draw`` returns the draws of a numbered chunk, and the :class:`RolloutStatus` (n,) of each. A chunk may
    have no usable draws; the last chunk has only as many as are needed. Without ``redraw``, all draws count
    as usable. ``progress`` receives the number of usable draws and ``count``. A ValueError, "Only 3 of 40
    ``subject``", is raised if more than 9 in 10 draws are unusable and more are still needed.
    """
    done, drawn = 0, 0
    while done < count:
        batch, status = draw(drawn // chunk)
        good = np.flatnonzero((status == RolloutStatus.OK) | (not redraw))[: count - done]
        drawn, done = drawn + chunk, done + len(good)
        if done < count and drawn >= _PATIENCE * chunk and done < drawn / 10:
            worst = f" {RolloutStatus(int(np.median(status))).message}" if np.any(status) else ""
            raise ValueError(f"Only {done} of {drawn} {subject}.{worst}")
        if progress is not None:
            progress(done, count)
        yield batch, good


def demonstrations(
    constraint: str | ConstraintFrame,
    key: jax.Array,
    count: int,
    *,
    chunk: int = 64,
    redraw: bool = True,
    progress: Callable[[int, int], None] | None = None,
    **options: Unpack[DemonstrateOptions],
) -> Iterator[Demonstration]:
    """Generate any number of demonstrations on the host, in chunks that are compiled once.

    The constraint and the options are those of :func:`demonstrate`, with one geometry (3,) for all
    demonstrations, before ``spread``. ``redraw`` replaces demonstrations whose status is not OK; a ValueError
    is raised if these are more than 9 in 10. After every chunk, ``progress`` is called with the number of
    completed demonstrations and ``count``.
    """

    def draw(number: int) -> tuple[Demonstration, np.ndarray]:
        made = jax.device_get(demonstrate(constraint, key, batch=chunk, first=number * chunk, **options))
        return made, made.status_code

    for made, good in draw_usable(draw, count, chunk, redraw=redraw, progress=progress):
        if len(good):
            yield made[good]


def to_arrays(made: Demonstration) -> dict[str, Any]:
    """Convert a batch of demonstrations to named arrays; the names of the true frames start with true_."""
    arrays = {name: value for name, value in vars(made).items() if name != "truth"}
    for name, value in vars(made.truth).items():
        arrays[f"true_{name}"] = str(value) if name in _TYPES else np.asarray(value)
    return arrays


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
    """Simulate usable demonstrations, store them in a folder, and resume from existing parts.

    Repeat the call with the same or a larger ``count`` to add missing demonstrations. The chunk size limits
    the memory: each part has the usable demonstrations of one chunk. Read them with
    :func:`stored_demonstrations`. Arguments as for :func:`reframe_jax.simulation.arm.demonstrations`;
    ``progress=True`` shows a bar on standard error.

    Raises:
        ValueError: if the folder contains other data, demonstrations with other options, or a damaged part;
            or if more than 9 in 10 demonstrations are unusable.
        TypeError: for an option that :func:`reframe_jax.simulation.arm.demonstrate` does not have.
    """
    given = {"constraint": describe(constraint), "key": describe(key), "chunk": chunk, "redraw": redraw}
    given |= describe_options(demonstrate, options, without=("batch", "first"))
    run = Run(Path(folder), NPZ, _KIND, given)
    run.resume()

    def draw(number: int) -> tuple[int, np.ndarray]:
        if run.has(number):
            return number, run.read(number)["status_code"]
        made = jax.device_get(demonstrate(constraint, key, batch=chunk, first=number * chunk, **options))
        kept = made[np.flatnonzero(made.status_code == RolloutStatus.OK)] if redraw else made
        run.write(number, to_arrays(kept))
        return number, made.status_code

    for _ in draw_usable(draw, count, chunk, redraw=redraw, progress=make_meter(progress, _KIND)):
        pass
    return run.folder


def stored_demonstrations(folder: str | Path) -> Iterator[Demonstration]:
    """Iterate over the parts of a folder as batches of NumPy arrays, with one part in memory at a time.

    ``rf.identify_many((poses for part in stored_demonstrations(folder) for poses in part.poses), ...)``
    identifies all demonstrations. :func:`store_demonstrations` writes the folder. A ValueError is raised if
    it has no parts, if a part is missing, or if a file is damaged.
    """
    run = Run.open(Path(folder), NPZ, _KIND)
    numbers = list(run.parts)
    if missing := sorted(set(range(numbers[-1])) - set(numbers)):
        raise ValueError(f"{folder}: parts {missing[:8]} are missing. Run store_demonstrations again.")
    for number in numbers:
        part = run.read(number)
        truth = {name: part.pop(f"true_{name}") for name in ConstraintFrame.__dataclass_fields__}
        truth |= {name: kind[str(truth[name])] for name, kind in _TYPES.items()}
        truth |= {name: tuple(truth[name].tolist()) for name in ("angular_dof", "linear_dof")}
        yield Demonstration(truth=ConstraintFrame(**truth), **part)

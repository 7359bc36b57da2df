"""Demonstrations on disk: numbered parts, written whole or not at all, that a later run continues."""

import hashlib
import json
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

import reframe_jax
from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.types import AngularType, Dof, LinearType
from reframe_jax.simulation.arm.demonstration import Demonstration, demonstrate
from reframe_jax.simulation.arm.status import RolloutStatus
from reframe_jax.storage.results import _replace

__all__ = ["load_demonstrations", "store_demonstrations", "stored_demonstrations", "to_arrays"]

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
    progress: Callable[[int, int], None] | None = None,
    **options: Any,
) -> Path:
    """Simulate usable demonstrations into a folder, going on from the parts that are there.

    The same ``count``, or a larger one, adds what is missing. Memory is bounded by the chunk.

    Args:
        constraint: as for :func:`reframe_jax.simulation.arm.demonstrate`.
        key: of everything random.
        count: number of demonstrations.
        folder: made if missing; read it with :func:`load_demonstrations`, or part by part with
            :func:`stored_demonstrations`.
        chunk: number simulated at once, and in a part before those with a status are left out.
        redraw: leave out those with a status other than OK, and draw others.
        progress: called with the number of demonstrations so far and ``count``, after every part.
        **options: of :func:`reframe_jax.simulation.arm.demonstrate`.

    Returns:
        The folder.

    Raises:
        ValueError: if the folder holds something else, or when more than 9 in 10 demonstrations have to
            be left out.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    _check_run(folder, _record(constraint, key, chunk, {**options, "redraw": redraw}))
    done, part = 0, 0
    while done < count:
        file = folder / f"part-{part:08d}.npz"
        if file.exists():
            done += len(_load(file)["status_code"])
        else:
            made = jax.device_get(demonstrate(constraint, key, batch=chunk, first=part * chunk, **options))
            kept = made[np.flatnonzero(made.status_code == RolloutStatus.OK)] if redraw else made
            done += len(kept.status_code)
            _replace(file, lambda temporary, kept=kept: _save(temporary, kept))  # type: ignore[misc]
        part += 1
        if part >= 10 and done < part * chunk / 10:
            raise ValueError(f"Only {done} of {part * chunk} demonstrations are usable.")
        if progress is not None:
            progress(min(done, count), count)
    return folder


def stored_demonstrations(folder: str | Path) -> Iterator[Demonstration]:
    """The parts of a folder one after the other, as batches of NumPy arrays: memory is bounded by a part.

    ``rf.identify_many((poses for part in stored_demonstrations(folder) for poses in part.poses), ...)``
    identifies all of them.

    Args:
        folder: written by :func:`store_demonstrations`.

    Raises:
        ValueError: if there are none, or a file is damaged.
    """
    files = sorted(Path(folder).glob("part-*.npz"))
    if not files:
        raise ValueError(f"{folder} holds no demonstrations (part-*.npz).")
    for file in files:
        part = _load(file)
        truth = ConstraintFrame(
            angular_type=AngularType[str(part["true_angular_type"])],
            angular_dof=_dof(part["true_angular_dof"]),
            linear_type=LinearType[str(part["true_linear_type"])],
            linear_dof=_dof(part["true_linear_dof"]),
            **{name: part[f"true_{name}"] for name in _GEOMETRY},
        )
        yield Demonstration(times=part["times"], truth=truth, **{name: part[name] for name in _FIELDS})


def load_demonstrations(folder: str | Path, count: int | None = None) -> Demonstration:
    """Demonstrations of a folder as one batch of NumPy arrays.

    Args:
        folder: written by :func:`store_demonstrations`.
        count: the first so many; all by default, which may be more than were asked for.

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


def _load(file: Path) -> dict[str, Any]:
    try:
        # np.load does not close a file that it cannot read
        with file.open("rb") as stream, np.load(stream) as stored:
            return dict(stored)
    except (OSError, EOFError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"{file} is damaged: delete it, and it will be made again. ({error})") from error


def _check_run(folder: Path, record: dict[str, str]) -> None:
    """Write what a folder's demonstrations depend on, or compare it with what is there."""
    run = folder / "run.json"
    text = json.dumps(record) + "\n"
    found = run.read_text() if run.exists() else ""
    if found == text:
        return
    # a run that failed before its first part left nothing to go on from
    if any(folder.glob("part-*")) or (found and "digest" not in found):
        raise ValueError(
            f"{folder} holds demonstrations of other options, or something else. Give those options, or "
            "another folder."
        )
    _replace(run, lambda temporary: temporary.write_text(text))


def _described(leaf: Any) -> str:
    """A part of the options, in full, and the same in every process."""
    if isinstance(leaf, (int, float, np.ndarray, jax.Array)):
        return repr(np.asarray(leaf).tolist())
    if callable(leaf):
        return f"{leaf.__module__}.{getattr(leaf, '__qualname__', type(leaf).__name__)}"
    return repr(leaf)


def _record(
    constraint: str | ConstraintFrame, key: jax.Array, chunk: int, options: dict[str, Any]
) -> dict[str, str]:
    """What the demonstrations depend on."""
    leaves, structure = jax.tree.flatten((constraint, jax.random.key_data(key), chunk, options))
    described = " ".join((str(structure), *map(_described, leaves)))
    return {
        "version": reframe_jax.__version__,
        "digest": hashlib.sha256(described.encode()).hexdigest(),
        "constraint": str(constraint) if isinstance(constraint, str) else "a frame",
    }


def _save(file: Path, made: Demonstration) -> None:
    with file.open("wb") as stream:
        np.savez_compressed(stream, **to_arrays(made))

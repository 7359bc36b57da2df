"""Drawing again: who counts, when enough is enough, and when to give up."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.simulation import arm as panda
from reframe_jax.simulation import reproduction
from reframe_jax.simulation.arm import collection
from reframe_jax.simulation.arm.collection import draw_usable
from reframe_jax.simulation.reproduction import comparison

CHUNK = 4
KEY = jax.random.key(0)
OK, LIMIT = panda.RolloutStatus.OK, panda.RolloutStatus.JOINT_LIMIT


def draw_from(statuses: list[list[int]]) -> Callable[[int], tuple[int, np.ndarray]]:
    """Chunks with given statuses; what is in them is their number."""
    return lambda number: (number, np.array(statuses[number]))


def test_good_ones_count_until_there_are_enough() -> None:
    seen: list[tuple[int, int]] = []
    draw = draw_from([[LIMIT, OK, LIMIT, OK], [LIMIT] * 4, [OK, LIMIT, OK, OK]])
    chunks = list(draw_usable(draw, 4, CHUNK, progress=lambda *done: seen.append(done)))
    assert [(batch, good.tolist()) for batch, good in chunks] == [(0, [1, 3]), (1, []), (2, [0, 2])]
    assert seen == [(2, 4), (2, 4), (4, 4)]


def test_too_few_are_refused_after_ten_chunks() -> None:
    draw = draw_from([[LIMIT] * 4] * 9 + [[LIMIT, LIMIT, LIMIT, OK]])
    with pytest.raises(ValueError, match=r"Only 1 of 40 demonstrations are usable\. A joint left its range"):
        list(draw_usable(draw, 2, CHUNK))


def rare(made: Any) -> Callable[..., Any]:
    """Demonstrations that are of no use but for the 37th."""

    def demonstrate(constraint: Any, key: jax.Array, *, batch: int, first: int = 0, **_: Any) -> Any:
        numbers = first + np.arange(batch)
        status = np.where(numbers == 36, OK, LIMIT).astype(np.int32)
        parts = {
            **vars(made),
            "status_code": status,
            "slip": np.full((batch, 6, 6), 1.0 * numbers[:, None, None]),
        }
        return panda.Demonstration(**parts)

    return demonstrate


@pytest.fixture
def made() -> panda.Demonstration:
    """A batch of four without any motion."""
    truth = jax.tree.map(lambda leaf: np.tile(leaf, (CHUNK, 1)), rf.ConstraintFrame.named("A"))
    return panda.Demonstration(
        times=0.1 * np.arange(6),
        truth=truth,
        **dict.fromkeys(("poses", "exact_poses"), np.tile(np.eye(4), (CHUNK, 6, 1, 1))),
        **dict.fromkeys(("joint_positions", "joint_velocities"), np.zeros((CHUNK, 6, 7))),
        **dict.fromkeys(("reaction", "slip"), np.zeros((CHUNK, 6, 6))),
        status_code=np.zeros(CHUNK, np.int32),
    )


def test_reaching_the_count_late_is_no_error(
    made: panda.Demonstration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In memory and on disk alike: one in forty is enough where one is asked for, and not where two are."""
    monkeypatch.setattr(collection, "demonstrate", rare(made))
    (drawn,) = panda.demonstrations("A", KEY, 1, chunk=CHUNK)
    folder = panda.store_demonstrations("A", KEY, 1, tmp_path / "demos", chunk=CHUNK)
    (stored,) = (part for part in panda.stored_demonstrations(folder) if len(part.status_code))
    assert drawn.slip[:, 0, 0].tolist() == stored.slip[:, 0, 0].tolist() == [36.0]
    for collect in (
        lambda: list(panda.demonstrations("A", KEY, 2, chunk=CHUNK)),
        lambda: panda.store_demonstrations("A", KEY, 2, folder, chunk=CHUNK),
    ):
        with pytest.raises(ValueError, match="Only 1 of 40 demonstrations are usable"):
            collect()


class EnoughError(Exception):
    """Everything that was wanted has been drawn."""


def test_tasks_that_are_reached_late_are_no_error(
    made: panda.Demonstration, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The 65th of 65 tasks is found among more than 650."""

    def demonstrate(*_: Any, batch: int, first: int, **__: Any) -> panda.Demonstration:
        numbers = first + np.arange(batch)
        status = np.where((numbers % 10 == 0) & (numbers < 640) | (numbers == 700), OK, LIMIT)
        parts = {
            name: jax.tree.map(lambda leaf: np.repeat(leaf[:1], batch, axis=0), value)
            for name, value in vars(made).items()
            if name != "times"
        }
        return panda.Demonstration(times=made.times, **{**parts, "status_code": status.astype(np.int32)})

    def reproduce(truth: Any, frames: Any, **_: Any) -> reproduction.Trials:
        names = reproduction.Trials.__dataclass_fields__
        return reproduction.Trials(**{name: np.zeros(len(truth.position), np.int32) for name in names})

    def identify(poses: Any, **_: Any) -> Any:
        raise EnoughError(len(poses))

    monkeypatch.setattr(comparison, "demonstrate", demonstrate)
    monkeypatch.setattr(comparison, "reproduce", reproduce)
    monkeypatch.setattr(comparison, "identify", identify)
    with pytest.raises(EnoughError, match="65"):
        reproduction.compare("A", KEY, 65)
    with pytest.raises(ValueError, match="Only 65 of 704 tasks are within the arm's reach"):
        reproduction.compare("A", KEY, 66)

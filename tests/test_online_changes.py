"""A stream says when its constraint changed."""

import jax
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.identification.changes import Change
from reframe_jax.simulation.motions import PoseErrors
from reframe_jax.simulation.sequences import simulate_sequence

DT, LENGTH = 0.02, 101


def changes(poses: np.ndarray, *, timed: bool = False, dt: float = DT) -> list[Change]:
    online = rf.OnlineIdentifier(LENGTH, dt=None if timed else dt)
    seen: list[Change] = []
    for index, pose in enumerate(poses):
        online.push(pose, 7 + dt * index if timed else None)
        if online.change is not None and online.change not in seen:
            seen.append(online.change)
    return seen


@pytest.mark.parametrize(
    ("errors", "delay"),
    [(PoseErrors(sigma=1e-5), 0.1), (PoseErrors(sigma=2e-4, rotation_ratio=5.0), 1.0)],
    ids=["encoder", "markers"],
)
def test_a_change_is_noticed_once_and_soon(errors: PoseErrors, delay: float) -> None:
    truth = simulate_sequence(["A", "K"], jax.random.key(4), dt=DT, errors=errors)
    (change,) = changes(np.asarray(truth.poses))
    assert abs(change.index - truth.boundaries[0]) <= 10
    assert change.time == pytest.approx(DT * change.index)
    assert 0 < change.delay <= delay


def test_times_of_the_stream_are_those_of_the_change() -> None:
    truth = simulate_sequence(["A", "K"], jax.random.key(4), dt=DT, errors=PoseErrors(sigma=1e-5))
    (change,) = changes(np.asarray(truth.poses)[:300], timed=True)
    assert change.time == pytest.approx(7 + DT * change.index)


def test_a_constraint_that_takes_over_from_free_motion_is_noticed() -> None:
    truth = simulate_sequence(["unconstrained", "A"], jax.random.key(0), dt=DT, errors=PoseErrors(sigma=1e-5))
    first, *_ = changes(np.asarray(truth.poses))
    assert abs(first.index - truth.boundaries[0]) <= LENGTH // 2
    assert 0 < first.delay <= 1.5 * LENGTH * DT


def test_a_single_constraint_changes_nothing_nor_does_an_outlier() -> None:
    truth = simulate_sequence(["A"], jax.random.key(3), dt=DT, errors=PoseErrors(sigma=1e-5))
    poses = np.asarray(truth.poses).copy()
    poses[180, :3, 3] += 0.05
    assert changes(poses) == []


@pytest.mark.parametrize("label", ["L", "unconstrained"])
def test_a_window_of_too_little_motion_changes_nothing(label: str) -> None:
    """101 poses hold about two independent motions; the frame found in them fails later."""
    truth = simulate_sequence([label], jax.random.key(1), dt=0.01, errors=PoseErrors(sigma=1e-5))
    assert changes(np.asarray(truth.poses), dt=0.01) == []

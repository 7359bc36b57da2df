"""Several recordings at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.simulation.motions import PoseErrors
from reframe_jax.simulation.sequences import simulate_sequence

DT = 0.02


@pytest.fixture(scope="module")
def recordings() -> list[np.ndarray]:
    errors = PoseErrors(sigma=1e-5)
    return [
        np.asarray(simulate_sequence(pair, jax.random.key(seed), dt=DT, durations=4.0, errors=errors).poses)[
            : 401 - 40 * seed
        ]
        for seed, pair in enumerate([("A", "K"), ("K", "B"), ("A", "unconstrained")])
    ]


def test_many_recordings_give_what_each_gives(recordings: list[np.ndarray]) -> None:
    found = rf.segment_many(recordings, dt=DT)
    times = [3 + DT * np.arange(len(poses)) for poses in recordings]
    timed = rf.segment_many(recordings, times=times)
    for one, other, poses in zip(found, timed, recordings, strict=True):
        single = rf.segment(poses, dt=DT)
        for many in (one, other):
            assert [s.name for s in many.segments] == [s.name for s in single.segments]
            assert [b.index for b in many.boundaries] == [b.index for b in single.boundaries]
        assert np.allclose(other.times, one.times + 3)
    assert rf.segment_many([], dt=DT) == []


def test_a_batch_is_an_array_of_recordings(recordings: list[np.ndarray]) -> None:
    batch = jnp.stack([jnp.asarray(poses[:320]) for poses in recordings[:2]])
    found = rf.segment_many(batch, dt=[DT, 2 * DT])
    assert [one.times[-1] for one in found] == pytest.approx([319 * DT, 638 * DT])
    assert found[0].segments[0].name == "Revolute joint"


def test_the_recording_that_is_refused_is_named(recordings: list[np.ndarray]) -> None:
    broken = recordings[1].copy()
    broken[7, 0, 0] = np.nan
    with pytest.raises(ValueError, match=r"Recording 1: .*NaN"):
        rf.segment_many([recordings[0], broken], dt=DT)
    with pytest.raises(ValueError, match="as many times as recordings, 3, not 1"):
        rf.segment_many(recordings, times=[np.arange(401)])
    with pytest.raises(ValueError, match="as many dt as recordings, 3, not 2"):
        rf.segment_many(recordings, dt=[DT, DT])

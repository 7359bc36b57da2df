"""Tasks of several constraints, stage by stage."""

import jax
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.segmentation.results import Segment, Segmentation
from reframe_jax.simulation import arm as panda
from reframe_jax.simulation import reproduction


def frame(label: str) -> rf.ConstraintFrame:
    return panda.frame_on_arm(label, start=reproduction.ROOMY)


@pytest.fixture(scope="module")
def played() -> reproduction.SequenceTrial:
    return reproduction.reproduce_sequence([frame("A"), frame("B")], [frame("A"), frame("B")])


def test_each_stage_begins_where_the_last_one_ended(played: reproduction.SequenceTrial) -> None:
    assert played.completed
    first, second = played.stages
    np.testing.assert_allclose(first.poses[-1], second.poses[0], atol=1e-12)
    # a hinge turns, then a slide moves
    turn = np.trace(
        np.asarray(second.poses)[:, :3, :3] @ np.asarray(second.poses)[0, :3, :3].T, axis1=1, axis2=2
    )
    assert np.all(turn > 3 - 1e-6)
    assert np.linalg.norm(second.poses[-1, :3, 3] - second.poses[0, :3, 3]) > 0.09
    assert played.hand_overs.shape == (1,)
    assert 0 <= played.hand_overs[0] <= float(second.peak_force)


def test_a_segmentation_is_played_in_its_own_frames(played: reproduction.SequenceTrial) -> None:
    parts, start = [], 0
    for label, stage in enumerate(played.stages):
        # on the host: arrays that are bound to a device would be another program
        identified = jax.device_get(rf.identify(np.asarray(stage.poses)[:30], dt=0.05))
        parts.append(Segment(start, start + 101, label, identified))
        start += 101
    found = Segmentation(tuple(parts), (), 0.05 * np.arange(start), 1.0)
    again = reproduction.reproduce_sequence([frame("A"), frame("B")], found)
    assert again.completed
    np.testing.assert_allclose(again.stages[-1].poses[-1], played.stages[-1].poses[-1], atol=0.01)


def test_a_stage_that_does_not_arrive_ends_the_task() -> None:
    # pushed along a slide, a hinge does not turn far enough
    stopped = reproduction.reproduce_sequence([frame("A"), frame("B")], [frame("B"), frame("B")])
    assert not stopped.completed
    assert len(stopped.stages) == 1
    assert stopped.hand_overs.shape == (0,)


def test_unusable_stages_are_refused() -> None:
    with pytest.raises(ValueError, match="2 constraints and 1 frames"):
        reproduction.reproduce_sequence([frame("A"), frame("B")], [frame("A")])
    short = Segmentation((Segment(0, 4, 0, None),), (), 0.05 * np.arange(4), 1.0)
    with pytest.raises(ValueError, match="too short to identify"):
        reproduction.reproduce_sequence([frame("A")], short)

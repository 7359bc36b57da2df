"""A stream of poses gives the same frames as its windows."""

import jax
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.identification import online
from reframe_jax.identification.options import Options
from reframe_jax.simulation import synthetic


@pytest.fixture(scope="module")
def recording():
    return synthetic.simulate("A", jax.random.key(1), noise=1e-4, duration=3.0)


def test_every_push_identifies_the_last_window(recording):
    stream = rf.OnlineIdentifier(21, dt=0.1)
    poses = np.asarray(recording.poses)
    found = [stream.push(pose) for pose in poses]
    assert found[:20] == [None] * 20
    assert len(stream) == 21
    for last in (20, 21, 30):
        window = rf.identify(poses[last - 20 : last + 1], dt=0.1)
        np.testing.assert_array_equal(found[last].linear.position, window.linear.position)
        assert found[last].name == window.name


def test_a_refused_pose_is_not_added(recording):
    stream = rf.OnlineIdentifier(21)
    poses, times = np.asarray(recording.poses), np.asarray(recording.times)
    for pose, time in zip(poses[:20], times[:20], strict=True):
        assert stream.push(pose, time) is None
    for bad, time, words in (
        (poses[20], times[19], "Times must increase"),
        (poses[20], None, "Give a time"),
        (np.full((4, 4), np.nan), times[20], "finite"),
        (np.eye(3), times[20], "finite"),
        (poses[20], np.inf, "finite number of seconds"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), times[20], "not a rigid transform"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), times[20], "not a rigid transform"),
    ):
        with pytest.raises(ValueError, match=words):
            stream.push(bad, time)
    found = stream.push(poses[20], times[20])
    window = rf.identify(poses[:21], times=times[:21])
    np.testing.assert_array_equal(found.linear.position, window.linear.position)


def test_a_time_far_in_the_future_does_not_block_the_stream(recording, monkeypatch):
    monkeypatch.setattr(online, "identify_unchecked", lambda poses, times, *_: np.asarray(times))
    stream = rf.OnlineIdentifier(5)
    pose = np.asarray(recording.poses)[0]
    for time in (0.0, 0.1, 1e9):
        assert stream.push(pose, time) is None
    for time in (0.2, 0.3, 0.1, 0.2):  # the third does not increase
        with pytest.raises(ValueError, match="Times must increase"):
            stream.push(pose, time)
        assert len(stream) == 3
    assert stream.push(pose, 0.3) is None
    assert len(stream) == 1
    for time in (0.4, 0.5, 0.6):
        assert stream.push(pose, time) is None
    np.testing.assert_array_equal(stream.push(pose, 0.7), [0.3, 0.4, 0.5, 0.6, 0.7])


def test_times_refused_now_and_then_empty_no_window(recording, monkeypatch):
    monkeypatch.setattr(online, "identify_unchecked", lambda *_: None)
    stream, pose = rf.OnlineIdentifier(5), np.asarray(recording.poses)[0]
    for time in range(20):
        stream.push(pose, time)
        with pytest.raises(ValueError, match="Times must increase"):
            stream.push(pose, time - 0.5)
    assert len(stream) == 5
    stream.reset()
    assert len(stream) == 0
    stream.push(pose, -1.0)
    assert len(stream) == 1


def test_the_first_time_must_be_a_number(recording):
    with pytest.raises(ValueError, match="finite number of seconds, not nan"):
        rf.OnlineIdentifier(5).push(np.asarray(recording.poses)[0], np.nan)


def test_a_sample_time_that_is_not_positive_is_refused():
    for dt in (0.0, -0.1, np.nan):
        with pytest.raises(ValueError, match="dt must be a positive number"):
            rf.OnlineIdentifier(5, dt=dt)


def test_a_window_too_short_is_refused():
    with pytest.raises(TypeError, match="has no option lag; choose from scales, assume, "):
        rf.OnlineIdentifier(20, dt=0.1, lag=3)  # type: ignore[call-arg]
    with pytest.raises(ValueError, match="at least 5 poses"):
        rf.OnlineIdentifier(4)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"scales": "long"}, "scales must be 'auto'"),
        ({"scales": 0}, "scales must be powers of two"),
        ({"scales": 16}, "an eighth of the window"),
        ({"assume": "wheel"}, "No constraint 'wheel'"),
        ({"discretization": "right"}, "discretization must be 'chord' or 'left', not 'right'"),
        ({"norm": 3.0}, "must lie in"),
        ({"thresholds": 0.1}, "thresholds must be Thresholds"),
        ({"thresholds": rf.Thresholds(-1.0, 0.1)}, "thresholds must be 0 or more"),
        ({"bounds": -1.0}, "bounds must be positive"),
        ({"bounds": np.ones(2)}, "bounds must be one length"),
        ({"solver": "best"}, "solver must be a search"),
    ],
)
def test_options_are_checked_when_the_stream_is_made(options, words):
    with pytest.raises(ValueError, match=words):
        rf.OnlineIdentifier(21, dt=0.1, **options)


def test_options_that_there_are_not_are_refused():
    with pytest.raises(TypeError, match="lag"):
        rf.OnlineIdentifier(21, lag=1)


def test_options_reach_the_identification(recording, monkeypatch):
    seen = []
    monkeypatch.setattr(online, "identify_unchecked", lambda poses, *given: seen.append(given))
    thresholds, solver, key = rf.Thresholds(0.1, 0.2), rf.BasinHopping(rf.ValleySteps(1)), jax.random.key(5)
    options = {"scales": 1, "norm": 1, "thresholds": thresholds, "bounds": 0.5, "solver": solver, "key": key}
    options["assume"] = "hinge"
    stream = rf.OnlineIdentifier(8, dt=0.1, **options)
    for pose in np.asarray(recording.poses)[:8]:
        stream.push(pose)
    assert seen == [(None, 0.1, Options(**options))]
    assert Options().discretization == "chord"

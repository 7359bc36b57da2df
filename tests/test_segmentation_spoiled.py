"""Segments do not depend on the choice of the body frame, or on outliers, repeated or missing poses."""

import numpy as np
import pytest

import reframe_jax as rf
from benchmarks.segmentation_cases import NAMES, Sequence, move_through, spoil
from reframe_jax.geometry.numpy_rotations import rotation_matrices
from reframe_jax.segmentation.sampling import fill_gaps, find_left_out

LABELS = ["hinge", "free", "ball", "slide"]
SIZES = {"encoder": {"white": 1e-5}, "markers": {"white": 3e-4}, "soft": {"white": 1e-6, "soft": 5e-4}}


def sequence(errors: str, motion: str = "sines", labels: list[str] = LABELS) -> Sequence:
    rng = np.random.default_rng(4)
    return move_through(labels, np.full(len(labels), 6.0), SIZES[errors], rng, 50, motion)


def assert_right(made: Sequence) -> None:
    """Every constraint is one segment with its name, and the changes are found."""
    found = rf.segment(made.poses, times=made.times)
    assert len(found) == len(made.labels)
    for segment, label in zip(found.segments, made.labels, strict=True):
        assert any(name in segment.name for name in NAMES[label])
    assert np.all(np.abs(made.changes - [boundary.time for boundary in found.boundaries]) < 0.5)
    assert [s.start for s in found.segments] == [0, *(boundary.index for boundary in found.boundaries)]
    assert found.segments[-1].stop == len(made.poses)
    assert all(b.earliest <= b.index <= b.latest and found.times[b.index] == b.time for b in found.boundaries)


@pytest.mark.parametrize("errors", sorted(SIZES))
def test_the_body_frame_may_be_distant(errors: str) -> None:
    made, moved = sequence(errors), np.eye(4)
    assert_right(spoil(made, "frame"))
    moved[2, 3] = 3.0
    assert_right(made._replace(poses=made.poses @ moved))


@pytest.mark.parametrize("motion", ["sines", "jerks"])
@pytest.mark.parametrize("errors", sorted(SIZES))
def test_one_pose_in_twenty_may_be_an_outlier(errors: str, motion: str) -> None:
    assert_right(spoil(sequence(errors, motion, ["ball", "hinge", "plane", "slide"]), "outliers"))


def test_a_recorder_may_write_every_pose_twice() -> None:
    made = spoil(sequence("markers"), "repeats")
    assert np.array_equal(find_left_out(made.poses, made.times), np.arange(len(made.poses)) % 2 == 1)
    assert_right(made)


@pytest.mark.parametrize("errors", sorted(SIZES))
def test_poses_may_be_missing_for_a_quarter_of_a_second(errors: str) -> None:
    assert_right(spoil(sequence(errors), "hidden"))


def test_short_gaps_are_filled_with_cubics() -> None:
    times = np.concatenate([np.arange(10), np.arange(13, 30), np.arange(60, 80)]) * 0.1
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, 3] = np.stack([times, times**2, 0.1 * times**3], axis=1)
    poses[:, :3, :3] = rotation_matrices(np.outer(np.sin(0.5 * times), [0.1, 0.2, 0.3]))
    filled, source = fill_gaps(poses, times, 0.1, 1.0)
    assert np.array_equal(source, [*range(10), 10, 10, 10, *range(10, len(times))])
    given = np.flatnonzero(np.diff(source, append=len(times)))
    assert np.array_equal(filled[given], poses)
    at = np.array([1.0, 1.1, 1.2])[:, None]
    expected = np.concatenate([at, at**2, 0.1 * at**3], axis=1)
    np.testing.assert_allclose(filled[10:13, :3, 3], expected, atol=1e-12)
    turned = rotation_matrices(np.sin(0.5 * at) * [0.1, 0.2, 0.3])
    np.testing.assert_allclose(filled[10:13, :3, :3], turned, atol=1e-5)


def test_poses_that_arrive_in_bursts_have_no_gaps() -> None:
    made = sequence("encoder")
    late = np.arange(len(made.times)) // 5 * 5
    times = made.times[np.minimum(late + 4, len(late) - 1)] + 1e-4 * (np.arange(len(late)) - late)
    filled, source = fill_gaps(made.poses, times, 0.02, 1.0)
    assert len(filled) == len(source) == len(made.poses)
    assert_right(made._replace(times=times))


def test_short_recordings_keep_their_poses() -> None:
    made = spoil(sequence("markers"), "repeats")
    found = rf.segment(made.poses[:17], times=made.times[:17])  # nine different poses
    assert (found.segments[0].start, found.segments[-1].stop) == (0, 17)


def test_outliers_are_found_in_recordings_of_any_length() -> None:
    """A recording is searched in blocks; outliers may lie where two blocks meet, and in the last block."""
    made = sequence("encoder", labels=[*LABELS, *LABELS, *LABELS, *LABELS])
    for number in (20, 511, 512, 513, 960, 961, 1500, len(made.poses)):
        planted = np.zeros(number, bool)
        planted[10:-3:47] = True
        planted[[k for k in (479, 480, 495, 496, 511, 512, 975, 992) if k < number - 3]] = True
        poses = made.poses[:number].copy()
        poses[planted, 2, 3] += 0.2
        assert np.array_equal(find_left_out(poses, made.times[:number]), planted)
        assert not find_left_out(made.poses[:number], made.times[:number]).any()

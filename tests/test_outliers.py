"""Flips and jumps are found by sample and take no part; what moves fast, or stays away, is none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import reframe_jax as rf
from reframe_jax.motion.kinematics import split_poses
from reframe_jax.motion.outliers import find_outliers
from reframe_jax.simulation import synthetic

POSES, DT, NOISE = 51, 0.04, 1e-4


@jax.jit
def find(poses, count, times=None):
    """Which poses (N, P, 4, 4) are outliers, (N, P)."""
    rotation, position = split_poses(poses)
    path = jnp.concatenate([rotation.reshape(9, *position.shape[1:]), position])
    times = DT * jnp.arange(path.shape[1]) if times is None else times
    steps = jnp.broadcast_to(jnp.diff(times)[:, None], (path.shape[1] - 1, len(poses)))
    return find_outliers(path, steps, count, jnp.zeros(len(poses))).T


@pytest.fixture(scope="module")
def poses():
    """A hinge that swings, (51, 4, 4)."""
    return np.array(synthetic.simulate("A", jax.random.key(5), noise=NOISE, dt=DT, duration=2.0).poses)


def found_in(poses):
    """Samples that do not count."""
    return list(np.flatnonzero(~np.asarray(rf.identify(poses, dt=DT).counted)))


def turn(poses, samples, angle):
    spoilt = poses.copy()
    spoilt[samples, :3, :3] = spoilt[samples, :3, :3] @ Rotation.from_rotvec([angle, 0, 0]).as_matrix()
    return spoilt


def shift(poses, samples, distance):
    spoilt = poses.copy()
    spoilt[samples, :3, 3] += np.array([0.0, 0.6, 0.8]) * distance
    return spoilt


@pytest.mark.parametrize("samples", [[30], [12, 13], [3, 28, 29, 45], [0], [1], [49], [50], [0, 4]], ids=str)
@pytest.mark.parametrize(
    "spoil", [lambda p, s: turn(p, s, np.pi), lambda p, s: turn(p, s, 0.2), lambda p, s: shift(p, s, 0.05)]
)
def test_jumps_are_found_by_sample_and_left_out(poses, samples, spoil):
    clean = rf.identify(poses, dt=DT)
    assert np.all(clean.counted)
    found = rf.identify(spoil(poses, samples), dt=DT)
    assert list(np.flatnonzero(~np.asarray(found.counted))) == samples
    assert found.name == clean.name == "Revolute joint"
    axis = np.asarray(clean.angular.axes)[:, 2]
    assert np.degrees(np.arccos(min(1, abs(axis @ np.asarray(found.angular.axes)[:, 2])))) < 0.1
    offset = np.asarray(found.linear.position - clean.linear.position)
    if found.linear.frame_type is clean.linear.frame_type:
        along = np.asarray(clean.linear.free_position)
        assert np.linalg.norm(offset - along @ offset) < 10 * NOISE
    np.testing.assert_allclose(found.noise.position, clean.noise.position, rtol=0.2)


def test_nothing_is_left_out_of_consecutive_poses(poses):
    """scales=1 is the paper's: every pose counts."""
    batch = np.tile(shift(poses, [30], 0.05), (9, 1, 1, 1))  # a batch has the program of test_global.py
    assert np.all(rf.identify(batch, dt=DT, scales=1, bounds=1.0).counted)


def test_fast_motion_is_no_outlier():
    """A body that turns by a radian a sample, and one that is hit."""
    times = DT * np.arange(POSES)
    fast = np.tile(np.eye(4), (POSES, 1, 1))
    fast[:, :3, :3] = Rotation.from_rotvec(np.outer(25 * times, [0.0, 0.0, 1.0])).as_matrix()
    hit = np.tile(np.eye(4), (POSES, 1, 1))
    hit[:, 0, 3] = np.abs(times - 1.2)
    swing = np.tile(np.eye(4), (POSES, 1, 1))
    swing[:, 1, 3] = 0.3 * np.sin(6 * times)
    for window in (fast, hit, swing):
        window[:, :3, 3] += 1e-5 * np.random.default_rng(0).normal(size=(POSES, 3))
        assert found_in(window) == []


@pytest.mark.parametrize("samples", [8, 10, 20, 40])
@pytest.mark.parametrize("pause", [2, 30])
def test_a_short_fast_motion_between_rests_is_no_outlier(samples, pause):
    """A robot goes 0.2 m and 0.5 rad away with minimum jerk, rests there, and comes back."""
    u = np.clip((np.arange(150) - 40) / samples, 0, 1)
    v = np.clip((np.arange(150) - 40 - samples - pause) / samples, 0, 1)
    part = sum(sign * x**3 * (10 - 15 * x + 6 * x**2) for sign, x in ((1, u), (-1, v)))
    window = np.tile(np.eye(4), (150, 1, 1))
    window[:, :3, :3] = Rotation.from_rotvec(np.outer(0.5 * part, [0.6, 0.0, 0.8])).as_matrix()
    window[:, :3, 3] = 0.2 * part[:, None] * [0.0, 1.0, 0.0]
    window[:, :3, 3] += 1e-6 * np.random.default_rng(0).normal(size=(150, 3))
    assert not np.any(find(window[None], np.array([150])))


@pytest.mark.parametrize(("step", "missing"), [(0.07, 6), (0.1, 3), (0.05, 6)])
def test_poses_between_two_gaps_are_no_outliers(step, missing):
    """The cubic through the poses around two gaps is far from the ten poses between the gaps."""
    times = step * np.arange(100)
    every = synthetic.simulate("A", jax.random.key(5), noise=NOISE, dt=step, duration=100 * step).poses[:100]
    kept = np.flatnonzero(np.arange(100) % (10 + missing) >= missing)
    seen, count = np.array(every)[kept], np.array([len(kept)])
    assert not np.any(find(seen[None], count, times[kept]))
    assert list(np.flatnonzero(find(shift(seen, [24, 30], 0.5)[None], count, times[kept])[0])) == [24, 30]


def test_a_step_that_does_not_come_back_is_no_outlier(poses):
    assert found_in(shift(poses, slice(30, None), 0.05)) == []


def test_too_many_outliers_are_none(poses):
    """Beyond a third it is not known which are the poses."""
    every_other = list(range(0, POSES, 2))
    assert found_in(shift(poses, every_other, 0.05)) == []


def test_padding_and_other_windows_have_no_outliers(poses):
    spoilt = turn(shift(poses, [20, 21], 0.3), [20, 21], 1.0)
    spoilt[40:] = spoilt[39]
    found = np.asarray(find(np.stack([spoilt, poses]), np.array([40, POSES], np.int32)))
    assert list(np.flatnonzero(found[0])) == [20, 21]
    assert not np.any(found[1])


def test_an_outlier_is_as_a_pose_that_was_never_recorded(poses):
    times, samples = DT * np.arange(POSES), [0, 12, 13, 30]
    found = rf.identify(turn(shift(poses, samples, 0.3), samples, 1.0), times=times)
    kept = np.delete(np.arange(POSES), samples)
    other = rf.identify(poses[kept], times=times[kept])
    np.testing.assert_array_equal(np.flatnonzero(found.counted), kept)
    np.testing.assert_allclose(found.entry_probability, other.entry_probability, atol=1e-5)
    np.testing.assert_allclose(found.linear.position, other.linear.position, atol=1e-7)
    np.testing.assert_allclose(found.linear.rms, other.linear.rms, rtol=1e-5)
    np.testing.assert_allclose(found.noise.position, other.noise.position, rtol=1e-5)

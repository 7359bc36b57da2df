"""Long recordings: slow drift of what is held, long free motion, and trackers that move in a plane."""

import jax
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.geometry.transforms import make_pose

RATE = 3.4  # Hz


def sines(rng, times, sizes, slowest, fastest):
    """Sums of three sines (K+1, n) with the given standard deviations (n,), with frequencies in Hz."""
    shape = (3, 1, len(sizes))
    rates, phases = 2 * np.pi * rng.uniform(slowest, fastest, shape), rng.uniform(0, 2 * np.pi, shape)
    waves = np.sum(rng.uniform(0.3, 1, shape) * np.sin(rates * times[:, None] + phases), axis=0)
    return (waves - waves.mean(axis=0)) / waves.std(axis=0) * sizes


def poses_of(rotvec, position):
    with jax.enable_x64(True):
        return np.asarray(make_pose(rotation_exp(np.asarray(rotvec)), np.asarray(position)))


@pytest.mark.parametrize("seed", [0, 1])
def test_a_drift_of_the_rotation_does_not_hide_a_slide(seed):
    """Drift exceeds the noise only at scales at which the blocks average over the motion."""
    rng = np.random.default_rng(seed)
    times = np.arange(512) / RATE
    walk = np.cumsum(rng.normal(size=(4, 512, 3)), axis=1) / np.sqrt(512)
    along = np.stack([sines(rng, times, np.array([0.07]), 0.02, 0.3) for _ in range(4)])
    axis = rng.normal(size=3)
    position = along * axis / np.linalg.norm(axis) + 2e-4 * rng.normal(size=(4, 512, 3))
    poses = poses_of(5e-3 * walk + 1e-3 * rng.normal(size=walk.shape), position + 5e-4 * walk[::-1])
    for window in poses:
        found = rf.identify(window, times=times)
        assert found.name == "Prismatic joint"
        assert found.linear.amplitude[2] > 0.05


@pytest.mark.parametrize(("turn", "seconds"), [(1.0, 25.6), (0.5, 102.4)])
def test_long_free_motion_is_unconstrained(turn, seconds):
    """Twists add up: in types that the motion does not suit, coordinates are the larger the longer it is."""
    rng = np.random.default_rng(2)
    times = np.linspace(0, seconds, 512)
    for _ in range(4):
        rates = sines(rng, times, np.array([1.0] * 6), 0.1, 0.8)
        pose, poses, step = np.eye(4), [], times[1]
        for spin, speed in zip(1.5 * turn * rates[:, :3], 0.2 * rates[:, 3:], strict=True):
            poses.append(pose)
            pose = pose @ poses_of(step * spin, step * speed)
        measured = np.array(poses)
        measured[:, :3, 3] += 2e-4 * rng.normal(size=(512, 3))
        assert rf.identify(measured, times=times).name == "Unconstrained"


def test_a_hinge_seen_by_a_planar_tracker_has_wide_error_bars():
    """Constant components do not stop the fit of parts of the recording."""
    rng = np.random.default_rng(3)
    times = np.arange(128) / 12.8
    inside = []
    for _ in range(8):
        angle = sines(rng, times, np.array([0.5]), 0.1, 0.8)[:, 0]
        axis = rng.uniform(-0.5, 0.5, 2)
        arm = 0.3 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        position = arm + np.append(axis, 0.0)
        position[:, :2] += sines(rng, times, np.array([3e-4, 3e-4]), 0.05, 0.3)
        poses = poses_of(angle[:, None] * np.array([0, 0, 1.0]), position)
        found = rf.identify(poses, times=times)
        assert found.name == "Revolute joint"
        spread = np.asarray(rf.covariance(found, poses, times=times).position)
        frame, place = found.linear, np.asarray(found.linear.position)
        body = poses[:, :3, :3].transpose(0, 2, 1) @ (np.append(axis, 0.0) - poses[:, :3, 3])[:, :, None]
        truth = np.append(axis, 0.0) if str(frame.frame_type)[1] == "G" else body[:, :, 0].mean(axis=0)
        error = (place - truth)[:2]
        inside.append(error @ np.linalg.solve(spread[:2, :2], error) < 5.99)
    assert sum(inside) >= 5  # of 8; three with error bars for white noise

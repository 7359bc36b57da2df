"""Runs of poses that jump away together are found and left out; what moves, or stays away, is none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import reframe_jax as rf
from reframe_jax.motion.kinematics import split_poses
from reframe_jax.motion.noise import unit_of_rounding
from reframe_jax.motion.outliers import find_outliers
from reframe_jax.simulation import synthetic

POSES, DT, NOISE = 151, 0.04, 1e-3
LONGEST_RUN = 12


@jax.jit
def find(poses, count):
    rotation, position = split_poses(poses[None])
    own = np.arange(len(poses))[:, None] < count
    path = jnp.concatenate([rotation.reshape(9, *own.shape), position])
    steps = jnp.full((len(poses) - 1, 1), DT)
    return find_outliers(path, steps, count[None], unit_of_rounding(position, own))[:, 0]


@pytest.fixture(scope="module")
def poses():
    """A hinge that swings, seen by a camera, (151, 4, 4)."""
    return np.array(synthetic.simulate("A", jax.random.key(5), noise=NOISE, dt=DT, duration=6.0).poses)


def found_in(poses):
    return list(np.flatnonzero(find(poses, np.int32(len(poses)))))


def flip(poses, samples):
    spoilt = poses.copy()
    spoilt[samples, :3, :3] = Rotation.from_rotvec([0.0, 3.0, 0.0]).as_matrix() @ spoilt[samples, :3, :3]
    return spoilt


def shift(poses, samples):
    spoilt = poses.copy()
    spoilt[samples, :3, 3] += np.array([0.0, 0.03, 0.04])
    return spoilt


def scramble(poses, samples):
    """Every pose of the run is 0.2 m off, each in a direction of its own."""
    spoilt = poses.copy()
    away = np.random.default_rng(2).normal(size=(len(samples), 3))
    spoilt[samples, :3, 3] += 0.2 * away / np.linalg.norm(away, axis=1, keepdims=True)
    return spoilt


def freeze(poses, samples):
    """The tracker repeats a pose that it saw elsewhere."""
    spoilt = poses.copy()
    spoilt[samples] = poses[samples[0]]
    spoilt[samples, :3, 3] += 0.3
    return spoilt


RUNS = {"short": [70, 71, 72], "long": list(range(40, 50)), "two": [30, 31, 32, 33, 40, 41, 42]}


@pytest.mark.parametrize("samples", RUNS.values(), ids=RUNS)
@pytest.mark.parametrize("spoil", [flip, scramble, freeze], ids=lambda spoil: spoil.__name__)
def test_runs_are_found_by_sample(poses, samples, spoil):
    assert found_in(poses) == []
    assert found_in(spoil(poses, samples)) == samples


def test_a_run_that_is_as_long_as_the_motion_beside_it_is_large(poses):
    """The further the body moves during a run, the further off the run must be."""
    longest = list(range(40, 40 + LONGEST_RUN))
    assert found_in(flip(poses, longest)) == longest
    assert found_in(flip(poses, list(range(40, 40 + 3 * LONGEST_RUN)))) == []


def test_identify_leaves_them_out(poses):
    samples = [20, 50, 51, 52, 53, 54, 55, 90, 91, 92, 93]
    clean, found = (rf.identify(p, dt=DT) for p in (poses, flip(shift(poses, samples), samples)))
    assert list(np.flatnonzero(~np.asarray(found.counted))) == samples
    assert found.name == clean.name == "Revolute joint"
    np.testing.assert_allclose(found.noise.position, clean.noise.position, rtol=0.2)
    axes = [np.asarray(f.angular.axes)[:, 2] for f in (clean, found)]
    assert np.degrees(np.arccos(min(1, abs(axes[0] @ axes[1])))) < 0.1


def test_what_stays_away_is_no_run(poses):
    """And one at an end of the window cannot be told from a body that was elsewhere."""
    for samples in (slice(70, None), slice(70, 70 + 4 * LONGEST_RUN), slice(None, 8), slice(-8, None)):
        assert found_in(shift(poses, samples)) == []


def test_a_clock_that_is_late_makes_no_run(poses):
    """The body went on: its steps are longer and shorter, in the direction in which it moves."""
    times = DT * (np.arange(POSES) + np.random.default_rng(0).choice([-0.45, 0, 0.45], POSES))
    moving = np.tile(np.eye(4), (POSES, 1, 1))
    moving[:, :3, :3] = Rotation.from_rotvec(np.outer(times, [0.0, 0.2, 0.5])).as_matrix()
    moving[:, :3, 3] = np.outer(times, [0.1, 0.0, 0.2])
    assert found_in(moving) == []


def test_rounding_makes_no_run(poses):
    """A slow body seen to the millimetre steps on and back; of longer steps nothing is lost."""
    slow = np.tile(np.eye(4), (POSES, 1, 1))
    slow[:, 0, 3] = 1e-3 * np.round(2 * np.sin(0.5 * DT * np.arange(POSES)) + 0.5)
    slow[70:75, 1, 3] += 1e-3
    assert found_in(slow) == []
    assert found_in(shift(slow, RUNS["short"])) == RUNS["short"]


def test_short_windows_and_padding(poses):
    assert found_in(poses[:12]) == []
    padded = shift(poses, RUNS["short"])
    padded[100:] = padded[99]
    assert list(np.flatnonzero(find(padded, np.int32(100)))) == RUNS["short"]


def test_a_slow_tracker_that_repeats_its_poses_makes_no_run(poses):
    """The path is a staircase; one step of it that is far off is still found."""
    moving = np.repeat(poses[::3], 3, axis=0)
    assert found_in(moving) == []
    assert found_in(np.repeat(shift(poses[::3], [20]), 3, axis=0)) == [60, 61, 62]

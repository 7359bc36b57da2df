"""Chords of any length: against a loop, and against single windows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.motion.chords import chord_velocities, moving_chords, spread_of
from reframe_jax.motion.kinematics import (
    linear_velocity_maps,
    paths_of,
    rates_of,
    split_poses,
    turn_paths,
    turn_rates,
    velocity_paths,
)
from reframe_jax.simulation import synthetic

POSES = 61
STEPS = np.random.default_rng(4).uniform(0.03, 0.05, POSES - 1)
TIMES = np.concatenate([[0], np.cumsum(STEPS)])
LAGS = np.array([1, 5, 12], np.int32)
BB, GB, GG, BG = range(4)


@pytest.fixture(scope="module")
def poses():
    """(3, POSES, 4, 4)."""
    keys = jax.random.split(jax.random.key(2), 3)
    return jax.vmap(lambda key: synthetic.simulate("K", key, dt=0.04, duration=2.4).poses)(keys)


@pytest.fixture(scope="module")
def paths(poses):
    return jax.jit(velocity_paths)(poses, STEPS)[1]


def loop(poses, maps, lag, origin):
    """Velocity of an origin over every chord, (4, K+1-lag, 3), in the four types."""
    found = np.zeros((4, POSES - lag, 3))
    for k in range(POSES - lag):
        here, there, span = poses[k], poses[k + lag], TIMES[k + lag] - TIMES[k]
        of_body = [pose[:3, :3] @ origin + pose[:3, 3] for pose in (here, there)]
        of_ground = [pose[:3, :3].T @ (origin - pose[:3, 3]) for pose in (here, there)]
        found[GB, k] = (of_body[1] - of_body[0]) / span
        found[BG, k] = (of_ground[0] - of_ground[1]) / span  # the body moves against it
        for kind in (BB, GG):  # what the single steps have gone
            steps = maps[kind, k : k + lag]
            single = steps[:, :, 0] + steps[:, :, 1:] @ origin
            found[kind, k] = np.sum(STEPS[k : k + lag, None] * single, axis=0) / span
    return found


def test_chords_are_those_of_a_loop(poses, paths):
    """Of all four types, each window with a lag of its own; what reaches beyond the window is zero."""
    inside = np.arange(POSES - 1)[:, None] + LAGS[None] < POSES
    times = jnp.asarray(np.repeat(TIMES[:, None], 3, axis=1))
    found = jax.jit(chord_velocities)(paths, times, LAGS, inside.astype(float))
    maps = np.asarray(jax.jit(linear_velocity_maps)(poses, STEPS))
    origin = np.array([0.3, -0.2, 0.5])
    for window, lag in enumerate(LAGS):
        here = np.asarray(found[..., window])
        velocity = np.moveaxis(here[:, 0] + np.einsum("ijkt,j->ikt", here[:, 1:], origin), 0, -1)
        velocity = np.swapaxes(velocity, 0, 1)
        number = POSES - lag
        scale = np.sqrt((POSES - 1) / number)  # the mean of squares over all rows is that of the chords
        expected = loop(np.asarray(poses[window]), maps[window], lag, origin)
        np.testing.assert_allclose(velocity[:, :number] / scale, expected, atol=1e-12)
        assert not np.any(velocity[:, number:])


def test_weights_are_those_of_the_mean_square(paths, rng):
    times, lag = jnp.asarray(np.repeat(TIMES[:, None], 3, axis=1)), np.full(3, 5, np.int32)
    ones = np.zeros((POSES - 1, 3))
    ones[: POSES - 5] = 1
    weights = ones * rng.random(ones.shape)
    plain, weighted = (np.asarray(jax.jit(chord_velocities)(paths, times, lag, w)) for w in (ones, weights))
    plain = plain * np.sqrt((POSES - 5) / (POSES - 1))
    for window in range(3):
        expected = np.average(
            plain[:, :, : POSES - 5, :, window] ** 2, axis=2, weights=weights[: POSES - 5, window]
        )
        found = np.mean(weighted[..., window] ** 2, axis=2)
        np.testing.assert_allclose(found, expected, rtol=1e-10)


def test_rest_and_what_does_not_count_have_no_weight():
    """The body lies still for the first twenty samples; pose 40 is lost."""
    counted = np.ones((POSES, 3), bool)
    counted[40] = False
    position = np.zeros((3, POSES, 3))
    position[0, 20:] = 0.1 * np.arange(POSES - 20)[:, None]
    rotation = np.repeat(np.eye(3)[:, :, None, None], POSES, axis=2).repeat(3, axis=3)
    noise = jnp.full(3, 1e-3), jnp.full(3, 1e-3)
    found = np.asarray(jax.jit(moving_chords)(rotation, position, counted, LAGS, noise))
    for window, lag in enumerate(LAGS):
        start = np.arange(POSES - 1)
        expected = (start + lag > 20) & (start + lag < POSES) & (start != 40) & (start + lag != 40)
        np.testing.assert_array_equal(found[:, window], expected)
    # where next to nothing moves, rest is all there is
    still = np.asarray(jax.jit(moving_chords)(rotation, 1e-6 * position, counted, LAGS, noise))
    assert np.sum(still[:, 0]) == POSES - 1 - 2


def test_spread_is_that_of_the_poses_that_count(paths, rng):
    counted = rng.random((POSES, 3)) < 0.7
    spread, mean = (np.asarray(a) for a in jax.jit(spread_of)(paths, counted))
    for window in range(3):
        kept = np.asarray(paths[..., window])[:, :, counted[:, window]]
        np.testing.assert_allclose(mean[..., window], kept.mean(axis=2), atol=1e-12)
        np.testing.assert_allclose(np.mean(spread[..., window] ** 2, axis=2), kept.var(axis=2), atol=1e-12)


def test_windows_of_one_batch_have_lags_of_their_own():
    """An encoder's and two cameras', in one batch and one by one."""
    noises = jnp.asarray([1e-7, 1e-4, 3e-3])
    keys = jax.random.split(jax.random.key(5), 3)
    simulate = jax.vmap(
        lambda key, noise: synthetic.simulate("A", key, noise=noise, dt=0.04, duration=2.0).poses
    )
    windows = np.asarray(simulate(keys, noises))
    found = rf.identify(windows, dt=0.04)
    assert found.lag[0] == 1 < found.lag[1] < found.lag[2] <= 10
    for i in range(3):
        alone = rf.identify(windows[i], dt=0.04)
        assert alone.lag == found.lag[i]
        assert alone.name == found.name[i] == "Revolute joint"
        np.testing.assert_allclose(alone.linear.rms, found.linear.rms[i], rtol=1e-6)
        np.testing.assert_allclose(alone.linear.position, found.linear.position[i], atol=1e-6)


def test_a_lag_in_samples_and_in_seconds():
    poses = np.asarray(synthetic.simulate("A", jax.random.key(5), noise=3e-4, dt=0.04, duration=2.0).poses)
    by_number, by_time = (rf.identify(poses, dt=0.04, lag=lag) for lag in (5, 0.2))
    assert by_number.lag == by_time.lag == 5
    np.testing.assert_array_equal(by_number.linear.rms, by_time.linear.rms)


@pytest.mark.parametrize("count", [None, np.array([POSES, 40, 33], np.int32)])
def test_turns_need_no_positions(poses, count):
    """They are the rates of the whole paths, of whole windows and of padded ones."""
    rotation, position = split_poses(poses)

    @jax.jit
    def both(rotation, position):
        steps = jnp.asarray(STEPS)[None]
        whole = rates_of(paths_of(rotation, position, steps, count)[1])[:, 0]
        return whole, turn_paths(turn_rates(rotation, steps, count), steps)

    whole, alone = both(rotation, position)
    np.testing.assert_allclose(alone, whole, rtol=0, atol=1e-14)
    assert np.ptp(np.asarray(alone), axis=1).min() > 0.1

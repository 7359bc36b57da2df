"""The noise that poses show."""

import jax
import numpy as np
import pytest

import reframe_jax as rf
from benchmarks import golden_cases
from reframe_jax.motion.noise import estimate_noise, masked_median, unit_of_rounding

POSES = 400
SIGMAS = np.array([1e-5, 1e-4, 1e-3, 4e-3])  # m, of as many windows; three times as many rad
estimate = jax.jit(lambda *given: estimate_noise(*given)[0])
ALL = np.ones((POSES, len(SIGMAS)), bool)
NO_UNIT = np.zeros(len(SIGMAS))
TIMES = np.repeat(0.02 * np.arange(POSES)[:, None], len(SIGMAS), axis=1)


def smooth(amplitude=0.3, rates=(1.1, 1.7, 2.3), dt=0.02):
    """Sines (3, POSES, windows) along three components."""
    t = dt * np.arange(POSES)
    values = amplitude * np.stack([np.sin(rate * t + i) for i, rate in enumerate(rates)])
    return np.repeat(values[..., None], len(SIGMAS), axis=-1)


def white(rng):
    return rng.normal(size=(3, POSES, len(SIGMAS)))


def test_white_noise_is_measured(rng):
    position = smooth() + SIGMAS * white(rng)
    turns = np.diff(smooth(0.5) + 3 * SIGMAS * white(rng), axis=1)
    of_position, of_rotation = estimate(position, turns, TIMES, ALL, NO_UNIT)
    np.testing.assert_allclose(of_position, SIGMAS, rtol=0.15)
    np.testing.assert_allclose(of_rotation, 3 * SIGMAS, rtol=0.15)


def test_missing_poses_are_no_noise(rng):
    """The times show where poses are missing."""
    kept = np.sort(rng.permutation(POSES)[: 3 * POSES // 4])
    position, path = ((smooth() + SIGMAS * white(rng))[:, kept] for _ in range(2))
    noise = estimate(position, np.diff(path, axis=1), TIMES[kept], ALL[kept], NO_UNIT)
    np.testing.assert_allclose(noise, (SIGMAS, SIGMAS), rtol=0.3)


def test_times_that_jitter_are_no_noise(rng):
    """The poses are as smooth as at equal steps."""
    position, path = (smooth() + SIGMAS * white(rng) for _ in range(2))
    late = TIMES + rng.uniform(0, 0.01, size=TIMES.shape)
    noise = estimate(position, np.diff(path, axis=1), late, ALL, NO_UNIT)
    np.testing.assert_allclose(noise, (SIGMAS, SIGMAS), rtol=0.15)


def test_smooth_motion_has_no_noise():
    """Nor does motion in jerks, of which there are few; but no noise is less than the rounding."""
    position, turns = smooth(), np.diff(smooth(0.5), axis=1)
    position[:, 200:] += 0.1
    for noise, largest in zip(
        estimate(position, turns, TIMES, ALL, NO_UNIT), (np.abs(position), np.abs(turns)), strict=True
    ):
        assert np.all(noise < 1e-9)
        assert np.all(noise >= np.finfo(float).eps * largest.max())


def test_rounded_positions_have_the_noise_of_their_rounding():
    """Also where the body moves so slowly that most digits stay as they are."""
    for amplitude in (0.3, 0.003):
        position = 1e-3 * np.round(1e3 * smooth(amplitude))
        unit = jax.jit(unit_of_rounding)(position, ALL)
        of_position, _ = estimate(position, np.diff(smooth(), axis=1), TIMES, ALL, unit)
        assert np.all(of_position > 0.99e-3 / np.sqrt(12))
        assert np.all(of_position < 1e-3)


def test_samples_that_do_not_count_play_no_part(rng):
    """Lost frames in the middle, and padding at the end."""
    position, turns = smooth() + SIGMAS * white(rng), np.diff(smooth() + SIGMAS * white(rng), axis=1)
    lost = ALL.copy()
    lost[50:90:9] = lost[300:] = False
    spoilt, whirled = position.copy(), turns.copy()
    spoilt[:, ~lost[:, 0]] = 9 * rng.normal(size=spoilt[:, ~lost[:, 0]].shape)
    beside = ~(lost[1:, 0] & lost[:-1, 0])
    whirled[:, beside] = 9 * rng.normal(size=whirled[:, beside].shape)
    here, there = (estimate(*path, TIMES, lost, NO_UNIT) for path in ((position, turns), (spoilt, whirled)))
    np.testing.assert_allclose(here, (SIGMAS, SIGMAS), rtol=0.2)
    # but for the rounding of numbers as large as these
    np.testing.assert_allclose(there, here, rtol=1e-9)


def test_the_median_of_what_counts(rng):
    values = 10.0 ** rng.uniform(-9, 2, size=(301, 4))
    counted = rng.random(values.shape) < [1.0, 0.5, 0.1, 0.0]
    found = jax.jit(masked_median)(values, counted)
    for i in range(3):
        ordered = np.sort(values[counted[:, i], i])
        middle = ordered[(len(ordered) - 1) // 2 : len(ordered) // 2 + 1]
        assert 0.995 * middle[0] <= found[i] <= 1.005 * middle[-1]
    assert found[3] == 0


@pytest.mark.parametrize("late", [0.0, 0.45])
def test_times_that_jitter_are_noticed(late):
    """The poses are evenly spaced; the times are wrong by up to ``late`` steps."""
    turns = np.diff(smooth(), axis=1)
    times = TIMES + late * (TIMES[1] - TIMES[0]) * np.random.default_rng(3).uniform(-1, 1, TIMES.shape)
    jitter = jax.jit(estimate_noise)(smooth(), turns, times, ALL, NO_UNIT)[1]
    assert np.all(jitter == (late > 0))


@pytest.mark.parametrize("label", "EF")
def test_times_that_jitter_do_not_bend_the_paths_of_twists(label):
    """Skates and wheels, which restrict velocities, at 10 Hz; a plane would hold fewer of them exactly."""
    cases = golden_cases.simulate(
        [golden_cases.Spec("white", label, "exciting", 10, 1e-6, seed=seed) for seed in range(400, 408)]
    )
    number = len(cases[0].poses)
    late = np.random.default_rng(0).uniform(-0.49, 0.49, (len(cases), number))
    found = rf.identify(np.stack([case.poses for case in cases]), times=(np.arange(number) + late) / 10)
    assert all(name in case.expected for name, case in zip(found.name, cases, strict=True))

"""The noise that poses show, and the chord it calls for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from reframe_jax.motion.noise import choose_lag, estimate_noise, masked_median

POSES = 400
SIGMAS = np.array([1e-5, 1e-4, 1e-3, 4e-3])  # m, of as many windows; three times as many rad
estimate, choose = jax.jit(estimate_noise), jax.jit(choose_lag)
ALL = np.ones((POSES, len(SIGMAS)), bool)
COUNT = np.full(len(SIGMAS), POSES, np.int32)


def smooth(amplitude=0.3, rates=(1.1, 1.7, 2.3), dt=0.02):
    """Sines (3, POSES, windows) along three components."""
    t = dt * np.arange(POSES)
    values = amplitude * np.stack([np.sin(rate * t + i) for i, rate in enumerate(rates)])
    return np.repeat(values[..., None], len(SIGMAS), axis=-1)


def white(rng):
    return rng.normal(size=(3, POSES, len(SIGMAS)))


def about_z(angle):
    """Rotations (3, 3, POSES, windows) by angles (POSES, windows)."""
    c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return np.stack([np.stack(row) for row in ([c, -s, zero], [s, c, zero], [zero, zero, one])])


def test_white_noise_is_measured(rng):
    position = smooth() + SIGMAS * white(rng)
    turns = np.diff(smooth(0.5) + 3 * SIGMAS * white(rng), axis=1)
    of_position, of_rotation = estimate(position, turns, ALL)
    np.testing.assert_allclose(of_position, SIGMAS, rtol=0.15)
    np.testing.assert_allclose(of_rotation, 3 * SIGMAS, rtol=0.15)


def test_smooth_motion_has_no_noise():
    """Nor does motion in jerks, of which there are few; but no noise is less than the rounding."""
    position, turns = smooth(), np.diff(smooth(0.5), axis=1)
    position[:, 200:] += 0.1
    for noise, largest in zip(estimate(position, turns, ALL), (np.abs(position), np.abs(turns)), strict=True):
        assert np.all(noise < 1e-9)
        assert np.all(noise >= np.finfo(float).eps * largest.max())


def test_rounded_positions_have_the_noise_of_their_rounding():
    """Also where the body moves so slowly that most digits stay as they are."""
    for amplitude in (0.3, 0.003):
        position = 1e-3 * np.round(1e3 * smooth(amplitude))
        of_position, _ = estimate(position, np.diff(smooth(), axis=1), ALL)
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
    here, there = estimate(position, turns, lost), estimate(spoilt, whirled, lost)
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


def lags(position, angle, noise, count=COUNT):
    noise = tuple(jnp.asarray(np.broadcast_to(size, len(SIGMAS))) for size in noise)
    return np.asarray(choose(about_z(angle), position, ALL, noise, count))


def test_an_encoder_needs_no_chord_and_a_camera_one_that_grows_with_its_noise():
    position, angle = smooth(), smooth(0.4)[0]
    assert np.all(lags(position, angle, (1e-6, 3e-6)) == 1)
    found = lags(position, angle, (SIGMAS, 3 * SIGMAS))
    assert np.all(np.diff(found) >= 0)
    assert found[0] == 3  # a twentieth of the longest chord
    assert 4 <= found[2] < found[3]
    # no longer than needed: the next shorter chord is less than 70 noises, in one of the groups
    turned = np.abs(2 * np.sin((angle[6:] - angle[:-6]) / 2))[:, 2]
    shifted = np.linalg.norm(position[:, 6:, 2] - position[:, :-6, 2], axis=0)
    long_at_6 = min(np.median(turned) / 3e-3, np.median(shifted) / 1e-3) >= 70
    assert (found[2] <= 6) == long_at_6


def test_a_short_chord_grows_to_a_twentieth_of_the_longest_or_1000_noises():
    """Some axis may move far less than the body."""
    position = smooth()
    medians = {
        lag: np.median(np.linalg.norm(position[:, lag:, 0] - position[:, :-lag, 0], axis=0))
        for lag in range(1, COUNT[0] // 6)
    }
    longest, sigmas = max(medians.values()), np.array([1e-9, 1e-6, 1e-5, 5e-5])
    found = lags(position[:, :, :1].repeat(4, axis=2), np.zeros((POSES, 4)), (sigmas, 1e-6))
    for sigma, lag in zip(sigmas, found, strict=True):
        goal = min(1000 * sigma, 0.05 * longest)
        assert medians[lag] >= max(goal, 70 * sigma)
        assert lag == 1 or medians[lag - 1] < 1.5 * goal
    assert found[0] == 1 < found[-1]


@pytest.mark.parametrize("poses", [400, 100, 13, 12, 7])
def test_six_chords_fit_the_window(poses):
    """In the poses that are no padding."""
    found = lags(smooth(), 0.3 * smooth()[0], (0.05, 1e-6), np.full(len(SIGMAS), poses, np.int32))
    assert np.all(found <= max(1, (poses - 1) // 6))
    assert poses < 100 or np.all(found > 8)


def test_no_chord_turns_by_more_than_20_degrees():
    """A body that spins is not followed by chords across its turns, however noisy it is."""
    angle = np.repeat(3.0 * 0.02 * np.arange(POSES)[:, None], len(SIGMAS), axis=1)
    found = lags(smooth(), angle, (2e-2, 1e-6))
    assert np.all(found > 1)
    assert np.all(3.0 * 0.02 * found <= np.radians(20))


def test_a_group_that_hardly_moves_does_not_count(rng):
    """A ball joint seen from its centre: no chord makes its position stand out of the noise."""
    angle = smooth(0.4)[0]
    noise = 1e-3 * white(rng)
    assert np.all(lags(noise, angle, (1e-3, 1e-6)) == 1)
    assert np.all(lags(smooth(0.05) + noise, angle, (1e-3, 1e-6)) > 1)

"""Averages over neighbours: what they leave as it is, how far they reach, and what they leave of noise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from reframe_jax.geometry import rotations
from reframe_jax.motion.smoothing import noise_share, smooth_poses, smoothing_width

POSES = 241
TIMES = np.linspace(0, 2, POSES)
WIDTHS = np.array([0, 3, 12], np.int32)

smooth, choose = jax.jit(smooth_poses), jax.jit(smoothing_width)


def windows(position, rotvec, count=3):
    """The same window several times: rotations (3, 3, K+1, N), positions (3, K+1, N) and times (K+1, N)."""
    rotation = np.moveaxis(np.asarray(jax.vmap(rotations.rotation_exp)(jnp.asarray(rotvec))), 0, -1)
    times = np.repeat(TIMES[:, None], count, axis=1)
    return np.repeat(rotation[..., None], count, axis=-1), np.repeat(position.T[..., None], count, -1), times


@pytest.fixture(scope="module")
def motion():
    """A parabola, while the body turns evenly about one axis."""
    position = np.stack([0.1 * TIMES**2, 0.3 - 0.2 * TIMES, 0 * TIMES], axis=1)
    return windows(position, TIMES[:, None] * np.array([0.2, -0.1, 0.3]))


def test_parabolas_pass_and_rotations_stay_rotations(motion):
    """Away from the ends, where the width shrinks."""
    rotation, position, times = motion
    found = smooth(rotation, position, times, np.full(3, POSES, np.int32), WIDTHS)
    inner = slice(36, POSES - 36)
    np.testing.assert_allclose(found[1][:, inner], position[:, inner], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found[0][:, :, inner], rotation[:, :, inner], rtol=0, atol=1e-7)
    product = np.einsum("ijkn,ilkn->jlkn", found[0], found[0])
    np.testing.assert_allclose(product, np.eye(3)[:, :, None, None] + 0 * product, atol=1e-12)


def test_no_width_leaves_the_poses_untouched(motion, rng):
    rotation, position, times = motion
    position = position + 1e-3 * rng.normal(size=position.shape)
    found = smooth(rotation, position, times, np.full(3, POSES, np.int32), WIDTHS)
    np.testing.assert_array_equal(found[0][..., 0], rotation[..., 0])
    np.testing.assert_array_equal(found[1][..., 0], position[..., 0])


def test_the_share_of_noise_is_what_is_left(motion, rng):
    """Of white noise in position, away from the ends; orientation loses as much."""
    rotation, position, times = motion
    noise = rng.normal(size=position.shape)
    found = smooth(rotation, position + noise, times, np.full(3, POSES, np.int32), WIDTHS)
    left = np.std(np.asarray(found[1] - position)[:, 30:-30], axis=(0, 1))
    np.testing.assert_allclose(left, noise_share(jnp.asarray(WIDTHS), jnp.float64), rtol=0.15)


def test_averages_do_not_cross_gaps_or_ends(motion):
    """A jump in position at a gap in time stays a jump, and padding takes no part."""
    rotation, position, times = motion
    times, position = np.array(times), np.array(position)
    times[100:] += 1.0
    position[:, 100:] += 5.0
    position[:, 200:] = 1e3  # padding
    found = np.asarray(smooth(rotation, position, times, np.full(3, 200, np.int32), WIDTHS)[1])
    assert np.max(np.abs(found[:, :200] - position[:, :200])) < 1e-2


def test_width_grows_with_the_noise_and_with_the_lag():
    position = np.stack([0.1 * np.sin(2 * TIMES), 0 * TIMES, 0 * TIMES], axis=1)
    rotation, position, _ = windows(position, np.stack([0 * TIMES, 0 * TIMES, 0.5 * np.sin(2 * TIMES)], 1), 4)
    counted = np.ones((POSES, 4), bool)
    lag = np.array([1, 40, 40, 12], np.int32)
    noise = np.array([1e-3, 1e-6, 1e-3, 1e-3])
    width = np.asarray(choose(rotation, position, counted, (noise, 5 * noise), lag))
    assert width.tolist()[:2] == [0, 0]  # of consecutive poses, and of an encoder's noise
    assert width[2] == 6  # a third of the lag
    assert width[3] == 2
    # rotation that is far more precise than position keeps its detail
    width = choose(rotation, position, counted, (noise, 1e-7 * np.ones(4)), lag)
    assert np.asarray(width).tolist() == [0, 0, 0, 0]

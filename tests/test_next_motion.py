"""The motion to make next is the one after which the covariance is smallest, and error bars can be drawn."""

import jax
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.plotting import plot_uncertainty
from reframe_jax.simulation.motions import PoseErrors, random_motion

SAMPLES, DT = 50, 0.1


@pytest.fixture(scope="module")
def tip():
    """A pin on a plane: poses and what was found, a batch of one window."""
    errors = PoseErrors(sigma=2e-4)
    key = jax.random.key(5)
    made = random_motion("K", key, samples=SAMPLES, dt=DT, excitation="exciting", errors=errors)
    poses = np.asarray(made.poses)[None]
    return poses, rf.identify(poses, dt=DT)


def test_motions_are_ranked(tip):
    poses, found = tip
    times = DT * np.arange(SAMPLES + 1)
    advice = rf.next_motion(found[0], poses[0], times=times, duration=1.0)
    free = np.flatnonzero(np.concatenate([found.angular.dof[0], found.linear.dof[0]]))
    assert len(advice.axes) == len(free) * (len(free) + 1) // 2
    assert np.all(np.diff(advice.shrinks) >= 0)
    assert np.all((advice.shrinks > 0.5) & (advice.shrinks <= 1))
    constrained = np.setdiff1d(np.arange(6), free)
    assert not advice.axes[:, constrained].any()
    assert str(advice).splitlines()[0].endswith(f"times {advice.shrinks[0]:.2f}")
    with pytest.raises(ValueError, match="index one window"):
        rf.next_motion(found, poses, times=times)


def test_error_bars_are_those_of_the_covariance(tip):
    poses, found = tip
    sure = rf.covariance(found, poses, dt=DT)[0]
    figure = plot_uncertainty(poses[0], found[0], sure)
    bars = figure.axes[-1].containers
    widths = 1.96 * np.sqrt(np.concatenate([np.diag(sure.angular_rms), np.diag(sure.linear_rms)]))
    rms = np.concatenate([found[0].angular.rms, found[0].linear.rms])
    for bar, width, middle in zip(bars, widths, rms, strict=True):
        (segment,) = bar[2][0].get_segments()
        np.testing.assert_allclose(segment[1, 1], middle + width, rtol=1e-6)

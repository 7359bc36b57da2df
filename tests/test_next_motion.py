"""The motion to make next is the one after which the covariance is smallest."""

import jax
import numpy as np
import pytest
from contacts import simulate_contact

import reframe_jax as rf

TIMES = 0.1 * np.arange(17)  # as in docs/tutorial.md, so that the program is the same


@pytest.fixture(scope="module")
def tip():
    """A pin on a plane: poses and what was found."""
    poses = simulate_contact("K", 1, sigma=2e-4).poses[: len(TIMES)]
    return poses, rf.identify(poses, times=TIMES)


def test_motions_are_ranked(tip):
    poses, found = tip
    advice = rf.next_motion(found, poses, times=TIMES)
    free = np.flatnonzero(np.concatenate([found.angular.dof, found.linear.dof]))
    assert len(advice.axes) == len(free) * (len(free) + 1) // 2
    assert np.all(np.diff(advice.shrinks) >= 0)
    assert np.all((advice.shrinks > 0.3) & (advice.shrinks <= 1 + 1e-9))
    assert advice.shrinks[0] < 0.97
    constrained = np.setdiff1d(np.arange(6), free)
    assert not advice.axes[:, constrained].any()
    assert str(advice).splitlines()[0].endswith(f"times {advice.shrinks[0]:.2f}")


def test_batches_are_refused(tip):
    poses, found = tip
    many = jax.tree.map(lambda leaf: np.stack([leaf] * 2), found)
    with pytest.raises(ValueError, match="index one window"):
        rf.next_motion(many, np.stack([poses] * 2), times=TIMES)

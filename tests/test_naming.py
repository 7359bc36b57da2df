"""The probability of a name: the same in a batch as for one window, and said where it is low."""

import numpy as np
import pytest
from contacts import DT, simulate_contact

import reframe_jax as rf
from reframe_jax.identification.cautions import Caution


@pytest.fixture(scope="module")
def windows():
    """Poses (40, 64, 4, 4) of four constraints, with 3 cm of noise: not much less than the motion."""
    return np.stack([simulate_contact(kind, seed, sigma=3e-2).poses for kind in "ABCK" for seed in range(10)])


def test_names_less_probable_than_all_others_are_said_to_be(windows):
    found = rf.identify(windows, dt=DT)
    probability = found.probability
    said = np.asarray(found.warnings) & Caution.IMPROBABLE > 0
    np.testing.assert_array_equal(said, probability < 0.5)
    assert np.any(said)
    assert not np.all(said)
    one = found[int(np.flatnonzero(said)[0])]
    expected = f"The name is uncertain (probability {one.probability:.2f})"
    assert any(sentence.startswith(expected) for sentence in one.warnings)


def test_thresholds_name_whatever_is_probable(windows):
    found = rf.identify(windows[::5], dt=DT, thresholds=rf.Thresholds())
    assert np.all(np.isnan(found.probability))
    assert not np.any(np.asarray(found.warnings) & Caution.IMPROBABLE)

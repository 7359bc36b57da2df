"""The probability of a name: the same in a batch as for one window, and said where it is low."""

import jax
import numpy as np
import pytest

import reframe_jax as rf
from benchmarks.motions import random_motion
from reframe_jax.identification.cautions import Caution
from reframe_jax.simulation.motions import PoseErrors


@pytest.fixture(scope="module")
def windows():
    """Poses (40, 51, 4, 4) of hand-like motions of five constraints with 3 mm of noise."""
    errors = PoseErrors(sigma=3e-3)
    keys = jax.random.split(jax.random.key(8), 8)

    def batch(label):
        def make(key):
            return random_motion(label, key, samples=50, dt=0.1, errors=errors).poses

        return np.asarray(jax.jit(jax.vmap(make))(keys))

    return np.concatenate([batch(label) for label in "ABCGL"])


def test_names_less_probable_than_all_others_are_said_to_be(windows):
    found = rf.identify(windows, dt=0.1)
    probability = found.probability
    said = np.asarray(found.warnings) & Caution.IMPROBABLE > 0
    np.testing.assert_array_equal(said, probability < 0.5)
    assert np.any(said)
    assert not np.all(said)
    one = found[int(np.flatnonzero(said)[0])]
    expected = f"The name is uncertain (probability {one.probability:.2f})"
    assert any(sentence.startswith(expected) for sentence in one.warnings)


def test_thresholds_name_whatever_is_probable(windows):
    found = rf.identify(windows, dt=0.1, thresholds=rf.Thresholds())
    assert np.all(np.isnan(found.probability))
    assert not np.any(np.asarray(found.warnings) & Caution.IMPROBABLE)

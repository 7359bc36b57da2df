"""Recordings of any length, padded or not, alone or in a batch, with pauses or without."""

import jax
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.identification import entry
from reframe_jax.simulation import synthetic

DT = 0.02


@pytest.fixture(scope="module")
def recording():
    """400 poses of a pin on a plane."""
    made = synthetic.simulate("K", jax.random.key(4), noise=1e-4, dt=DT, duration=7.98)
    return np.asarray(made.poses)


def same(a, b, **tolerance):
    """All numbers but what a direction that is free leaves open, which is the same for both."""
    for path, x in jax.tree.leaves_with_path(a):
        y = dict(jax.tree.leaves_with_path(b))[path]
        name = jax.tree_util.keystr(path)
        if "agreement" in name or name.startswith(".candidates"):
            continue
        np.testing.assert_allclose(np.asarray(x), np.asarray(y), err_msg=name, **tolerance)


@pytest.mark.parametrize("poses", [51, 300])
@pytest.mark.parametrize("lag", ["auto", 7, 1])
def test_alone_padded_and_in_a_batch(recording, monkeypatch, poses, lag):
    window = recording[:poses]
    batch = rf.identify(np.stack([window, window[::-1]]), dt=DT, lag=lag)[0]
    monkeypatch.setattr(entry, "_SHORT", 0)
    assert entry._padded_size(poses) > poses
    padded = rf.identify(window, dt=DT, lag=lag)
    monkeypatch.setattr(entry, "_SHORT", 1000)
    alone = rf.identify(window, dt=DT, lag=lag)
    assert padded.counted.shape == alone.counted.shape == (poses,)
    same(padded, alone, rtol=1e-6, atol=1e-6)
    same(padded, batch, rtol=1e-6, atol=1e-6)


def test_sizes_are_few_and_fit():
    sizes = {count: entry._padded_size(count) for count in range(5, 5000)}
    assert all(count <= size < 1.51 * count for count, size in sizes.items())
    assert all(sizes[count] == count for count in range(5, 65))
    assert len({size for count, size in sizes.items() if count > 64}) == 13


def test_the_search_is_compiled_once_for_all_lengths(recording):
    """And what reduces poses to evidence once for every size they are padded to."""
    rf.identify(recording[:51], dt=DT)
    solved, reduced = entry._solve._cache_size(), entry._reduce._cache_size()
    lengths = [60, 90, 97, 120, 128, 130, 170, 192, 200, 250]
    for count in lengths:
        assert rf.identify(recording[:count], dt=DT).name == "Pin-plane contact"
    assert entry._solve._cache_size() == solved
    sizes = {entry._padded_size(count) for count in lengths}
    assert sizes == {60, 96, 128, 192, 256}
    assert entry._reduce._cache_size() - reduced <= len(sizes)


def test_pauses_change_nothing(recording):
    """A body that rests at both ends and in the middle, and whose rest is as noisy as its motion."""
    rng = np.random.default_rng(3)
    moving = np.asarray(synthetic.simulate("K", jax.random.key(4), dt=DT, duration=3.98).poses)
    rests = np.concatenate(
        [np.zeros(40), np.arange(100), np.full(40, 100), np.arange(100, 200), np.full(40, 199)]
    )
    noisy = [
        np.asarray(synthetic.add_pose_noise(poses, jax.random.key(int(rng.integers(99))), 1e-4))
        for poses in (moving, moving[rests.astype(int)])
    ]
    through, paused = (rf.identify(poses, dt=DT) for poses in noisy)
    assert paused.name == through.name == "Pin-plane contact"
    np.testing.assert_array_equal(paused.angular.dof, through.angular.dof)
    np.testing.assert_array_equal(paused.linear.dof, through.linear.dof)
    np.testing.assert_allclose(paused.linear.position, through.linear.position, atol=5e-4)
    # rest is left out of velocities, so that their size is that of the motion
    np.testing.assert_allclose(paused.linear.rms[1:], through.linear.rms[1:], rtol=0.15)
    everything = rf.identify(noisy[1], dt=DT, lag=1)
    assert np.all(everything.linear.rms[1:] < 0.9 * through.linear.rms[1:])

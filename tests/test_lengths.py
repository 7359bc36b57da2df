"""Recordings of any length, padded or not, alone or in a batch, with pauses or without."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.compilation import PROGRAMS
from reframe_jax.identification import inputs, pipeline
from reframe_jax.simulation import synthetic

DT = 0.02


@pytest.fixture(scope="module")
def recording():
    """400 poses of a pin on a plane."""
    made = synthetic.simulate("K", jax.random.key(4), noise=1e-4, dt=DT, duration=7.98)
    return np.asarray(made.poses)


def test_a_search_ends_at_the_same_place_padded(recording, monkeypatch):
    """By a program for its length, and by one for four times as many poses, with more scales."""
    window, found = recording[:64], []
    for shortest in (64, 256):
        monkeypatch.setattr(inputs, "_SHORT", shortest)
        assert inputs.padded_size(64, single=True) == shortest
        found.append(rf.identify(window, dt=DT))
        assert found[-1].counted.shape == (64,)
    single, padded = found
    assert single.name == padded.name == "Pin-plane contact"
    for x, y in zip(*((each.angular, each.linear) for each in found), strict=True):
        np.testing.assert_array_equal(x.dof, y.dof)
        np.testing.assert_allclose(x.rms, y.rms, rtol=1e-2)
    np.testing.assert_allclose(padded.linear.position, single.linear.position, atol=1e-4)
    np.testing.assert_allclose(padded.noise.position, single.noise.position, rtol=1e-2)
    np.testing.assert_array_equal(padded.counted, single.counted)


def test_sizes_are_few_and_fit():
    sizes = {count: inputs.padded_size(count, single=True) for count in range(5, 70_000)}
    assert all(count <= size <= max(64, 4 * count) for count, size in sizes.items())
    assert all(size < 2 * count for count, size in sizes.items() if count > 4096)
    assert sorted({size for count, size in sizes.items() if count < 10_000}) == [
        64, 256, 1024, 4096, 8192, 16384
    ]  # fmt: skip
    of_batches = {count: inputs.padded_size(count, single=False) for count in range(5, 5_000)}
    assert all(count <= size < 2 * count for count, size in of_batches.items() if count > 16)
    assert set(of_batches.values()) == {2**k for k in range(5, 14)}


def programs():
    return sum(program is pipeline.prepare for program, *_ in PROGRAMS)


def test_one_program_serves_all_lengths_that_are_padded_to_a_size(recording):
    before = programs()
    lengths = [40, 60, 90, 97, 120, 128, 130, 170, 192, 200, 250]
    for count in lengths:
        assert rf.identify(recording[:count], dt=DT).name == "Pin-plane contact"
    assert {inputs.padded_size(count, single=True) for count in lengths} == {64, 256}
    assert programs() - before <= 2


def test_the_same_program_fits_an_assumed_constraint(recording):
    rf.identify(recording[:50], dt=DT)
    before = programs()
    for name, entry_name in (("ball", "Spherical joint"), ("hinge", "Revolute joint"), ("fixed", "Fixed")):
        assert rf.identify(recording[:50], dt=DT, assume=name).name == entry_name
    assert programs() == before


@pytest.mark.parametrize(("label", "counts"), [("A", (6, 7, 8)), ("K", (7, 8, 9, 10))])
def test_few_poses_with_long_steps_are_not_taken_for_noise(label, counts):
    """Poses 0.6 s apart show no smooth motion, but a hinge or a pin on a plane has axes that hardly move."""
    keys = [jax.random.key(seed) for seed in range(16)]
    made = [synthetic.simulate(label, key, noise=1e-5, dt=0.6, duration=6.0).poses for key in keys]
    for count in counts:
        found = rf.identify(np.stack(made)[:, :count], dt=0.6)
        names = [each.name for each in found]
        assert len(names) == 16
        assert names.count({"A": "Revolute joint", "K": "Pin-plane contact"}[label]) >= 12


def test_a_single_window_is_not_a_batch(recording):
    with pytest.raises(TypeError, match="single window"):
        list(rf.identify(recording[:50], dt=DT))


def test_what_is_wrong_with_a_solver_is_said(recording):
    class Fails:
        def minimise(self, objective, box, key):
            raise ArithmeticError("no minimum")

    for poses in (recording[:51], np.stack([recording[:51]] * 2)):
        with pytest.raises(ArithmeticError, match="no minimum"):
            rf.identify(poses, dt=DT, solver=Fails())


def test_pauses_change_nothing(recording):
    """A body that rests at both ends and in the middle, and whose rest is as noisy as its motion."""
    poses = recording[:200]
    exact = np.asarray(synthetic.simulate("K", jax.random.key(4), dt=DT, duration=7.98).poses)
    keys = jax.random.split(jax.random.key(1), 3)
    first, middle, last = (
        np.asarray(synthetic.add_pose_noise(jnp.asarray(np.repeat(exact[k, None], 18, axis=0)), key, 1e-4))
        for k, key in zip((0, 100, 199), keys, strict=True)
    )
    with_rest = np.concatenate([first, poses[:100], middle, poses[100:], last])
    through, paused = (rf.identify(each, dt=DT) for each in (poses, with_rest))
    assert paused.name == through.name == "Pin-plane contact"
    np.testing.assert_array_equal(paused.angular.dof, through.angular.dof)
    np.testing.assert_array_equal(paused.linear.dof, through.linear.dof)
    for found in (through, paused):  # on either side of the truth, by what the noise allows
        np.testing.assert_allclose(found.linear.position, [0.1, 0.3, 0.1], atol=2e-3)

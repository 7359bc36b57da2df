"""Recordings of any length, padded or not, alone or in a batch, with pauses or without."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.identification import entry, inputs
from reframe_jax.simulation import synthetic
from reframe_jax.solvers import Solution

DT = 0.02


@pytest.fixture(scope="module")
def recording():
    """400 poses of a pin on a plane."""
    made = synthetic.simulate("K", jax.random.key(4), noise=1e-4, dt=DT, duration=7.98)
    return np.asarray(made.poses)


class Middle:
    """The middle of the box, without a search, which would take long to compile."""

    def minimise(self, objective, box, key):
        x = jnp.zeros((3, *objective.moments.shape[2:]))
        value = objective.value(x)
        return Solution(x, value, jnp.ones_like(value))


MIDDLE = Middle()


@pytest.mark.parametrize(("poses", "scales"), [(51, "auto"), (300, 1)])
def test_alone_padded_and_in_a_batch(recording, monkeypatch, poses, scales):
    """All that is made of the poses before and after the search."""
    window, options = recording[:poses], {"dt": DT, "scales": scales, "solver": MIDDLE}
    batch = rf.identify(np.stack([window, window[::-1]]), **options)[0]
    single, padded = single_and_padded(window, monkeypatch, options)
    for other in (padded, batch):
        for (path, x), y in zip(jax.tree.leaves_with_path(single), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(y, x, rtol=1e-6, atol=1e-6, err_msg=jax.tree_util.keystr(path))


def test_a_search_ends_at_the_same_place_padded(recording, monkeypatch):
    single, padded = single_and_padded(recording[:300], monkeypatch, {"dt": DT})
    assert single.name == padded.name == "Pin-plane contact"
    np.testing.assert_allclose(padded.linear.position, single.linear.position, atol=1e-4)
    np.testing.assert_allclose(padded.linear.rms, single.linear.rms, rtol=1e-2)


def single_and_padded(window, monkeypatch, options):
    """Identified by a program for its length, and by one for more poses."""
    found = []
    for fewest in (1000, 0):
        monkeypatch.setattr(inputs, "_FEWEST", fewest)
        assert (inputs.padded_size(len(window)) > len(window)) == (fewest == 0)
        found.append(rf.identify(window, **options))
    assert all(each.counted.shape == (len(window),) for each in found)
    return found


def test_sizes_are_few_and_fit():
    sizes = {count: inputs.padded_size(count) for count in range(5, 70_000)}
    assert all(count <= size <= max(64, 4 * count) for count, size in sizes.items())
    assert all(size < 2 * count for count, size in sizes.items() if count > 4096)
    assert sorted({size for count, size in sizes.items() if 8 <= count < 10_000}) == [
        64, 256, 1024, 4096, 8192, 16384
    ]  # fmt: skip


def test_one_program_serves_all_lengths_that_are_padded_to_a_size(recording):
    def programs():
        return entry._program.jitted._cache_size() + len(entry._program._kept)

    before = programs()
    lengths = [40, 60, 90, 97, 120, 128, 130, 170, 192, 200, 250]
    for count in lengths:
        assert rf.identify(recording[:count], dt=DT).name == "Pin-plane contact"
    assert {inputs.padded_size(count) for count in lengths} == {64, 256}
    assert programs() - before <= 2


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
        np.asarray(synthetic.add_pose_noise(jnp.asarray(np.repeat(exact[k, None], 40, axis=0)), key, 1e-4))
        for k, key in zip((0, 100, 199), keys, strict=True)
    )
    with_rest = np.concatenate([first, poses[:100], middle, poses[100:], last])
    through, paused = (rf.identify(each, dt=DT) for each in (poses, with_rest))
    assert paused.name == through.name == "Pin-plane contact"
    np.testing.assert_array_equal(paused.angular.dof, through.angular.dof)
    np.testing.assert_array_equal(paused.linear.dof, through.linear.dof)
    for found in (through, paused):  # on either side of the truth, by what the noise allows
        np.testing.assert_allclose(found.linear.position, [0.1, 0.3, 0.1], atol=2e-3)

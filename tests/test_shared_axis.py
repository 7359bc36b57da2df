"""An axis that both groups measure: better than either, and with the derivative of a weighted mean."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from reframe_jax.constraints import ConstraintFrame, LinearType
from reframe_jax.identification.evidence import reduce_windows
from reframe_jax.identification.optima import Frames
from reframe_jax.identification.shared_axis import share_axis
from reframe_jax.objectives.moments import covariance_at
from reframe_jax.objectives.norms import principal_axes
from reframe_jax.simulation import synthetic

WINDOWS, NOISE = 24, 1e-3
DOF = {"C": (0, 0, 1), "D": (0, 1, 1), "I": (0, 0, 1)}


@pytest.fixture(scope="module")
def reduced():
    """Evidence of windows of a constraint, and their poses without noise: one program for all."""

    @partial(jax.jit, static_argnums=0)
    def make(label, keys):
        frame = replace(ConstraintFrame.named(label), position=jnp.asarray(ORIGIN))

        def one(key):
            return synthetic.simulate(frame, key, noise=0.0, dt=0.05, duration=4.0).poses

        poses = jax.vmap(one)(keys)
        noisy = jax.vmap(partial(synthetic.add_pose_noise, sigma=NOISE, rotation_ratio=5.0))(poses, keys)
        return poses, noisy

    program = jax.jit(lambda poses: reduce_windows(poses, jnp.full(80, 0.05), None, None, "auto", "chord"))

    def of(label):
        poses, noisy = make(label, jax.random.split(jax.random.key(5), WINDOWS))
        return program(poses), program(noisy)

    return of


ORIGIN = np.array([0.15, -0.1, 0.2])  # in the body, m


def frames_of(evidence):
    """Frames at the true origin, which is fixed in the body, with the axes along which its path spreads."""
    position = jnp.broadcast_to(jnp.asarray(ORIGIN), (WINDOWS, 4, 3))
    x, y, z = jnp.moveaxis(position, -1, 0)
    _, axes = principal_axes(covariance_at(evidence.linear_spread, (x, y, z)))
    return Frames(jnp.zeros((WINDOWS, 2, 3, 3)), position, axes, axes)


@jax.jit
def shared(evidence, angular, linear):
    number = (jnp.broadcast_to(angular, (WINDOWS, 2, 3)), jnp.broadcast_to(linear, (WINDOWS, 4, 3)))
    winner = jnp.full(WINDOWS, int(LinearType.GB), jnp.int32)
    return share_axis(evidence, frames_of(evidence), number, winner, jnp.ones(WINDOWS, bool)).axes


def tilt(axis, truth):
    """RMS angle between two axes (N, 3), rad."""
    return np.sqrt(np.mean(np.sum(np.cross(axis, truth) ** 2, axis=-1)))


@pytest.mark.parametrize("label", ["C", "D"])
def test_the_axis_is_better_than_that_of_either_group(reduced, label):
    """In the ground: the free axis of a cylinder joint, and the normal of a plane."""
    exact, noisy = reduced(label)
    dof = jnp.asarray(DOF[label])
    column = 2 if label == "C" else 0
    truth = np.asarray(exact.axis.in_ground).T
    alone = np.asarray(frames_of(noisy).axes)[:, 1, :, column]
    both = np.asarray(shared(noisy, jnp.asarray([0, 0, 1]), dof))[:, 1, :, column]
    angular = np.asarray(noisy.axis.in_ground).T
    assert np.all(np.asarray(noisy.axis.found))
    assert tilt(both, truth) <= 1.02 * min(tilt(alone, truth), tilt(angular, truth))


def test_frames_stay_right_handed_and_orthogonal(reduced):
    _, noisy = reduced("D")
    axes = np.asarray(shared(noisy, jnp.asarray([0, 0, 1]), jnp.asarray(DOF["D"])))
    product = np.einsum("ntij,ntik->ntjk", axes, axes)
    np.testing.assert_allclose(product, np.eye(3) + 0 * product, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(axes), 1, atol=1e-12)


def test_a_free_translation_is_perpendicular_to_the_axis(reduced):
    """Of a pin on a plane, which turns about an axis of the plane: the rest of its frame stays."""
    _, noisy = reduced("I")
    before = np.asarray(frames_of(noisy).axes)[:, 1]
    after = np.asarray(shared(noisy, jnp.asarray([0, 0, 1]), jnp.asarray(DOF["I"])))[:, 1]
    axis = np.asarray(noisy.axis.in_ground).T
    assert np.max(np.abs(np.sum(before[..., 2] * axis, axis=-1))) > 1e-5
    np.testing.assert_allclose(np.sum(after[..., 2] * axis, axis=-1), 0, atol=1e-12)
    across = np.cross(axis, before[..., 2])
    np.testing.assert_allclose(np.sum(after[..., 2] * across, axis=-1), 0, atol=1e-9)


def test_frames_stay_where_two_axes_are_free_to_turn(reduced):
    _, noisy = reduced("D")
    axes = np.asarray(shared(noisy, jnp.asarray([0, 1, 1]), jnp.asarray(DOF["D"])))
    np.testing.assert_allclose(axes[:, 1], np.asarray(frames_of(noisy).axes)[:, 1], atol=1e-9)


def test_derivative_with_the_noise_given(reduced, rng):
    _, noisy = reduced("D")
    change = jnp.asarray(1e-6 * rng.normal(size=noisy.linear_spread.shape)) * noisy.linear_spread
    turn = jnp.asarray(1e-3 * rng.normal(size=(3, WINDOWS)))

    @jax.jit
    def moved(step):
        axis = noisy.axis.in_ground + step * turn
        axis = axis / jnp.sqrt(jnp.sum(axis**2, axis=0, keepdims=True))
        there = replace(
            noisy,
            linear_spread=noisy.linear_spread + step * change,
            axis=noisy.axis._replace(in_ground=axis),
        )
        return shared(there, jnp.asarray([0, 0, 1]), jnp.asarray(DOF["D"]))

    slope = jax.jvp(moved, (jnp.zeros(()),), (jnp.ones(()),))[1]
    finite = (moved(jnp.asarray(1e-3)) - moved(jnp.asarray(-1e-3))) / 2e-3
    np.testing.assert_allclose(slope, finite, atol=1e-5 * float(jnp.max(jnp.abs(finite))))


def test_noise_is_removed_with_automatic_chords_only():
    """Where it is not, it still acts at the end of the lever, and the evidence says so."""
    keys = jax.random.split(jax.random.key(7), 2)
    poses = jax.vmap(lambda key: synthetic.simulate("A", key, noise=NOISE, dt=0.05, duration=4.0).poses)(keys)

    @partial(jax.jit, static_argnames="rule")
    def reduce(poses, lag, rule):
        return reduce_windows(poses, jnp.full(80, 0.05), None, lag, rule, "chord")

    automatic = reduce(poses, None, rule="auto")
    given = reduce(poses, automatic.lag, rule="given")
    assert np.all(np.asarray(automatic.lag) > 1)
    assert np.all(np.asarray(automatic.axis.found) & np.asarray(given.axis.found))
    assert np.all(np.asarray(automatic.alone))
    assert not np.any(np.asarray(given.alone))

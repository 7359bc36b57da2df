"""Twins: two origins that a window cannot tell apart, and everything that only looks like it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.geometry.transforms import make_pose
from reframe_jax.identification.entry import default_solver
from reframe_jax.identification.floored_moments import window_moments
from reframe_jax.identification.twins import find_twins
from reframe_jax.objectives.velocity import PositionObjective
from reframe_jax.simulation import synthetic
from reframe_jax.solvers import Box, Solution, ValleySteps

TIPS = np.array([[0.3, 0.1, -0.1], [-0.2, 0.15, 0.2]])  # of a stick, one on either wall of a corner
CUBE = Box(-jnp.ones(3), jnp.ones(3))


@functools.cache
def corner(noise=1e-4, count=32, wobble=0.0):
    """A stick in a corner, (count, 51, 4, 4): its first tip keeps its x, its second tip its y.

    But for the second wall, which moves by ``wobble`` m from sample to sample.
    """

    def one(key):
        phase_key, noise_key = jax.random.split(key)
        velocity = synthetic.exciting(phase_key)
        angles, lengths = jax.vmap(velocity)(0.1 * jnp.arange(51.0))
        turns = rotation_exp(0.4 * angles)
        first, second = (jnp.einsum("kij,j->ki", turns, jnp.asarray(tip)) for tip in TIPS)
        shaking = wobble * jax.random.normal(phase_key, (51,), dtype=float)
        position = jnp.stack([-first[:, 0], shaking - second[:, 1], lengths[:, 2]], axis=-1)
        poses = make_pose(turns, position)
        return synthetic.add_pose_noise(poses, noise_key, noise)

    return jax.vmap(one)(jax.random.split(jax.random.key(5), count))


@functools.cache
def papers_h(count=16):
    """The paper's motion of H, whose velocities have a second point of the ground 0.2 m away."""
    frame = rf.ConstraintFrame.named("H")
    keys = jax.random.split(jax.random.key(7), count)
    simulate = functools.partial(synthetic.simulate, excitation="paper", exact=False)
    return jax.vmap(lambda key: simulate(frame, key, noise=1e-5).poses)(keys), frame


def test_both_tips_of_a_stick_in_a_corner_are_found():
    found = jax.device_get(rf.identify(corner(), dt=0.1))
    some = found.linear.has_twin
    assert np.mean(some) > 0.3
    assert np.all(found.linear.type_code[some] == rf.LinearType.GB)
    both = np.stack([found.linear.position, found.linear.twin], axis=1)[some]
    order = np.argsort(-both[:, :, 0], axis=1)
    np.testing.assert_allclose(
        np.take_along_axis(both, order[..., None], axis=1),
        np.broadcast_to(TIPS, both.shape),
        atol=5e-3,
    )
    np.testing.assert_array_equal(found.linear.twin[~some], found.linear.position[~some])


def test_twins_have_a_probability():
    poses = corner()
    found = jax.device_get(rf.identify(poses, dt=0.1))
    sure = rf.covariance(found, poses, dt=0.1)
    some = np.asarray(found.linear.has_twin)
    probability = np.asarray(sure.twin_probability)
    assert np.all(probability[~some] == 0)
    # both tips are as right: which of them fits better is chance
    assert np.all((probability[some] > 0) & (probability[some] < 1))
    assert 0.2 < np.mean(probability[some]) < 0.7
    first = int(np.flatnonzero(some)[0])
    text = found[first].explain(sure[first])
    assert f"is right with probability {probability[first]:.2f}" in text


def test_the_second_point_of_the_papers_h_is_found_in_the_ground():
    poses, frame = papers_h()
    far = jnp.eye(4).at[:3, 3].set(jnp.asarray([5.0, -3.0, 2.0]))
    found = jax.device_get(rf.identify(far[None, None] @ poses, dt=0.1, discretization="left"))
    assert np.mean(found.linear.has_twin) > 0.7
    assert set(found.linear.type_code) == {rf.LinearType.GG}
    some = found.linear.has_twin
    both = np.stack([found.linear.position, found.linear.twin])[:, some] - np.asarray(far[:3, 3])
    truth = np.asarray(frame.position)
    np.testing.assert_allclose(both[..., :2] - truth[:2], 0, atol=1e-3)
    np.testing.assert_allclose(np.abs(both[1] - both[0])[:, 2], 0.2, atol=1e-3)


def test_exciting_motion_of_the_twelve_constraints_has_no_twins():
    noises = jnp.logspace(-6, -3, 8)
    keys = jax.random.split(jax.random.key(3), 8)
    for label in rf.CONSTRAINTS:
        frame = rf.ConstraintFrame.named(label)
        simulate = jax.vmap(lambda key, noise, f=frame: synthetic.simulate(f, key, noise=noise).poses)
        found = rf.identify(simulate(keys, noises), dt=0.1)
        assert not np.any(found.linear.has_twin), label


def test_a_twin_is_an_optimum_of_the_same_depth():
    """Minimising from it leaves it where it is, and both are clearly below the point between them."""
    poses = corner()
    found = rf.identify(poses, dt=0.1)
    some = np.asarray(found.linear.has_twin)
    moments = jax.jit(window_moments)(poses, jnp.full(50, 0.1))[1][..., rf.LinearType.GB][:, :, some]
    objective = PositionObjective(moments)
    first, twin = (jnp.asarray(np.asarray(x)[some].T) for x in (found.linear.position, found.linear.twin))
    stayed, value = jax.jit(lambda x: ValleySteps(30)(objective, CUBE, x))(twin)
    np.testing.assert_allclose(stayed, twin, atol=1e-4)
    middle = objective.value((first + twin) / 2)
    assert np.all(middle - jnp.maximum(value, objective.value(first)) > 0.5)


@pytest.fixture(scope="module")
def objective():
    moments = jax.jit(window_moments)(corner(1e-5, 1), jnp.full(50, 0.1))[1]
    return PositionObjective(moments[..., rf.LinearType.GB])


class TestFindTwins:
    """By hand, on the window of a corner whose two tips are known."""

    def look(self, objective, *ends, box=CUBE, dof=(0, 1, 1)):
        ends = jnp.asarray(np.stack(ends, axis=1)[..., None])
        chains = PositionObjective(objective.moments[:, :, None])
        ends, values = ValleySteps(20)(chains, Box(-9 * jnp.ones(3), 9 * jnp.ones(3)), ends)
        solution = Solution(ends[:, 0], values[0], jnp.ones(1), ends, values)
        return find_twins(objective, box, solution, jnp.asarray([dof]), jnp.zeros(1), jnp.full(1, 50.0))

    def test_the_other_tip(self, objective):
        twin, is_twin = self.look(objective, *TIPS)
        assert is_twin[0]
        np.testing.assert_allclose(twin[0], TIPS[1], atol=1e-3)

    def test_the_optimum_met_again_is_none(self, objective):
        assert not self.look(objective, TIPS[0], TIPS[0] + 1e-3)[1][0]

    def test_an_origin_outside_the_box_is_none(self, objective):
        low, high = jnp.full(3, -1.0), jnp.full(3, 1.0)
        assert not self.look(objective, *TIPS, box=Box(low.at[0].set(-0.1), high))[1][0]

    def test_an_origin_that_moves_more_than_the_noise_is_none(self):
        """The second wall gives way by a hundred times the noise: data that tell the tips apart."""
        moments = jax.jit(window_moments)(corner(1e-5, 1, wobble=1e-3), jnp.full(50, 0.1))[1]
        objective = PositionObjective(moments[..., rf.LinearType.GB])
        assert not self.look(objective, *TIPS)[1][0]

    def test_a_winner_without_constraint_has_none(self, objective):
        assert not self.look(objective, *TIPS, dof=(1, 1, 1))[1][0]


def test_a_solver_that_does_not_say_where_its_chains_ended_has_no_twins():
    class Silent:
        def minimise(self, objective, box, key):
            found = default_solver().minimise(objective, box, key)
            return Solution(found.x, found.value, found.agreement)

    found = rf.identify(corner(), dt=0.1, solver=Silent())
    assert not np.any(found.linear.has_twin)
    np.testing.assert_array_equal(found.linear.twin, found.linear.position)

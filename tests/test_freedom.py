"""Degrees of freedom from distances made by hand, in units of the noise."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import reframe_jax as rf
from reframe_jax.geometry.transforms import make_pose
from reframe_jax.identification.classify import class_probabilities, likeliest_type
from reframe_jax.identification.distances import share_of_turn
from reframe_jax.identification.evidence import reduce_windows
from reframe_jax.identification.freedom import freedom_patterns
from reframe_jax.simulation import synthetic

SAMPLES = 51.0
WHITE = [1.05, 0.96, 1.1]
TRACKER = [4.0, 7.0, 9.0]  # slow errors of several noises
CLASSES = {
    "hinge": (1, 0),
    "drawer": (0, 1),
    "pin on plane": (3, 2),
    "cylinder": (1, 1),
    "ball": (3, 0),
    "free motion": (3, 3),
    "rest": (0, 0),
}


@jax.jit
def patterns(distance, gain, samples, share=1.0, of_turn=0.3):
    """Noise far below what people move, so that it hides nothing."""
    share, of_turn = jnp.full_like(samples, share), jnp.full_like(gain, of_turn)
    noise = jnp.full_like(distance, 1e-6)
    resting = distance[3:], noise[3:]
    return freedom_patterns(distance, noise, gain, of_turn, jnp.asarray(samples), share, resting)


def distances(free, held, far):
    """Six distances: the last axes of each frame are free, and went so far."""
    rotations, translations = free
    went = far * np.array([0.6, 1.0, 1.7])
    return np.concatenate([[*sorted(held)[: 3 - n], *went[3 - n :]] for n in (rotations, translations)])


@pytest.mark.parametrize(("held", "far"), [(WHITE, 60.0), (WHITE, 5e3), (TRACKER, 800.0)])
def test_classes_made_by_hand(held, far):
    """With white noise, and with a tracker whose slow errors are as large along every constrained axis."""
    distance = np.stack([distances(free, held, far) for free in CLASSES.values()], axis=1)
    found = np.asarray(patterns(distance, np.zeros((3, len(CLASSES))), np.full(len(CLASSES), SAMPLES)))
    np.testing.assert_allclose(np.sum(found, axis=(0, 1)), 1, rtol=1e-12)
    assert np.all(found >= 0)
    for i, (name, free) in enumerate(CLASSES.items()):
        if (name, held) == ("rest", TRACKER):
            continue  # six axes that drift alike: nothing to compare them with
        assert found[(*free, i)] == np.max(found[..., i]) > 0.8, name


def test_averaging_makes_no_freedom_of_slow_errors():
    """They stay while the noise shrinks to a fifth, and remain a few noises of single poses."""
    distance = distances((1, 0), TRACKER, 800.0) / 0.2
    found = np.asarray(patterns(distance, np.zeros(3), SAMPLES, 0.2))
    assert found[1, 0] == np.max(found) > 0.8
    # white noise, averaged as well, is found as before
    found = np.asarray(patterns(distances((3, 2), WHITE, 60.0), np.zeros(3), SAMPLES, 0.2))
    assert found[3, 2] == np.max(found) > 0.8


def test_what_an_error_of_scale_makes_at_the_end_of_a_lever_is_no_freedom():
    """A hinge with a long lever: a tenth of its rotation is measured as motion of its origin."""
    distance = np.array([*TRACKER[:2], 2e4, 5.0, 8.0, 400.0])
    none, lever = (np.asarray(patterns(distance, np.full(3, gain), SAMPLES)) for gain in (0.0, 4e3))
    assert none[1, 1] > 0.9
    assert lever[1, 0] > 20 * none[1, 0]


def test_motion_that_the_rotation_explains_is_no_freedom():
    """White noise, and one linear axis that went a tenth of the lever: the rest of it is noise, or is not."""
    distance = np.array([1.0, 1.1, 60.0, 1.0, 1.1, 6.0])
    gain, alone = np.full(3, 60.0), np.array([1.0, 1.1, 60.0, 1.0, 1.1, 60.0])
    explained, other = (
        np.asarray(patterns(distance, gain, SAMPLES, of_turn=share)) for share in (1 - 1 / 36, 0.3)
    )
    assert explained[1, 0] == np.max(explained) > 0.6
    assert other[1, 1] == np.max(other) > 0.6
    # further than a scale error goes: free, although proportional
    assert np.asarray(patterns(alone, gain, SAMPLES, of_turn=0.999))[1, 1] > 0.9


def test_a_hinge_whose_rotation_is_measured_short():
    """By 6 %, as trackers do that see a marker at a slant; the lever is 0.5 m."""
    rng, angle = np.random.default_rng(4), 0.5 - 0.5 * np.cos(np.linspace(0, np.pi, 151))
    exact = Rotation.from_rotvec(np.outer(0.94 * angle, [0.0, 0.0, 1.0]))
    measured = Rotation.from_rotvec(rng.normal(0, 5e-3, (151, 3))) * exact
    position = 0.5 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    poses = make_pose(measured.as_matrix(), position + rng.normal(0, 3e-4, (151, 3)))
    found = rf.identify(np.asarray(poses), dt=0.05)
    assert found.name == "Revolute joint"
    assert found.probability > 0.6
    assert abs(np.asarray(found.angular.axes)[2, 2]) > np.cos(np.radians(0.5))


def test_the_share_that_the_rotation_explains():
    """Against a sum over samples, with the lever that the rotation moves most."""
    poses = np.asarray(synthetic.simulate("L", jax.random.key(3), noise=1e-4).poses)
    evidence = jax.jit(reduce_windows, static_argnums=(4, 5))(
        poses[None], np.full(50, 0.1), None, None, "auto", "chord"
    )
    rng = np.random.default_rng(0)
    axes, position = Rotation.random(4, rng).as_matrix(), rng.normal(0, 0.3, (4, 3))
    shares = share_of_turn(evidence.linear_spread, jnp.asarray(position[None]), jnp.asarray(axes[None]))
    turned = poses[:, :3, :3]
    for kind, rotation, shift in (
        (rf.LinearType.GB, turned, poses[:, :3, 3]),
        (rf.LinearType.BG, turned.mT, -(turned.mT @ poses[:, :3, 3, None])[..., 0]),
    ):
        path = rotation @ (position[kind] + (kind == rf.LinearType.BG) * poses[:, :3, 3].mean(axis=0)) + shift
        for axis in range(3):
            along = path @ axes[kind][:, axis]
            ends = np.einsum("i,kij->kj", axes[kind][:, axis], rotation)
            lever = np.linalg.svd(ends - ends.mean(axis=0))[2][0]
            expected = np.corrcoef(along, ends @ lever)[0, 1] ** 2
            np.testing.assert_allclose(shares[0, kind, axis], expected, atol=0.02)


def test_the_further_an_axis_went_the_likelier_it_is_free():
    far = np.geomspace(1, 1e4, 25)
    distance = np.broadcast_to(np.array([1.0, 1.0, 0.0, 1.0, 1.0, 1.0])[:, None], (6, 25)).copy()
    distance[2] = far
    found = np.asarray(patterns(distance, np.zeros((3, 25)), np.full(25, SAMPLES)))
    free = np.sum(found[1:], axis=(0, 1))
    assert free[0] < 0.01
    assert free[-1] > 0.99
    assert np.all(np.diff(free[far > 3]) > -1e-9)


def test_types_are_compared_along_the_axes_that_the_winner_constrains():
    """A likelihood ratio, which no number of samples makes larger than a few."""
    patterns = np.full((4, 4, 4, 4), 1 / 16)
    rms = np.broadcast_to([[1.0, 2, 3], [1, 2, 5], [1, 3, 6], [9, 12, 15]], (4, 4, 3))
    dof = np.array([[0, 0, 1], [0, 0, 1], [0, 1, 1], [1, 1, 1]])
    dof, winner = np.broadcast_to(dof[:, None], (4, 4, 3)), np.zeros(4, int)
    classes = np.asarray(class_probabilities(patterns, rms, dof, winner, np.array([7.5, 1e9, 7.5, 7.5])))
    np.testing.assert_allclose(np.sum(classes, axis=(1, 2, 3)), 1)
    of_types = np.sum(classes, axis=(2, 3))
    np.testing.assert_array_equal(of_types[:, 0], of_types[:, 1])  # the third axis does not count
    ratio = of_types[:, 2] / of_types[:, 0]
    np.testing.assert_allclose(ratio[0], np.exp(-6 * np.log(1.5) / 2))  # 10 numbers, worth 6
    np.testing.assert_allclose(ratio[1], np.exp(-15 * np.log(1.5) / 2), rtol=1e-6)
    np.testing.assert_allclose(ratio[2], 1)
    np.testing.assert_allclose(of_types[3], 1 / 4)
    assert np.all(of_types[:2, 3] < 1e-4)


def test_the_likeliest_type_wins_unless_nothing_tells_them_apart():
    classes = np.zeros((2, 4, 4, 4))
    classes[0, :, 1, 2] = 0.1, 0.4, 0.2, 0.3
    classes[1, :, 3, 3] = 0.25
    assert likeliest_type(classes, np.array([3, 3])).tolist() == [1, 3]


@pytest.fixture(scope="module")
def windows():
    """A hinge, a drawer, a pin on a plane and free motion, (4, 51, 4, 4)."""
    keys = jax.random.split(jax.random.key(8), 4)
    pin = rf.ConstraintFrame.named("K")
    made = "A", "B", pin, replace(pin, linear_dof=(1, 1, 1))
    return np.stack([synthetic.simulate(c, k, noise=1e-4).poses for c, k in zip(made, keys, strict=True)])


def test_speed_plays_no_part(windows):
    """The same poses in a tenth of the time and in ten times as long."""
    found = rf.identify(windows, dt=0.1)
    np.testing.assert_array_equal(found.angular.dof.sum(axis=1), [1, 0, 3, 3])
    np.testing.assert_array_equal(found.linear.dof.sum(axis=1), [0, 1, 2, 3])
    for dt in (0.01, 1.0):
        other = rf.identify(windows, dt=dt)
        np.testing.assert_array_equal(other.angular.dof, found.angular.dof)
        np.testing.assert_array_equal(other.linear.dof, found.linear.dof)
        np.testing.assert_allclose(other.class_probability, found.class_probability, atol=1e-4)


def test_probabilities_are_those_of_the_classes(windows):
    found = jax.device_get(rf.identify(windows, dt=0.1))
    np.testing.assert_allclose(found.class_probability.sum(axis=(1, 2, 3)), 1, rtol=1e-9)
    for frame in (found.angular, found.linear):
        assert np.all(np.diff(frame.free_probability, axis=1) >= 0)
        np.testing.assert_array_equal(frame.dof, frame.free_probability > 0.5)


def test_a_drawer_that_does_not_turn_to_the_last_digit():
    """Without noise and without rotation there is nothing to divide by."""
    position = jnp.stack([0.2 * jnp.sin(0.1 * jnp.arange(51.0)), jnp.zeros(51), jnp.zeros(51)], axis=-1)
    found = rf.identify(np.asarray(make_pose(jnp.broadcast_to(jnp.eye(3), (51, 3, 3)), position)), dt=0.1)
    assert found.name == "Prismatic joint"
    assert found.status is rf.Status.OK
    assert np.all(np.isfinite(found.class_probability))

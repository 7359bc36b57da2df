"""Motions that do not tell the constraint are named as such, and explained."""

from dataclasses import replace

import jax
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.simulation.motions import PoseErrors, random_motion
from reframe_jax.uncertainty.excitation import possible_constraints

SAMPLES, DT, WINDOWS = 50, 0.1, 6
ERRORS = PoseErrors(sigma=2e-4)


def straight(t):
    """Along one line, without turning."""
    return jax.numpy.zeros(3), jax.numpy.array([0.0, 0.15, 0.0]) * jax.numpy.sin(1.3 * t)


def only_turning(t):
    """About one axis of three, back and forth, without sliding."""
    return np.array([0.0, 0.7, 0.0]) * jax.numpy.sin(1.3 * t), jax.numpy.zeros(3)


def without_spin(t):
    """Two rotations and two translations; the third rotation, about the tool's own axis, is not tried."""
    rates = jax.numpy.asarray([1.1, 1.9, 1.0])
    turn = jax.numpy.asarray([0.6, 0.6, 0.0]) * jax.numpy.sin(rates * t)
    return turn, 0.15 * jax.numpy.sin(1.2 * rates * t + 1.0)


MOTIONS = [
    *((label, "paper") for label in "EFGIJ"),
    *((label, "exciting") for label in "ACDEFGHIJKL"),
    ("K", straight),
    ("K", only_turning),
    ("K", without_spin),
]


@pytest.fixture(scope="module")
def moved():
    """By constraint and motion: poses, what was found, and what the motion tested."""
    poses = []
    for label, motion in MOTIONS:

        def of_key(key, label=label, motion=motion):
            options = {"samples": SAMPLES, "dt": DT, "excitation": motion, "errors": ERRORS}
            return random_motion(label, key, **options).poses

        poses.append(np.asarray(jax.vmap(of_key)(jax.random.split(jax.random.key(4), WINDOWS))))
    every = np.concatenate(poses)
    found = rf.identify(every, dt=DT)
    tested = rf.excitation(found, every, dt=DT)
    return {
        motion: (poses[i], found[rows], tested[rows])
        for i, motion in enumerate(MOTIONS)
        for rows in [slice(i * WINDOWS, (i + 1) * WINDOWS)]
    }


@pytest.mark.parametrize("motion", MOTIONS[:5] + MOTIONS[-3:])
def test_ambiguous_motions_determine_nothing(moved, motion):
    _, found, tested = moved[motion]
    assert not np.any(tested.determined)
    names = possible_constraints(found[0])
    assert names[0] == found[0].name
    assert rf.constraint(motion[0]).name in names


@pytest.mark.parametrize("label", "CDEFGHIJKL")
def test_exciting_motions_determine_the_class(moved, label):
    _, _, tested = moved[label, "exciting"]
    assert np.all(tested.determined)


def test_a_hinge_is_one_path(moved):
    _, _, tested = moved["A", "exciting"]
    assert np.all(tested.one_path)
    assert not np.any(tested.steady)
    assert not np.any(tested.determined)


def test_a_hinge_that_moved_well_is_determined_but_for_the_point_on_its_axis(moved):
    poses, found, tested = moved["A", "exciting"]
    sure = rf.covariance(found[0], poses[0], dt=DT)
    assert sure.determined
    assert sure.first_order
    lines = found[0].explain(sure, tested[0]).splitlines()
    assert lines[0].startswith("The body moves like a door on its hinge")
    assert lines[1].startswith("The axis passes through")
    assert float(lines[1].split("give or take ")[1].split()[0]) < 1
    assert lines[1].endswith("Every other point of the axis is as right.")
    assert lines[2].startswith("It turns about the direction")
    assert float(lines[2].split("give or take ")[1].split()[0]) < 0.2
    assert lines[3].startswith("Not determined: only this one path was tried")
    assert len(lines) == 5


def test_steady_velocities_are_seen(moved):
    for label in "EFGIJ":
        assert np.all(moved[label, "paper"][2].steady)


def test_an_explanation_has_error_bars_and_advice(moved):
    poses, found, tested = moved["K", "exciting"]
    sure = rf.covariance(found[0], poses[0], dt=DT)
    lines = found[0].explain(sure, tested[0]).splitlines()
    assert lines[0].startswith("The body moves like a pen on paper")
    assert "in the body, give or take" in lines[1]
    assert lines[1].endswith("mm.")
    assert lines[2].startswith("The plane is perpendicular to the direction")
    assert lines[2].endswith("degrees.")
    assert len(lines) == 3
    # the interval is 1.96 standard deviations along the worst direction
    size = 1.96e3 * np.sqrt(np.linalg.eigvalsh(sure.position)[-1])
    assert f"give or take {size:.2g} mm" in lines[1]
    assert "give or take" not in found[0].explain()


def test_explanations_say_what_would_settle_it(moved):
    _, found, tested = moved["E", "paper"]
    text = found[0].explain(excitation=tested[0])
    assert "door on its hinge" in text
    assert "only this one path was tried" in text
    assert "push it in other directions" in text
    _, found, tested = moved["K", without_spin]
    text = found[0].explain(excitation=tested[0])
    assert "it did not turn about" in text
    assert "turn the body about that axis as well" in text
    for _, found, tested in moved.values():
        for i in range(WINDOWS):
            assert len(found[i].explain(excitation=tested[i]).splitlines()) <= 5


def test_explanations_say_where_error_bars_end(moved):
    poses, found, tested = moved["K", "exciting"]
    sure = rf.covariance(found[0], poses[0], dt=DT)
    too_noisy = replace(sure, first_order=np.array(False))
    text = found[0].explain(too_noisy, tested[0])
    assert text.splitlines()[2].endswith("The noise is so large that the errors may be larger than that.")
    assert "The noise is so large" not in found[0].explain(sure, tested[0])


def test_a_batch_has_many_explanations(moved):
    with pytest.raises(ValueError, match="index one window"):
        moved["K", "exciting"][1].explain()

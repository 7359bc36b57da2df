"""Motions that do not tell the constraint are named as such, and explained."""

from dataclasses import replace

import numpy as np
import pytest
from contacts import DT, POSES, simulate_contact
from scipy.spatial.transform import Rotation

import reframe_jax as rf

EACH = 8


def pin(turns: np.ndarray, slides: np.ndarray, seed: int) -> np.ndarray:
    """Poses of a pin on a plane that turns and slides as told, (3, POSES) each, with a little noise."""
    rng = np.random.default_rng(seed)
    ground, body = Rotation.random(2, random_state=rng)
    rotation = ground * Rotation.from_rotvec(turns.T) * body
    poses = np.tile(np.eye(4), (slides.shape[1], 1, 1))
    poses[:, :3, 3] = ground.apply(slides.T) - rotation.apply(rng.uniform(0.1, 0.2, 3))
    poses[:, :3, 3] += rng.normal(0, 1e-4, (slides.shape[1], 3))
    poses[:, :3, :3] = (
        rotation * Rotation.from_rotvec(rng.normal(0, 3e-4, (slides.shape[1], 3)))
    ).as_matrix()
    return poses


def one_way(seed: int) -> np.ndarray:
    """It slides along a straight line and turns about the normal, both steadily: a rotation about a point."""
    t = DT * np.arange(POSES)
    turns, slides = np.zeros((2, 3, POSES))
    turns[2] = -0.3 * t
    slides[0], slides[1] = 0.2 * np.cos(turns[2]), 0.2 * np.sin(turns[2])
    return pin(turns, slides, seed)


def straight(seed: int) -> np.ndarray:
    """It slides along one line, without turning."""
    slides = np.zeros((3, POSES))
    slides[0] = 0.15 * np.sin(1.3 * DT * np.arange(POSES))
    return pin(np.zeros((3, POSES)), slides, seed)


MAKERS = {
    "A": lambda seed: simulate_contact("A", seed, sigma=1e-4).poses,
    "C": lambda seed: simulate_contact("C", seed, sigma=1e-4).poses,
    "K": lambda seed: simulate_contact("K", seed, sigma=1e-4).poses,
    "straight": straight,
}


@pytest.fixture(scope="module")
def moved():
    """By motion: poses, what was found, and what the motion tested; 32 windows in all."""
    poses = {name: np.stack([make(seed) for seed in range(EACH)]) for name, make in MAKERS.items()}
    every = np.concatenate(list(poses.values()))
    found = rf.identify(every, dt=DT)
    tested = rf.excitation(found, every, dt=DT)
    rows = {name: slice(i * EACH, (i + 1) * EACH) for i, name in enumerate(MAKERS)}
    return {name: (poses[name], found[rows[name]], tested[rows[name]]) for name in MAKERS}


def test_independent_motions_are_counted(moved):
    for name, motions in {"A": 1, "C": 2, "K": 5, "straight": 1}.items():
        _, found, tested = moved[name]
        assert np.all(np.asarray(tested.motions) == motions), name
        free = np.sum(found.angular.dof, axis=1) + np.sum(found.linear.dof, axis=1)
        np.testing.assert_array_equal(tested.free, free)


def test_a_screw_has_one_degree_of_freedom():
    rng, row = np.random.default_rng(0), np.arange(POSES)
    angle = np.sin(0.15 * row) + 0.5 * np.sin(0.4 * row)
    turn = Rotation.from_rotvec(np.outer(angle, [0, 0, 1]))
    poses = np.tile(np.eye(4), (POSES, 1, 1))
    poses[:, :3, :3] = turn.as_matrix()
    poses[:, :3, 3] = turn.apply([0.2, 0, 0]) + np.outer(0.05 * angle, [0, 0, 1])
    poses[:, :3, 3] += rng.normal(0, 1e-4, (POSES, 3))
    found = rf.identify(poses, dt=DT)
    assert found.name == "Screw joint"
    tested = rf.excitation(found, poses, dt=DT)
    assert (int(tested.free), int(tested.motions)) == (1, 1)


def test_exciting_motions_determine_the_constraint(moved):
    for name in "CK":
        assert np.all(moved[name][2].determined)


def test_one_path_determines_nothing(moved):
    for name in ("A", "straight"):
        tested = moved[name][2]
        assert np.all(tested.one_path)
        assert not np.any(tested.determined)
        assert not np.any(tested.steady)


def test_steady_velocities_are_seen():
    poses = one_way(0)
    found = rf.identify(poses, dt=DT)
    tested = rf.excitation(found, poses, dt=DT)
    assert tested.steady
    assert not tested.determined
    assert "Not determined: one velocity was constant" in found.explain(excitation=tested)


@pytest.mark.parametrize("times", ["jitter", "missing", "two rates"])
def test_irregular_times_change_no_velocity(times):
    """The body of a hinge turns steadily; velocities and amplitudes are those of the angle."""
    rng = np.random.default_rng(7)
    steps = {"jitter": rng.uniform(0.4, 1.6, 120), "missing": rng.geometric(0.6, 120)}
    steps["two rates"] = np.repeat([1, 3], 60)
    clock = 0.05 * np.cumsum(steps[times])
    poses = pin(np.stack([0 * clock, 0 * clock, 0.2 * clock]), np.zeros((3, 120)), 1)
    found = rf.identify(poses, times=clock)
    assert found.name == "Revolute joint"
    np.testing.assert_allclose(found.angular.rms[2], 0.2, rtol=2e-3)
    np.testing.assert_allclose(found.angular.amplitude[2], 0.2 * np.std(clock), rtol=2e-3)
    assert rf.excitation(found, poses, times=clock).steady


def test_an_explanation_has_error_bars_and_advice(moved):
    poses, found, tested = moved["K"]
    covariance = rf.covariance(found, poses, dt=DT)[0]
    text = found[0].explain(covariance, tested[0])
    assert text.startswith("The body moves like a pen on paper")
    # the interval is 1.96 standard deviations along the worst direction
    size = 1.96e3 * np.sqrt(np.linalg.eigvalsh(covariance.position)[-1])
    assert f"{size:.2g} mm" in text
    assert "The plane is perpendicular to the direction" in text
    assert len(text.splitlines()) <= 5
    large = replace(covariance, first_order=np.array(False))
    assert found[0].explain(large, tested[0]) != found[0].explain(covariance, tested[0])
    _, found, tested = moved["A"]
    assert "path" in found[0].explain(excitation=tested[0])


def test_a_failed_window_tested_nothing(moved):
    poses = moved["K"][0].copy()
    poses[1, 3, 0, 3] = np.nan
    found = rf.identify(np.tile(poses, (4, 1, 1, 1)), dt=DT)
    tested = rf.excitation(found, np.tile(poses, (4, 1, 1, 1)), dt=DT)
    assert int(tested.motions[1]) == int(tested.free[1]) == 0
    assert not tested.determined[1]
    assert tested.determined[0]


def test_other_poses_are_refused(moved):
    poses, found, _ = moved["K"]
    with pytest.raises(ValueError, match="of shape"):
        rf.excitation(found[0], poses, dt=DT)

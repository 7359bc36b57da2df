"""Boundaries to the sample: the likelihood of their place, and whether the intervals hold the truth."""

import jax
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.segmentation.likelihood import _filter, _likelihood, _Motion
from reframe_jax.simulation.motions import PoseErrors, disturb
from reframe_jax.simulation.sequences import simulate_sequence

DT = 0.01
MARKERS = PoseErrors(sigma=2e-4, rotation_ratio=5.0)
PAIRS = [("A", "K"), ("unconstrained", "A"), ("K", "B"), ("L", "unconstrained"), ("B", "A"), ("A", "L")]


def found_and_true(ease: float) -> tuple[list[rf.Boundary], list[int]]:
    boundaries, truths = [], []
    for seed, pair in enumerate(PAIRS):
        truth = simulate_sequence(pair, jax.random.key(seed), dt=DT, durations=4.0, ease=ease)
        poses = np.asarray(disturb(truth.exact_poses, jax.random.key(seed), MARKERS, DT))
        (boundary,) = rf.segment(poses, dt=DT).boundaries
        boundaries.append(boundary)
        truths += truth.boundaries
    return boundaries, truths


def test_boundaries_at_rest_are_within_a_few_samples_and_their_intervals_hold_the_truth() -> None:
    boundaries, truths = found_and_true(ease=0.25)
    errors = np.array([b.index for b in boundaries]) - truths
    assert np.median(np.abs(errors)) <= 3
    assert np.abs(errors).max() <= 10
    held = [b.earliest <= truth <= b.latest for b, truth in zip(boundaries, truths, strict=True)]
    assert sum(held) >= len(PAIRS) - 1
    assert np.median([b.latest - b.earliest for b in boundaries]) <= 12


def test_sudden_changes_of_velocity_are_found_to_the_sample() -> None:
    boundaries, truths = found_and_true(ease=0.0)
    for boundary, truth in zip(boundaries, truths, strict=True):
        assert abs(boundary.index - truth) <= 1
        assert boundary.earliest <= truth <= boundary.latest


def random_motion_model(seed: int, known: int, number: int) -> _Motion:
    rng = np.random.default_rng(seed)
    sides = 2
    return _Motion(
        path=np.cumsum(rng.normal(size=(sides, number, 6)), axis=1),
        response=np.eye(6) + 0.3 * rng.normal(size=(sides, number, 6, 6)),
        sensor=rng.normal(size=(sides, number, 6)),
        blind=rng.choice([1.0, 50.0], (sides, number)),
        step=rng.uniform(0.5, 2.0, (sides, number)),
        begin=np.array([0, 3]),
        known=known,
    )


def covariance_of_levels(t: np.ndarray, level: np.ndarray, rate: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Covariance (M, 6, M, 6) of levels driven by white forces: integrated, not filtered."""
    early, late = np.minimum.outer(t, t), np.maximum.outer(t, t)
    walk = early**2 * (3 * late - early) / 6
    each = np.multiply.outer(np.ones_like(walk), level) + np.multiply.outer(np.outer(t, t), rate)
    each += np.multiply.outer(walk, force)
    return each[:, :, :, None].transpose(0, 2, 1, 3) * np.eye(6)[None, :, None, :]


@pytest.mark.parametrize("side", [0, 1])
def test_filtered_costs_are_those_of_one_large_gaussian(side: int) -> None:
    motion, known, number = random_motion_model(1, 6, 11), 6, 11
    force = np.array([[0.0, 0.1, 1.0, 10.0, 0.3, 2.0], [1.0, 0.0, 0.0, 0.2, 5.0, 0.1]])
    filtered = _filter(motion, force, np.array([False, False]))
    begin = int(motion.begin[side])
    own = slice(begin, number)
    start = 1e4 * np.sum(motion.response[side, 0] ** 2, axis=1)
    t = np.concatenate([[0], np.cumsum(motion.step[side, begin + 1 :])])
    dense = covariance_of_levels(t, start, start, force[side])
    for k, (response, blind) in enumerate(
        zip(motion.response[side, own], motion.blind[side, own], strict=True)
    ):
        dense[k, :, k] += response @ response.T * blind
    values = (motion.path[side, own] - motion.path[side, begin]).ravel()

    def cost(poses: int) -> float:
        part = dense[:poses, :, :poses].reshape(6 * poses, 6 * poses)
        x = values[: 6 * poses]
        return float(x @ np.linalg.solve(part, x) + np.linalg.slogdet(part)[1]) / 2

    for k in range(known, number):
        alone = cost(k + 1 - begin) - cost(k - begin)
        assert filtered.cost[side, k - known] == pytest.approx(alone, rel=1e-6, abs=1e-6)


def test_the_spectrum_of_forces_is_recovered() -> None:
    rng = np.random.default_rng(3)
    known, sides = 400, 2
    forces = np.array([1e-4, 1e-2, 1.0, 1e-4, 1e-2, 1.0])
    rate = np.cumsum(rng.normal(size=(sides, known, 6)) * np.sqrt(forces), axis=1)
    path = np.cumsum(rate, axis=1) + rng.normal(size=(sides, known, 6))
    motion = _Motion(
        path=path,
        response=np.broadcast_to(np.eye(6), (sides, known, 6, 6)),
        sensor=path,
        blind=np.ones((sides, known)),
        step=np.ones((sides, known)),
        begin=np.zeros(sides, int),
        known=known,
    )
    spectra = np.concatenate([[0.0], 10.0 ** np.arange(-8, 12.1, 0.5)])
    best = spectra[np.argmax(_likelihood(motion, path, np.ones((sides, 6))), axis=1)]
    assert np.all(np.abs(np.log10(best / forces)) <= 0.5 + 1e-9)

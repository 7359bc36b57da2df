"""Displacements across a gap in the times of a recording are not used."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax as rf
from benchmarks import golden_cases
from reframe_jax.model.moments import Moments, scale_moments
from reframe_jax.motion.paths import sections_of

EXAMPLE = Path(__file__).parent.parent / "examples" / "pin_on_plane.csv"
POSES = 100


@jax.jit
def moments(values: jax.Array, counted: jax.Array, section: jax.Array | None = None) -> Moments:
    return scale_moments(values, counted, jnp.full(len(values), values.shape[2]), section)


def spec_with_a_gap(label: str) -> golden_cases.Spec:
    (spec,) = (s for s in golden_cases.faults_specs() if (s.label, s.fault, s.white) == (label, "gap", 1e-4))
    return spec


def test_sections_start_after_a_gap(rng: np.random.Generator) -> None:
    even, jitter = np.full(POSES - 1, 0.05), rng.uniform(0.03, 0.07, POSES - 1)
    broken = even.copy()
    broken[[29, 59]] = 0.5
    irregular = np.exp(rng.normal(size=POSES - 1))
    steps = np.stack([even, jitter, broken, irregular], axis=1)
    times = np.pad(np.cumsum(steps, axis=0), ((1, 0), (0, 0)))
    path = np.broadcast_to(times, (12, POSES, 4))
    count = np.full(4, POSES)
    found = np.asarray(sections_of(jnp.asarray(path), jnp.asarray(steps), jnp.asarray(count)))
    assert np.all(found[:, :2] == 0)
    np.testing.assert_array_equal(found[:, 2], np.repeat([0, 1, 2], [30, 30, 40]))
    assert found[-1, 3] <= 3  # irregular times have long steps, which are no gaps
    # a body that moves no further in these steps does not show a gap
    slow = np.broadcast_to(0.05 * np.arange(POSES)[:, None], (12, POSES, 4))
    assert not np.any(sections_of(jnp.asarray(slow), jnp.asarray(steps), jnp.asarray(count)))


@pytest.mark.parametrize("size", [3, 10, 25])
def test_poses_that_arrive_in_bursts_keep_their_name(size: int) -> None:
    """Their times are wrong, so that neither velocities nor gaps may decide."""
    recording = rf.load_recording(EXAMPLE)
    number = np.arange(len(recording.poses))
    last = np.minimum(number // size * size + size - 1, number[-1])
    found = rf.identify(recording.poses, times=recording.times[last] + 1e-4 * (number % size))
    true = rf.identify(recording.poses, times=recording.times)
    assert found.name == true.name
    assert found.probability > 0.9
    np.testing.assert_allclose(found.linear.position, true.linear.position, atol=2e-3)
    np.testing.assert_allclose(found.noise.position, true.noise.position, rtol=0.3)


def test_a_constant_in_each_section_changes_no_moment(rng: np.random.Generator) -> None:
    values = np.cumsum(rng.normal(size=(2, 27, POSES)), axis=2)
    section = np.repeat([[0, 1, 2], [0, 0, 0]], [30, 45, 25], axis=1)
    counted = rng.uniform(size=(2, POSES)) > 0.05
    other = values + np.stack([10 * rng.normal(size=(27, 3))[:, section[0]], np.ones((27, POSES))])
    first, second = (moments(jnp.asarray(v), jnp.asarray(counted), section) for v in (values, other))
    np.testing.assert_allclose(second.products, first.products, atol=1e-8)
    np.testing.assert_array_equal(second.details, first.details)
    whole = moments(jnp.asarray(values), jnp.asarray(counted))
    np.testing.assert_allclose(first.products[1], whole.products[1], atol=1e-12)
    assert np.all(first.details[0, 1:-1] < whole.details[0, 1:-1])
    assert first.details[0, -1] <= whole.details[0, -1]


@pytest.mark.parametrize("label", "EFGH")
def test_constraints_of_velocities_are_found_across_a_gap(label: str) -> None:
    (case,) = golden_cases.simulate([spec_with_a_gap(label)])
    found = rf.identify(case.poses, times=case.times)
    assert found.name in case.expected
    assert found.probability > 0.9
    assert np.all(found.counted)
    spread = rf.covariance(found, case.poses, times=case.times)
    assert np.all(np.isfinite(spread.matrix))


def test_single_missing_poses_change_neither_the_name_nor_the_noise(rng: np.random.Generator) -> None:
    """The motion across a missing pose is no noise: it would hide the smallest time scales."""
    recording = rf.load_recording(EXAMPLE)
    kept = np.sort(rng.permutation(len(recording.poses))[: 7 * len(recording.poses) // 10])
    whole = rf.identify(recording.poses, times=recording.times)
    part = rf.identify(recording.poses[kept], times=recording.times[kept])
    assert part.name == whole.name
    np.testing.assert_allclose(part.noise.position, whole.noise.position, rtol=0.5)
    np.testing.assert_allclose(part.noise.rotation, whole.noise.rotation, rtol=0.5)


def test_short_sections_have_short_scales(rng: np.random.Generator) -> None:
    """Blocks are shorter than sections, so that displacements within sections remain."""
    values = np.cumsum(rng.normal(size=(1, 27, POSES)), axis=2)
    section = np.arange(POSES)[None] // 10
    found = moments(jnp.asarray(values), jnp.ones((1, POSES), bool), jnp.asarray(section, jnp.int32))
    part = moments(jnp.asarray(values[:, :, :10]), jnp.ones((1, 10), bool))
    used = found.details[0] > 0
    np.testing.assert_array_equal(found.width[0, used], part.width[0, part.details[0] > 0])
    whole = moments(jnp.asarray(values), jnp.ones((1, POSES), bool))
    assert found.details[0, -1] <= whole.details[0, -1]


def test_many_gaps_leave_a_clear_screw() -> None:
    for seed in range(40, 43):
        (case,) = golden_cases.simulate([spec_with_a_gap("screw")._replace(fault="", seed=seed)])
        kept = np.arange(len(case.poses)) % 25 < 18
        found = rf.identify(case.poses[kept], times=case.times[kept])
        assert found.name in case.expected
        assert found.probability > 0.9

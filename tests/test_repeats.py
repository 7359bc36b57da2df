"""Poses that a recorder repeats because it is faster than the tracker."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax as rf
from benchmarks import golden_cases
from reframe_jax.motion.outliers import find_repeats

EXAMPLE = rf.load_recording(Path(__file__).parent.parent / "examples" / "pin_on_plane.csv")
POSES, TIMES = np.asarray(EXAMPLE.poses), np.asarray(EXAMPLE.times)


def slow_tracker(ratio: float, count: int = len(POSES)) -> np.ndarray:
    """Row that a recorder writes in each sample, of a tracker that is slower by a ratio."""
    return np.floor(np.floor(np.arange(count) / ratio + 1e-9) * ratio + 1e-9).astype(int)


def same_numbers(one: rf.Identification, other: rf.Identification) -> None:
    assert one.name == other.name
    for part in ("angular", "linear"):
        for number in ("rotvec", "amplitude"):
            first, second = (getattr(getattr(found, part), number) for found in (one, other))
            np.testing.assert_allclose(first, second, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(one.linear.position, other.linear.position, atol=1e-9)
    np.testing.assert_allclose(one.entry_probability, other.entry_probability, atol=1e-6)
    np.testing.assert_allclose(one.noise.position, other.noise.position, rtol=1e-6)


@pytest.mark.parametrize("ratio", [1.5, 2, 10 / 3])
def test_repeated_poses_count_once(ratio: float) -> None:
    row = slow_tracker(ratio)
    first = np.unique(row, return_index=True)[1]
    found = rf.identify(POSES[row], times=TIMES)
    same_numbers(found, rf.identify(POSES[row][first], times=TIMES[first]))
    assert np.all(found.counted)  # a repeated pose is no outlier
    assert found.counted.shape == (len(POSES),)


def test_error_bars_too() -> None:
    row = slow_tracker(2)
    first = np.unique(row, return_index=True)[1]
    all_rows, different = (
        rf.covariance(rf.identify(poses, times=times), poses, times=times)
        for poses, times in ((POSES[row], TIMES), (POSES[row][first], TIMES[first]))
    )
    np.testing.assert_allclose(all_rows.position, different.position, rtol=1e-3)


def test_all_repeats_of_an_outlier_are_left_out() -> None:
    row, moved = slow_tracker(2), POSES.copy()
    moved[24, :3, 3] += 0.3
    found = rf.identify(moved[row], times=TIMES)
    np.testing.assert_array_equal(np.flatnonzero(~np.asarray(found.counted)), [24, 25])


def test_other_windows_of_a_batch_do_not_change() -> None:
    count = 31
    windows = np.stack([POSES[start : start + count] for start in range(0, 20, 2)])
    before = rf.identify(windows, dt=0.1)
    windows[3] = windows[3][slow_tracker(2, count)]
    after = rf.identify(windows, dt=0.1)
    others = np.arange(len(windows)) != 3
    for one, other in zip(before.linear.position[others], after.linear.position[others], strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(before.entry_probability[others], after.entry_probability[others])


def test_a_body_at_rest_keeps_its_poses() -> None:
    """Otherwise a rest would be a gap, across which the path is not known."""
    rest = np.concatenate([np.arange(25), np.full(20, 24), np.arange(25, len(POSES))])
    own = np.ones((len(rest), 1), bool)
    path = jnp.asarray(POSES[rest][:, :3].reshape(-1, 12, 1).swapaxes(0, 1))
    assert not np.any(find_repeats(path, own))
    found = find_repeats(path[:, :36], own[:36])[:, 0]
    np.testing.assert_array_equal(np.flatnonzero(found), np.arange(25, 36))


@pytest.mark.parametrize("label", ["A", "C", "K", "spherical", "unconstrained"])
def test_constraints_keep_their_names(label: str) -> None:
    """The steps between repeated poses are no noise, which would hide small motions."""
    specs = [
        s for s in golden_cases.faults_specs() if (s.label, s.fault, s.white) == (label, "repeats", 1e-5)
    ]
    (case,) = golden_cases.simulate(specs)
    assert np.sum(np.all(case.poses[1:] == case.poses[:-1], axis=(1, 2))) >= 49
    found = rf.identify(case.poses, times=case.times)
    assert found.name in case.expected
    assert found.probability > 0.9


def test_few_different_poses_are_all_used() -> None:
    few = np.repeat(POSES[:40:10], 5, axis=0)
    found = rf.identify(few[None].repeat(2, axis=0), dt=0.05)
    assert np.all(np.isfinite(found.linear.position)) or np.all(found.status_code >= 10)

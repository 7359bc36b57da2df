"""The robot experiments: the paper's figures, the tables made of ours, and a sweep that goes on."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import reframe_jax as rf
from benchmarks import paper_robot, robot_sweep, robot_table4


@pytest.mark.parametrize("label", list(robot_table4.PAPER))
def test_transcription_is_consistent(label: str) -> None:
    """The lowest norm is about the geometric mean of the rms velocities, and the rms are sorted."""
    row = robot_table4.PAPER[label]
    for norms, rms in ((row.angular_norms, row.angular_rms), (row.linear_norms, row.linear_rms)):
        means = np.array([mean for mean, _ in rms])
        assert np.all(np.diff(means) > 0)
        np.testing.assert_allclose(np.cbrt(np.prod(means)), np.nanmin([mean for mean, _ in norms]), rtol=0.15)
    entry = rf.CONSTRAINTS[label]
    expected = [entry.angular_axis is None, entry.linear_axis is None, not any(entry.position)]
    assert [bool(np.isnan(mean)) for mean, _ in row.errors] == expected


def test_paper_ranges_are_those_of_its_table() -> None:
    rows = {
        label: {
            "angular_rms": np.array([[mean for mean, _ in row.angular_rms]]),
            "linear_rms": np.array([[mean for mean, _ in row.linear_rms]]),
        }
        for label, row in robot_table4.PAPER.items()
    }
    angular, linear = robot_table4.threshold_ranges(rows)
    np.testing.assert_allclose(angular, robot_table4.PAPER_RANGES[0], atol=1)
    np.testing.assert_allclose(linear, robot_table4.PAPER_RANGES[1], atol=1)


def test_table_in_words() -> None:
    count = 4
    row = {
        "angular_norms": np.tile([90.0, 95.0], (count, 1)),
        "linear_norms": np.tile([4.0, 3.0, 2.0, 5.0], (count, 1)),
        "angular_rms": np.tile([20.0, 40.0, 900.0], (count, 1)),
        "linear_rms": np.tile([1.0, 2.0, 3.0], (count, 1)),
        "errors": np.tile([0.5, np.nan, 1.5], (count, 1)),
        "types": np.ones(count, dtype=bool),
        "types_or_ties": np.ones(count, dtype=bool),
        "dof": np.array([True, True, True, False]),
        "left_out": np.asarray(2),
    }
    text = robot_table4.table4_markdown({"A": row}, "A table")
    assert "**90.0 ± 0.0** (108.2 ± 7.9) | 95.0 ± 0.0 (illegible)" in text
    assert "0.50 ± 0.00 (0.19 ± 0.02)" in text
    assert "| degrees of freedom right, % | 75 |" in text
    assert "| ours, all, every trial | 40.0 to 900.0 | 3.0 to inf |" in text


@pytest.mark.slow
def test_sweep_goes_on_from_its_parts(tmp_path: Path) -> None:
    sweep = replace(robot_sweep.QUICK, labels=("A",), give=(0.0,), demonstrations=4)
    found = robot_sweep.noise_sweep(sweep, folder=tmp_path)
    assert found["types"].shape == (1, 2, 1, 1, 2, 4)
    (part,) = tmp_path.glob("A-0-*.npz")
    written = part.stat().st_mtime_ns
    again = robot_sweep.noise_sweep(sweep, folder=tmp_path)
    assert part.stat().st_mtime_ns == written
    for name, values in found.items():
        np.testing.assert_array_equal(values, again[name])
    assert np.isnan(found["linear"]).all()
    assert found["types"][0, 0].all()
    assert np.nanmedian(found["position"][0, 0]) < 0.5
    text = paper_robot.sweep_markdown(sweep, found)
    assert f"{sweep.windows} windows" in text

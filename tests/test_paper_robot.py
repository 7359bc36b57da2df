"""The robot experiments: the paper's figures, the tables made of ours, and a sweep that goes on."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import reframe_jax as rf
from benchmarks import paper_figure5, paper_sweep, paper_table4
from benchmarks.paper_common import LABELS, Store

TRIALS = 4


@pytest.mark.parametrize("label", list(paper_table4.PAPER))
def test_transcription_is_consistent(label: str) -> None:
    """The lowest norm is about the geometric mean of the rms velocities, and the rms are sorted."""
    row = paper_table4.PAPER[label]
    for norms, rms in ((row.angular_norms, row.angular_rms), (row.linear_norms, row.linear_rms)):
        means = np.array([mean for mean, _ in rms])
        assert np.all(np.diff(means) > 0)
        np.testing.assert_allclose(np.cbrt(np.prod(means)), np.nanmin([mean for mean, _ in norms]), rtol=0.15)
    entry = rf.CONSTRAINTS[label]
    expected = [entry.angular_axis is None, entry.linear_axis is None, not any(entry.position)]
    assert [bool(np.isnan(mean)) for mean, _ in row.errors] == expected


@pytest.mark.parametrize("group", ["angular", "linear"])
def test_paper_ranges_are_those_of_its_table(group: str) -> None:
    rms = {
        label: np.array([[mean for mean, _ in (*row.angular_rms, *row.linear_rms)]])
        for label, row in paper_table4.PAPER.items()
    }
    found = paper_table4.threshold_range(rms, group)
    np.testing.assert_allclose(found, paper_table4.PAPER_RANGES[group], atol=1)


def test_thresholds_that_classify_nothing() -> None:
    rms = {"A": np.array([[0.1, 0.2, 2.0, 0.1, 0.2, 0.3]]), "B": np.array([[0.3, 0.4, 2.5, 0.1, 0.2, 9.0]])}
    assert paper_table4.threshold_range(rms, "angular") == (2.5, 2.0)
    assert paper_table4.threshold_range(rms, "linear") == (0.3, 9.0)


def demonstrated(*_: Any) -> dict[str, np.ndarray]:
    """What Table 4 could find: everything right but one trial of A."""
    shape = (len(LABELS), TRIALS)
    dof = np.ones(shape, dtype=bool)
    dof[0, 0] = False
    errors = np.tile([0.5, 0.7, 1.5], (*shape, 1))
    errors[0, :, 1] = np.nan
    return {
        "norms": np.tile([90.0, 95.0, 4.0, 3.0, 2.0, 5.0], (*shape, 1)),
        "rms": np.tile([20.0, 40.0, 900.0, 1.0, 2.0, 3.0], (*shape, 1)),
        "errors": errors,
        "types": np.ones(shape, dtype=bool),
        "tied": np.ones(shape, dtype=bool),
        "dof": dof,
        "violation": np.zeros((*shape, 2)),
    }


def test_table_in_words() -> None:
    text = paper_table4.table_text(demonstrated())
    assert "| A | **90.0 ± 0.0** (108.2 ± 7.9) | 95.0 ± 0.0 (illegible) | 20.0 ± 0.0 (20.5 ± 10.8) |" in text
    assert "| *900.0 ± 0.0* (863.7 ± 46.7) | 0.50 ± 0.00 (0.19 ± 0.02) |" in text
    assert "| C | **90.0 ± 0.0** | 95.0 ± 0.0 |" in text
    assert "| right degrees of freedom, % | 75 | 100 |" in text


def test_table_4_in_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paper_table4, "identify_all", demonstrated)
    size = paper_table4.Size(trials=TRIALS, setups=("realistic", "matched"))
    section = paper_table4.section(Store(tmp_path, size), size)
    assert section.metrics["table4_types_correct"] == 1
    assert section.metrics["table4_dof_correct"] == pytest.approx(1 - 1 / (12 * TRIALS))
    assert section.metrics["table4_matched_position_error_mm"] == 1.5
    assert section.metrics["table4_linear_from_mm"] == 3.0, "the third axis of A is constrained"
    assert "| realistic | A B D I K | 100 % | 95 % | 0.50 | 0.70 | 1.50 | none" in section.text


def reproduced(*_: Any) -> dict[str, np.ndarray]:
    """What Figure 5 could find: an inexact frame costs 0.5 N m, an identified one 0.25."""
    extra = np.array([0.0, 0.5, 0.25])[:, None]
    shape = (len(paper_figure5.TASKS), len(paper_figure5.ROWS), TRIALS)
    force = np.broadcast_to(2.0 + np.arange(TRIALS), shape)
    return {
        **{name: force + extra for name in ("moment", "rest_moment")},
        **{name: force for name in ("force", "rest_force")},
        "completed": np.ones(shape, dtype=bool),
        "errors": np.tile([0.1, 0.2, np.nan], (shape[0], TRIALS, 1)),
        "redrawn": np.array([0, 3, 0, 0]),
    }


def test_excess_is_that_of_the_same_trial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paper_figure5, "reproduce_all", reproduced)
    size = paper_figure5.Size(trials=TRIALS, setups=("realistic",))
    section = paper_figure5.section(Store(tmp_path, size), size)
    assert section.metrics["figure5_realistic_I_position_only_excess_moment"] == pytest.approx(0.25)
    assert section.metrics["figure5_realistic_B_excess_force"] == 0
    assert "| B | literature |  | 100 % | 4.00 ± 1.12 | +0.50 ± 0.00 |" in section.text
    assert "0.10, 0.20, –" in section.text
    assert "Geometries that the arm could not reach, and that were replaced: B: 3." in section.text
    assert (tmp_path / "figure5-realistic.png").stat().st_size > 10_000


def test_sweep_goes_on_from_its_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    size = paper_sweep.Size.quick(1)
    calls = []

    def identify_all(size: paper_sweep.Size, compliance: float) -> dict[str, np.ndarray]:
        calls.append(compliance)
        shape = (len(LABELS), len(size.noise), len(size.periods), len(size.lengths), size.demonstrations)
        right = np.zeros(shape, dtype=bool)
        right[:, 0] = True
        error = np.full(shape, 1e3 * compliance + 0.1)
        return {**dict.fromkeys(("types", "tied", "dof"), right), "axis": error, "position": error}

    monkeypatch.setattr(paper_sweep, "identify_all", identify_all)
    section = paper_sweep.section(Store(tmp_path, size), size)
    assert calls == list(size.compliance)
    assert section.metrics["sweep_windows"] == 12 * 8 * 3 * 3 * 2
    assert section.metrics["sweep_types_correct"] == pytest.approx(1 / 3)
    expected = np.tile(1e3 * np.array(size.compliance)[:, None] + 0.1, (1, 3))
    np.testing.assert_allclose(section.data["position"]["2.5 s at 0.05 s"], expected)
    np.testing.assert_allclose(section.data["types"]["5 s at 0.05 s"], np.tile([1, 0, 0], (3, 1)))
    assert "| noise, mm | 0.01 | 100.0 % |" in section.text
    assert "|  | 1 | 0.0 % |" in section.text
    again = paper_sweep.section(Store(tmp_path, size), size)
    assert len(calls) == len(size.compliance)
    assert again.text == section.text


@pytest.mark.slow
def test_a_sweep_of_clean_windows_finds_what_is_there() -> None:
    size = paper_sweep.Size(
        demonstrations=4, compliance=(0.0,), noise=(1e-5,), periods=(0.05,), lengths=(5.0,), recorded=0.05
    )
    found = paper_sweep.identify_all(size, 0.0)
    assert found["types"].shape == (12, 1, 1, 1, 4)
    assert found["types"].all()
    assert found["dof"].all()
    assert np.isnan(found["position"][LABELS.index("B")]).all()
    assert np.nanmedian(found["position"]) < 0.5
    assert np.nanmedian(found["axis"]) < 0.1

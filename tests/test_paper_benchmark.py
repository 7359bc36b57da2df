"""The report on the paper's experiments: what is scored, what is marked, and that runs resume."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import paper, paper_figure4
from benchmarks.paper_common import LABELS, Store, number, plain, spread, table
from benchmarks.paper_figure4 import CELLS, Size

SIZE = Size(seeds=5, levels=4, annealed=3)


def fake_cell(slope: float, other: str = "") -> dict[str, np.ndarray]:
    """Errors that follow a power of the noise; constraints in ``other`` have a simpler explanation."""
    shape = (len(LABELS), SIZE.levels, SIZE.seeds)
    errors = np.broadcast_to((SIZE.noise**slope)[:, None], shape) * np.linspace(0.5, 1.5, SIZE.seeds)
    wrong = np.isin(list(LABELS), list(other))[:, None, None]
    return {
        **dict.fromkeys(("angular", "linear", "position"), errors),
        **dict.fromkeys(("types_correct", "dof_correct"), np.broadcast_to(~wrong, shape)),
        "other": np.broadcast_to(wrong, shape),
        "norms": np.ones((*shape, 6)),
        "seconds": np.array(1.0),
    }


def test_slopes_and_marks() -> None:
    curves = paper_figure4.entries(fake_cell(0.8, "EG"), SIZE.noise)
    np.testing.assert_allclose([curve.slope for curve in curves], 0.8)
    marked = {(curve.label, curve.quantity) for curve in curves if not curve.determined}
    assert marked == {(label, name) for label in "EG" for name in ("linear", "position")}


def test_undetermined_entries_are_shown_and_not_scored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[Any] = []

    def identify_cell(poses: Any, discretization: str) -> dict[str, np.ndarray]:
        calls.append(discretization)
        cell = fake_cell(1.0 if discretization == "chord" else 0.0, "G")
        cell["linear"] = np.where(cell["other"], 50.0, cell["linear"])  # a slope of 0
        return cell

    monkeypatch.setattr(paper_figure4, "_picture", lambda *_: None)
    monkeypatch.setattr(Store, "picture", lambda *_: "")
    monkeypatch.setattr(paper_figure4, "windows", lambda *_: None)
    monkeypatch.setattr(paper_figure4, "identify_cell", identify_cell)
    monkeypatch.setattr(
        paper_figure4,
        "anneal_sample",
        lambda *_: {
            "indices": np.zeros((3, 3), int),
            "seconds": np.full(3, 2.0),
            "ratio": np.full((3, 6), 1.1),
            **dict.fromkeys(("angular", "linear", "position"), np.ones(3)),
        },
    )
    first = paper_figure4.section(Store(tmp_path, SIZE), SIZE)
    assert first.metrics["slope_min"] == pytest.approx(1)
    assert first.metrics["slope_max"] == pytest.approx(1)
    assert first.metrics["plateau_slope_max"] == pytest.approx(0, abs=1e-9)
    assert first.metrics["windows"] == 8 * 12 * 4 * 5
    assert first.metrics["dual_annealing_hours"] == pytest.approx(2 * 8 * 240 / 3600)
    assert "| G | ΔR^ψ, deg | (50)" in first.text
    assert len(calls) == len(CELLS)
    again = paper_figure4.section(Store(tmp_path, SIZE), SIZE)
    assert len(calls) == len(CELLS), "finished pieces are not computed again"
    assert again.text == first.text
    paper_figure4.section(Store(tmp_path, SIZE, fresh=True), SIZE)
    assert len(calls) == 2 * len(CELLS)


def test_other_options_have_other_pieces(tmp_path: Path) -> None:
    for seed in (1, 2, 1):
        made = Store(tmp_path, Size(seed=seed)).piece("x", lambda seed=seed: {"seed": seed})
        assert made["seed"] == seed
    assert len(list((tmp_path / "cells").iterdir())) == 2


def test_a_damaged_piece_is_named(tmp_path: Path) -> None:
    Store(tmp_path, SIZE).piece("x", lambda: {"values": np.arange(100.0)})
    (file,) = (tmp_path / "cells").iterdir()
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(ValueError, match=rf"{file.name} is damaged"):
        Store(tmp_path, SIZE).piece("x", dict)
    assert Store(tmp_path, SIZE, fresh=True).piece("x", lambda: {"values": 1})["values"] == 1


def test_numbers_and_tables() -> None:
    texts = [number(x) for x in (0.0, 0.012345, 12.345, 1234.5, 1.2345e-5, float("nan"))]
    assert texts == ["0.0", "0.012", "12", "1234", "1.2e-05", "–"]
    assert table(["a", "b"], [["1", "2"]]) == "| a | b |\n| :-- | --: |\n| 1 | 2 |"
    assert plain([[1.23456789, np.nan]]) == [[1.23457, None]]
    assert spread(np.array([1.0, 3.0]), "+.1f") == "+2.0 ± 1.0"
    assert spread(np.full(2, np.nan)) == "–"


@pytest.mark.slow
def test_the_quick_report(tmp_path: Path) -> None:
    out, metrics = tmp_path / "report", tmp_path / "metrics.json"
    assert paper.main(["--quick", "--out", str(out), "--json", str(metrics)]) == 0
    result = json.loads(metrics.read_text())["metrics"]
    assert 0.85 < result["slope_min"] <= result["slope_max"] < 1.15
    assert result["types_correct"] == result["dof_correct"] == 1
    assert result["table4_types_correct"] == result["table4_dof_correct"] == 1
    assert result["seconds"] > 0
    json.loads((out / "report.json").read_text(), parse_constant=lambda name: pytest.fail(name))
    text = (out / "report.md").read_text()
    for picture in out.glob("*.png"):
        assert picture.name in text
    assert paper.main(["--quick", "--out", str(out)]) == 0
    assert (out / "report.md").read_text() == text

"""The attacks in small, and that they would notice."""

import json

import numpy as np
import pytest

from benchmarks import faults
from benchmarks.faults import Tally, attempt


def test_a_few_attacks_of_every_kind_find_no_fault(tmp_path, capsys):
    pytest.importorskip("pyarrow")
    assert faults.main(["--quick", "--json", str(tmp_path / "faults.json")]) == 0
    report = json.loads((tmp_path / "faults.json").read_text())
    assert set(report) == set(faults.FRACTIONS)
    for part in report.values():
        assert part["faults"] == {}
        assert sum(part["outcomes"].values()) > 0
    assert capsys.readouterr().out.splitlines()[-1] == "0 faults"


def crash():
    raise TypeError("bare")


def refuse():
    raise ValueError("this is why")


def refuse_without_words():
    raise ValueError


def hang():
    while True:
        pass


@pytest.mark.parametrize(
    ("act", "outcome", "fault"),
    [
        (lambda: "read", "read", None),
        (refuse, "refused", None),
        (refuse_without_words, "refused", "without words"),
        (crash, "fault", "TypeError"),
        (hang, "fault", "no end within"),
    ],
)
def test_what_counts_as_a_fault(act, outcome, fault, monkeypatch):
    monkeypatch.setattr(faults, "PATIENCE", 0.2)
    tally = Tally()
    attempt(tally, "input 7", act)
    assert dict(tally.outcomes) == {outcome: 1}
    assert len(tally.faults) == (fault is not None)
    assert all(fault in words and words.startswith("input 7") for words in tally.faults)


def test_nan_under_a_good_status_and_changed_neighbours_are_faults():
    status, expected = np.array([0, 0, 12]), {"norm": np.array([1.0, 2.0, 3.0])}

    def faults_of(values):
        return list(faults.faults_of_batch(status, {"norm": np.array(values)}, expected, np.array([0])))

    assert faults_of([5.0, 2.0, 3.0]) == []
    assert "is not finite in window 0" in faults_of([np.nan, 2.0, 3.0])[0]
    assert "of a sound window changed" in faults_of([1.0, 2.0 + 1e-12, 3.0])[0]


def test_faults_make_the_exit_code(monkeypatch, capsys):
    tally = Tally()
    tally.add("fault", "it broke")
    monkeypatch.setattr(faults, "attack_windows", lambda count: tally)
    assert faults.main(["--only", "windows", "--count", "10"]) == 1
    out = capsys.readouterr().out
    assert "it broke" in out
    assert out.splitlines()[-1] == "1 faults"

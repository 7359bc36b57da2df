"""What was left out of a recording and why, in one place: in Python, on the command line, in JSON, drawn."""

import json
from pathlib import Path

import numpy as np
import pytest
from recording_files import HEADER, poses_of, write
from test_recording_lost import hinge

import reframe_jax as rf
from reframe_jax.cli import program

Captured = pytest.CaptureFixture[str]
COUNT = 60


@pytest.fixture
def file(tmp_path: Path, rng: np.random.Generator) -> Path:
    """A hinge: rows 20-27 at the origin, row 40 half a turn off, row 50 again at the same time."""
    rows = hinge(rng, count=COUNT)
    rows[20:28, 1:4] = 0.0
    rows[40, 4:] = rows[40, [7, 6, 5, 4]] * [1, -1, 1, -1]
    rows = np.insert(rows, 51, rows[50], axis=0)
    rows[51, 1] += 1e-3
    return write(tmp_path / "door.csv", HEADER, rows)


def test_rows_that_play_no_part_have_a_reason(file: Path) -> None:
    recording = rf.load_recording(file)
    counted = np.ones(len(recording.times), bool)
    counted[np.flatnonzero(recording.rows == 42)] = False
    unused = {each.reason: each.rows.tolist() for each in recording.unused(counted)}
    assert unused == {"equal_time": [53], "origin": list(range(22, 30)), "outlier": [42]}
    assert len(recording.unused(np.ones_like(counted))) == 2
    np.testing.assert_allclose(recording.left_out_times[:8], 0.02 * np.arange(20, 28), atol=1e-9)
    with pytest.raises(ValueError, match="Expected counted of shape"):
        recording.unused(counted[1:])


def test_times_of_rows_at_the_ends_go_on(tmp_path: Path, rng: np.random.Generator) -> None:
    rows = hinge(rng, count=COUNT)
    rows[:5, 1:4] = rows[-3:, 1:4] = 0.0
    recording = rf.load_recording(write(tmp_path / "ends.csv", HEADER, rows))
    expected = 0.02 * np.r_[0:5, COUNT - 3 : COUNT]
    np.testing.assert_allclose(recording.left_out_times, expected, atol=1e-9)
    only = rf.Recording(np.arange(3.0), poses_of(rows)[:3], tmp_path)
    assert not len(only.left_out_times)
    assert only.unused(np.array([True, False, True]))[0].rows.tolist() == [1]


def test_the_command_line_prints_writes_and_draws_them(file: Path, tmp_path: Path, capsys: Captured) -> None:
    out, picture = tmp_path / "out.json", tmp_path / "out.png"
    arguments = ["identify", "--no-cache", str(file), "--json", str(out), "--plot", str(picture)]
    assert program.main(arguments) == 0
    text = capsys.readouterr().out
    (heading,) = (line for line in text.splitlines() if line.startswith("Rows "))
    assert heading == "Rows    51 of 61 used; left out:"
    assert "\n  lines 22-29 (8 rows): the position is 0, 0, 0\n" in text
    assert "\n  line 42: the pose jumps away from its neighbours and back\n" in text
    assert picture.stat().st_size > 1000
    (record,) = json.loads(out.read_text())["recordings"]
    assert (record["rows"]["word"], record["rows"]["used"]) == ("line", 51)
    found = {each["reason"]: each["rows"] for each in record["rows"]["left_out"]}
    assert found == {"equal_time": [53], "origin": list(range(22, 30)), "outlier": [42]}
    assert all(each["why"] for each in record["rows"]["left_out"])

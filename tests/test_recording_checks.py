"""Recordings: units, times and rotations; what is repaired, and what is refused row by row."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from recording_files import HEADER, check, poses_of, write
from scipy.spatial.transform import Rotation

from reframe_jax.motion.checks import MIN_VELOCITIES
from reframe_jax.recordings.checks import MIN_POSES
from reframe_jax.recordings.reading import load_recording
from reframe_jax.recordings.recording import RecordingError

# Units and times


@pytest.mark.parametrize(("unit", "scale"), [("m", 1.0), ("cm", 100.0), ("mm", 1000.0)])
def test_units(tmp_path: Path, table: np.ndarray, unit: str, scale: float) -> None:
    rows = table * [1, scale, scale, scale, 1, 1, 1, 1]
    header = ["t", f"x [{unit}]", f"y [{unit}]", f"z [{unit}]", "qx", "qy", "qz", "qw"]
    path = write(tmp_path / "a.csv", header, rows)
    check(path, table, unit=unit)
    check(path, table)
    other = "cm" if unit == "mm" else "mm"
    with pytest.raises(RecordingError, match=rf"states another unit than {other}; leave out unit \(--unit\)"):
        load_recording(path, unit=other)  # type: ignore[arg-type]


def test_millimetres_are_not_taken_for_metres(tmp_path: Path, table: np.ndarray) -> None:
    path = write(tmp_path / "a.csv", HEADER, table * [1, 1000, 1000, 1000, 1, 1, 1, 1])
    with pytest.raises(RecordingError, match=r"line \d+: .* m from the median position; .*--unit mm"):
        load_recording(path)


def test_times_since_1970_keep_their_differences(tmp_path: Path, table: np.ndarray) -> None:
    rows = table.astype(object)
    rows[:, 0] = [f"1623456789.{123456789 + 1000003 * k}" for k in range(9)]
    for path in (write(tmp_path / "a.csv", HEADER, rows), write(tmp_path / "a.tum", None, rows, sep=" ")):
        recording = load_recording(path)
        # floats of that size are 2.4e-7 s apart: the difference must be taken before rounding
        np.testing.assert_allclose(recording.times, 1.000003e-3 * np.arange(9), rtol=0, atol=1e-17)
        assert recording.notes == ("times count from the first sample, at 1623456789.123456789 s.",)


def test_times_since_1970_are_read_as_other_numbers_are(tmp_path: Path, table: np.ndarray) -> None:
    """With underscores, exponents and other digits, as Python's float reads them."""
    cells = [
        "1_600_000_000.5",
        "16000000010e-1",
        "١٦٠٠٠٠٠٠٠٢",
        "+1600000003",
        "1.600000004e9",
        " 1600000005 ",
    ]
    path = write(tmp_path / "a.csv", HEADER, table[:6].astype(object))
    lines = [line.split(",") for line in path.read_text().splitlines()]
    rows = [",".join([cell, *line[1:]]) for cell, line in zip(cells, lines[1:], strict=True)]
    path.write_text("\n".join([",".join(HEADER), *rows]))
    np.testing.assert_array_equal(load_recording(path).times, [0, 0.5, 1.5, 2.5, 3.5, 4.5])


def test_times_that_are_not_seconds(tmp_path: Path, table: np.ndarray) -> None:
    step = 1e-9 * np.diff(table[:, 0]).min()
    nanoseconds = np.round(table[:, 0] / 1e-9).astype(np.int64) + 1_623_456_789_000_000_000
    assert step > 0
    np.savez(tmp_path / "a.npz", times=nanoseconds, poses=poses_of(table))
    with pytest.raises(RecordingError, match=r"times are .* s apart.*--time-unit ns.*--dt"):
        load_recording(tmp_path / "a.npz")
    table[:, 0] *= 1000


def test_sample_times_are_needed_exactly_where_there_are_none(tmp_path: Path, table: np.ndarray) -> None:
    path = write(tmp_path / "a.csv", HEADER[1:], table[:, 1:])
    with pytest.raises(RecordingError, match=r"has no times.*--dt"):
        load_recording(path)
    np.testing.assert_allclose(load_recording(path, dt=0.25).times, 0.25 * np.arange(9))
    recording = load_recording(write(tmp_path / "b.csv", HEADER, table), dt=0.25)
    np.testing.assert_allclose(recording.times, 0.25 * np.arange(9))
    assert recording.notes == ("the times in the file are ignored; the sample time is 0.25 s.",)


@pytest.mark.parametrize(
    ("start", "dtype"),
    [(1_600_000_000, np.int64), (2**64 - 40, np.uint64), (-(2**63), np.int64), (1_600_000_000, np.int32)],
)
def test_whole_times_do_not_overflow(tmp_path: Path, table: np.ndarray, start: int, dtype: type) -> None:
    times = np.array([start + 2 * k for k in range(9)], dtype)
    np.savez(tmp_path / "a.npz", times=times, poses=poses_of(table))
    recording = load_recording(tmp_path / "a.npz", time_unit="s")
    np.testing.assert_array_equal(recording.times, 2.0 * np.arange(9))
    assert recording.notes[0] == f"times count from the first sample, at {start} s."


def test_whole_times_that_go_back_are_sorted(tmp_path: Path, table: np.ndarray) -> None:
    times = np.array([1_600_000_000 + k for k in (0, 1, 2, -3, 4, 5, 6, 7, 8)], np.uint64)
    np.savez(tmp_path / "a.npz", times=times, poses=poses_of(table))
    recording = load_recording(tmp_path / "a.npz")
    np.testing.assert_array_equal(recording.times, [-3, 0, 1, 2, 4, 5, 6, 7, 8])
    assert recording.rows is not None
    assert recording.rows.tolist() == [3, 0, 1, 2, 4, 5, 6, 7, 8]
    assert recording.notes[1:] == (
        "sample 3 is earlier than the previous sample; the rows are sorted by time.",
    )


# Repairs


def test_rows_with_gaps_are_dropped_and_the_others_keep_their_times(
    tmp_path: Path, table: np.ndarray
) -> None:
    rows = table.astype(object)
    rows[2, 1], rows[4, 7], rows[5, 0] = "nan", "", "inf"
    path = write(tmp_path / "a.csv", HEADER, rows)
    recording = load_recording(path)
    kept = np.delete(table, [2, 4, 5], axis=0)
    np.testing.assert_allclose(recording.times, kept[:, 0], atol=1e-12)
    np.testing.assert_allclose(recording.poses, poses_of(kept), atol=1e-12)
    assert recording.notes == ("lines 4, 6-7 (3 rows) left out: a number is missing or not finite.",)
    # with a sample time, a dropped row still takes its time
    rows[5, 0] = 0.0
    expected = 0.1 * np.delete(np.arange(9), [2, 4])
    np.testing.assert_allclose(load_recording(write(path, HEADER, rows), dt=0.1).times, expected)


def test_duplicates_are_dropped(tmp_path: Path, table: np.ndarray) -> None:
    rows = table[[0, 1, 1, 1, 2, 3, 4, 5, 6, 7, 8]]
    recording = load_recording(write(tmp_path / "a.csv", HEADER, rows))
    np.testing.assert_allclose(recording.times, table[:, 0], atol=1e-12)
    assert recording.notes == ("lines 4-5 left out: the previous row is repeated.",)


def test_standstill_is_kept_and_noted_where_it_is_frequent(tmp_path: Path, rng: np.random.Generator) -> None:
    rows = np.column_stack(
        [0.1 * np.arange(40), rng.normal(size=(40, 3)), Rotation.random(40, rng).as_quat()]
    )
    rows[1, 1:] = rows[0, 1:]
    assert load_recording(write(tmp_path / "a.csv", HEADER, rows)).notes == ()
    rows[1::2, 1:] = rows[::2, 1:]
    recording = load_recording(write(tmp_path / "a.csv", HEADER, rows))
    assert len(recording.times) == 40
    (note,) = recording.notes
    assert note.startswith("20 of 40 poses repeat the previous pose exactly: the body rested, or")


def test_quaternions_are_normalised_within_a_hundredth(tmp_path: Path, table: np.ndarray) -> None:
    expected = poses_of(table)
    for scale, notes in ((1 + 1e-6, 0), (1.005, 1), (0.995, 1)):
        rows = table * [1, 1, 1, 1, scale, scale, scale, scale]
        recording = load_recording(write(tmp_path / "a.csv", HEADER, rows))
        np.testing.assert_allclose(recording.poses, expected, rtol=0, atol=1e-12)
        assert len(recording.notes) == notes
    rows = table.copy()
    rows[3, 4:] *= 1.02
    with pytest.raises(RecordingError, match="line 5: expected a quaternion of length 1"):
        load_recording(write(tmp_path / "a.csv", HEADER, rows))
    rows[3, 4:] = 0
    recording = load_recording(write(tmp_path / "a.csv", HEADER, rows))
    np.testing.assert_allclose(recording.times, np.delete(table[:, 0], 3), atol=1e-12)
    (left_out,) = recording.left_out
    assert (left_out.rows.tolist(), left_out.reason) == ([5], "untracked")


def test_matrices_are_made_orthonormal_or_refused(tmp_path: Path, table: np.ndarray) -> None:
    poses, times = poses_of(table), table[:, 0]
    np.savez(tmp_path / "a.npz", times=times, poses=np.round(poses, 3))
    recording = load_recording(tmp_path / "a.npz")
    rotations = recording.poses[:, :3, :3]
    np.testing.assert_allclose(
        rotations.swapaxes(1, 2) @ rotations, np.tile(np.eye(3), (9, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(rotations, poses[:, :3, :3], atol=2e-3)
    assert "rotations were repaired" in recording.notes[0]
    sheared, mirrored, transposed = poses.copy(), poses.copy(), poses.copy()
    sheared[4, 0, 0] += 0.1
    mirrored[4, :3, 0] *= -1
    transposed[4] = transposed[4].T
    for wrong in (sheared, mirrored, transposed):
        np.savez(tmp_path / "a.npz", times=times, poses=wrong)
        with pytest.raises(RecordingError, match="sample 4: expected a pose matrix"):
            load_recording(tmp_path / "a.npz")


# Refusals


@pytest.mark.parametrize(
    ("spoil", "problem"),
    [
        (lambda rows: rows[3].__setitem__(2, "abc"), "line 5: expected numbers: .*'abc'"),
        (lambda rows: rows[3].__setitem__(0, "12:30"), "line 5: expected numbers: .*'12:30'"),
        (lambda rows: rows[8].pop(), "line 10: expected 8 columns, found 7; delete the line"),
        (lambda rows: rows.__delitem__(slice(3, None)), "has 3 usable poses; expected 4"),
        (lambda rows: rows.clear(), "has no rows of numbers; expected a header such as t,x,y,z"),
    ],
)
def test_rows_that_are_refused(
    tmp_path: Path, table: np.ndarray, spoil: Callable[[list[list[object]]], object], problem: str
) -> None:
    rows: list[list[object]] = table.tolist()
    spoil(rows)
    path = tmp_path / "a.csv"
    path.write_text("\n".join([",".join(HEADER), *(",".join(map(str, row)) for row in rows)]))
    with pytest.raises(RecordingError, match=problem) as caught:
        load_recording(path)
    assert str(caught.value).startswith(str(path))


def test_options_are_checked(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="unit must be one of m, cm, mm, not 'inch'"):
        load_recording(tmp_path / "a.csv", unit="inch")  # type: ignore[arg-type]
    for dt in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(RecordingError, match="dt must be a positive number"):
            load_recording(tmp_path / "a.csv", dt=dt)


def test_the_smallest_recording_is_a_calibration() -> None:
    """Four touches suffice for the tip of a tool, and are fewer than a window needs."""
    assert MIN_POSES == MIN_VELOCITIES

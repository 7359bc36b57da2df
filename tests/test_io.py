"""Recordings: every format in and out, and a sentence for everything that is wrong."""

import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from reframe_jax.motion.checks import MIN_VELOCITIES
from reframe_jax.recordings import files as io
from reframe_jax.recordings.files import RecordingError, load_recording, save_recording

DATA = Path(__file__).parents[2] / "shared" / "data"
HEADER = ["t", "x", "y", "z", "qx", "qy", "qz", "qw"]


@pytest.fixture
def table(rng: np.random.Generator) -> np.ndarray:
    """(9, 8): t, x, y, z, qx, qy, qz, qw of a wandering body."""
    times = np.cumsum(rng.uniform(0.02, 0.1, 9))
    return np.column_stack([times, rng.normal(size=(9, 3)), Rotation.random(9, rng).as_quat()])


def write(
    path: Path, header: list[str] | None, rows: np.ndarray | list[list[object]], sep: str = ","
) -> Path:
    lines = [sep.join(str(cell) for cell in row) for row in np.asarray(rows, dtype=object).tolist()]
    path.write_text("\n".join(([sep.join(header)] if header else []) + lines) + "\n")
    return path


def poses_of(table: np.ndarray) -> np.ndarray:
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, 3] = table[:, 1:4]
    poses[:, :3, :3] = Rotation.from_quat(table[:, 4:]).as_matrix()
    return poses


def check(path: Path, table: np.ndarray, **options: object) -> None:
    recording = load_recording(path, **options)  # type: ignore[arg-type]
    np.testing.assert_allclose(recording.times, table[:, 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(recording.poses, poses_of(table), rtol=0, atol=1e-12)
    assert recording.times.dtype == recording.poses.dtype == np.float64
    assert recording.notes == ()


# Formats


@given(order=st.permutations(range(8)), extra=st.integers(0, 8))
def test_columns_come_in_any_order_and_others_are_ignored(
    tmp_path_factory: pytest.TempPathFactory, order: list[int], extra: int
) -> None:
    rng = np.random.default_rng(7)
    table = np.column_stack([np.arange(6) * 0.1, rng.normal(size=(6, 3)), Rotation.random(6, rng).as_quat()])
    rows = np.insert(table[:, order].astype(object), extra, "word", axis=1)
    header = [HEADER[i] for i in order]
    header.insert(extra, "comment")
    check(write(tmp_path_factory.mktemp("io") / "a.csv", header, rows), table)


@pytest.mark.parametrize(
    "header",
    [
        "time,px,py,pz,qx,qy,qz,qw",
        "Timestamp [s],pos_x,pos_y,pos_z,quat_x,quat_y,quat_z,quat_w",
        "stamp,x [m],y [m],z [m],q_x,q_y,q_z,q_w",
        "timestamp,tx,ty,tz,qx,qy,qz,qw",
        "%time,field.pose.position.x,field.pose.position.y,field.pose.position.z,field.pose.orientation.x,"
        "field.pose.orientation.y,field.pose.orientation.z,field.pose.orientation.w",
    ],
)
def test_common_spellings(tmp_path: Path, table: np.ndarray, header: str) -> None:
    check(write(tmp_path / "a.csv", header.split(","), table), table)


def test_scalar_first_quaternions_are_told_by_their_names(tmp_path: Path, table: np.ndarray) -> None:
    rows = table[:, [0, 1, 2, 3, 7, 4, 5, 6]]
    check(write(tmp_path / "a.csv", ["t", "x", "y", "z", "qw", "qx", "qy", "qz"], rows), table)


def test_torques_are_no_positions(tmp_path: Path, table: np.ndarray) -> None:
    wrenches = np.full((9, 6), 5.0)
    names = ["fx", "fy", "fz", "tx", "ty", "tz"]
    check(write(tmp_path / "a.csv", HEADER + names, np.hstack([table, wrenches])), table)
    without = [name for name in HEADER if name not in "xyz"]
    path = write(tmp_path / "b.csv", without + names, np.hstack([table[:, [0, 4, 5, 6, 7]], wrenches]))
    with pytest.raises(RecordingError, match="no column for x, y, z"):
        load_recording(path)


@pytest.mark.parametrize(("letter", "rows"), [("m", 4), ("t", 3)])
def test_matrices_in_columns(tmp_path: Path, table: np.ndarray, letter: str, rows: int) -> None:
    header = ["time", *(f"{letter}{i}{j}" for i in range(rows) for j in range(4))]
    matrices = poses_of(table)[:, :rows].reshape(9, -1)
    check(write(tmp_path / "a.csv", header, np.column_stack([table[:, 0], matrices])), table)


def test_tum_trajectories(tmp_path: Path, table: np.ndarray) -> None:
    path = write(tmp_path / "a.txt", ["# ground truth"], table, sep=" ")
    path.write_text(path.read_text().replace("\n", "  # a remark\n", 3))
    check(path, table)


@pytest.mark.parametrize(("suffix", "sep"), [(".tsv", "\t"), (".csv", ";"), (".csv", ", ")])
def test_separators(tmp_path: Path, table: np.ndarray, suffix: str, sep: str) -> None:
    check(write(tmp_path / f"a{suffix}", HEADER, table, sep), table)


def test_a_header_may_be_a_comment(tmp_path: Path, table: np.ndarray) -> None:
    path = tmp_path / "a.csv"
    np.savetxt(path, table, delimiter=",", header=",".join(HEADER), fmt="%.17g")
    check(path, table)
    path.write_text("# made on a Monday\n\n" + path.read_text().lstrip("# "))
    check(path, table)


def test_arrays(tmp_path: Path, table: np.ndarray) -> None:
    poses, times = poses_of(table), table[:, 0]
    np.save(tmp_path / "a.npy", table)
    check(tmp_path / "a.npy", table)
    np.savez(tmp_path / "a.npz", poses=poses, times=times, other="ignored")
    check(tmp_path / "a.npz", table)
    np.savez(tmp_path / "b.npz", positions=table[:, 1:4], quaternions=table[:, 4:], times=times)
    check(tmp_path / "b.npz", table)
    table[:, 0] = 0.5 * np.arange(9)
    np.save(tmp_path / "b.npy", poses)
    check(tmp_path / "b.npy", table, dt=0.5)
    np.save(tmp_path / "c.npy", table[:, 1:])
    check(tmp_path / "c.npy", table, dt=0.5)


vectors = st.lists(st.floats(-5, 5), min_size=3, max_size=3)


@given(st.lists(st.tuples(st.floats(1e-3, 0.9), vectors, vectors), min_size=5, max_size=8))
def test_round_trip(
    tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[float, list[float], list[float]]]
) -> None:
    folder = tmp_path_factory.mktemp("io")
    times = np.cumsum([row[0] for row in rows])
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, 3] = [row[1] for row in rows]
    poses[:, :3, :3] = Rotation.from_rotvec([row[2] for row in rows]).as_matrix()
    for name in ("a.csv", "a.npz"):
        save_recording(folder / name, times, poses)
        read = load_recording(folder / name)
        np.testing.assert_array_equal(read.times, times)
        np.testing.assert_array_equal(read.poses[:, :, 3], poses[:, :, 3])
        np.testing.assert_allclose(read.poses, poses, rtol=0, atol=1e-14)


@pytest.mark.parametrize("rotvec", [(0, 0, 0), (np.pi, 0, 0), (0, np.pi, 0), (0, 0, np.pi), (2.2, 2.2, 0)])
def test_half_turns_survive_the_csv(tmp_path: Path, rotvec: tuple[float, float, float]) -> None:
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    save_recording(tmp_path / "a.csv", np.arange(5) * 0.1, poses)
    np.testing.assert_allclose(load_recording(tmp_path / "a.csv").poses, poses, rtol=0, atol=1e-14)


# Units and times


@pytest.mark.parametrize(("unit", "scale"), [("m", 1.0), ("cm", 100.0), ("mm", 1000.0)])
def test_units(tmp_path: Path, table: np.ndarray, unit: str, scale: float) -> None:
    rows = table * [1, scale, scale, scale, 1, 1, 1, 1]
    header = ["t", f"x [{unit}]", f"y [{unit}]", f"z [{unit}]", "qx", "qy", "qz", "qw"]
    path = write(tmp_path / "a.csv", header, rows)
    check(path, table, unit=unit)
    if unit != "m":
        with pytest.raises(RecordingError, match=r"no column for x, y, z \(positions in m\)"):
            load_recording(path)


def test_millimetres_are_not_taken_for_metres(tmp_path: Path, table: np.ndarray) -> None:
    path = write(tmp_path / "a.csv", HEADER, table * [1, 1000, 1000, 1000, 1, 1, 1, 1])
    with pytest.raises(RecordingError, match=r"line \d+: lies .* expected less than 20 m.*--unit mm"):
        load_recording(path)


def test_times_since_1970_keep_their_differences(tmp_path: Path, table: np.ndarray) -> None:
    rows = table.astype(object)
    rows[:, 0] = [f"1623456789.{123456789 + 1000003 * k}" for k in range(9)]
    for path in (write(tmp_path / "a.csv", HEADER, rows), write(tmp_path / "a.tum", None, rows, sep=" ")):
        recording = load_recording(path)
        # floats of that size are 2.4e-7 s apart: the difference must be taken before rounding
        np.testing.assert_allclose(recording.times, 1.000003e-3 * np.arange(9), rtol=0, atol=1e-17)
        assert recording.notes == ("times count from the first sample, at 1623456789.123456789 s.",)


def test_times_that_are_not_seconds(tmp_path: Path, table: np.ndarray) -> None:
    step = 1e-9 * np.diff(table[:, 0]).min()
    nanoseconds = np.round(table[:, 0] / 1e-9).astype(np.int64) + 1_623_456_789_000_000_000
    assert step > 0
    np.savez(tmp_path / "a.npz", times=nanoseconds, poses=poses_of(table))
    with pytest.raises(RecordingError, match=r"samples are .* s apart.*ns.*--dt"):
        load_recording(tmp_path / "a.npz")
    table[:, 0] *= 1000
    (note,) = load_recording(write(tmp_path / "a.csv", HEADER, table)).notes
    assert "s apart" in note
    assert "ms" in note


def test_sample_times_are_needed_exactly_where_there_are_none(tmp_path: Path, table: np.ndarray) -> None:
    path = write(tmp_path / "a.csv", HEADER[1:], table[:, 1:])
    with pytest.raises(RecordingError, match=r"has no times.*--dt"):
        load_recording(path)
    np.testing.assert_allclose(load_recording(path, dt=0.25).times, 0.25 * np.arange(9))
    recording = load_recording(write(tmp_path / "b.csv", HEADER, table), dt=0.25)
    np.testing.assert_allclose(recording.times, 0.25 * np.arange(9))
    assert recording.notes == ("the times in the file are ignored, for the sample time of 0.25 s given.",)


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
    assert recording.notes == ("line 4 and 2 more dropped: a number is missing or not finite.",)
    # with a sample time, a dropped row still takes its time
    rows[5, 0] = 0.0
    expected = 0.1 * np.delete(np.arange(9), [2, 4])
    np.testing.assert_allclose(load_recording(write(path, HEADER, rows), dt=0.1).times, expected)


def test_duplicates_are_dropped(tmp_path: Path, table: np.ndarray) -> None:
    rows = table[[0, 1, 1, 1, 2, 3, 4, 5, 6, 7, 8]]
    recording = load_recording(write(tmp_path / "a.csv", HEADER, rows))
    np.testing.assert_allclose(recording.times, table[:, 0], atol=1e-12)
    assert recording.notes == ("line 4 and 1 more dropped: it repeats the row before.",)


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
    assert note.startswith("20 of 40 samples repeat the pose before")


def test_quaternions_are_normalised_within_a_hundredth(tmp_path: Path, table: np.ndarray) -> None:
    expected = poses_of(table)
    for scale, notes in ((1 + 1e-6, 0), (1.005, 1), (0.995, 1)):
        rows = table * [1, 1, 1, 1, scale, scale, scale, scale]
        recording = load_recording(write(tmp_path / "a.csv", HEADER, rows))
        np.testing.assert_allclose(recording.poses, expected, rtol=0, atol=1e-12)
        assert len(recording.notes) == notes
    for factor in (1.02, 0.0):
        rows = table.copy()
        rows[3, 4:] *= factor
        with pytest.raises(RecordingError, match="line 5: expected a quaternion of length 1"):
            load_recording(write(tmp_path / "a.csv", HEADER, rows))


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
        (lambda rows: rows[3].__setitem__(0, rows[2][0]), "line 5: has another pose at the same time"),
        (
            lambda rows: rows[3].__setitem__(0, rows[1][0]),
            "line 5: goes back in time.*expected times to incr",
        ),
        (lambda rows: rows[3].__setitem__(2, "abc"), "line 5: expected numbers: .*'abc'"),
        (lambda rows: rows[3].__setitem__(0, "12:30"), "line 5: expected numbers: .*'12:30'"),
        (lambda rows: rows[8].pop(), "line 10: expected 8 columns, found 7; delete the line"),
        (lambda rows: rows[2].__setitem__(3, 500.0), "line 4: lies 5.* m from the median"),
        (lambda rows: rows.__delitem__(slice(4, None)), "has 4 usable poses; expected 5"),
        (lambda rows: rows.clear(), "has no more than one line of text; expected a header such as t,x,y,z"),
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


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("a.csv", "", "is empty"),
        ("a.csv", "0,0,0,0,0,0,0,1\n1,0,0,0,0,0,0,1\n", "line 1: expected a header"),
        ("a.csv", "t,x,y,z\n0,0,0,0\n", "no column for qx, qy, qz, qw"),
        ("a.csv", "t,time,x,y,z,qx,qy,qz,qw\n0,0,0,0,0,0,0,0,1\n", "columns 't' and 'time' mean the same"),
        ("a.csv", "t,x,px,y,z,qx,qy,qz,qw\n0,0,0,0,0,0,0,0,1\n", "columns 'x' and 'px' mean the same"),
        (
            "a.csv",
            "time_ms,x,y,z,qx,qy,qz,qw\n0,0,0,0,0,0,0,1\n",
            "has no times; name a column t, in seconds",
        ),
        ("a.txt", "", "expected a TUM trajectory"),
        ("a.txt", "t x y z\n0 0 0 0\n", "expected a TUM trajectory"),
        ("a.npy", "no array", "does not hold plain arrays"),
        ("a.npz", "PK\x03\x04cut off", "does not hold plain arrays"),
        ("a.xyz", "", "expected one of .csv, .tsv, .txt, .tum, .npy, .npz"),
    ],
)
def test_files_that_are_refused(tmp_path: Path, name: str, text: str, problem: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(RecordingError, match=problem):
        load_recording(tmp_path / name)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"a\.csv: cannot be read: No such file"):
        load_recording(tmp_path / "a.csv")
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(RecordingError, match="Is a directory"):
        load_recording(tmp_path / "folder.csv")
    (tmp_path / "b.csv").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(RecordingError, match="is not a text file"):
        load_recording(tmp_path / "b.csv")


class _Trap:
    """Raises when it is unpickled."""

    def __reduce__(self) -> tuple[object, ...]:
        return (pytest.fail, ("a pickle was executed",))


def test_pickles_are_never_opened(tmp_path: Path) -> None:
    for name, words in (("a.pkl", "pickles can run code"), ("a.npy", "does not hold plain arrays")):
        (tmp_path / name).write_bytes(pickle.dumps(_Trap()))
        with pytest.raises(RecordingError, match=words):
            load_recording(tmp_path / name)
    np.save(tmp_path / "b.npy", np.array([_Trap()], dtype=object))
    np.savez(tmp_path / "b.npz", poses=np.array([_Trap()], dtype=object))
    for name in ("b.npy", "b.npz"):
        with pytest.raises(RecordingError, match="does not hold plain arrays"):
            load_recording(tmp_path / name)


@pytest.mark.parametrize(
    "arrays",
    [
        {"poses": np.zeros((3, 9, 4, 4))},
        {"poses": np.zeros((9, 5))},
        {"poses": np.array([["a"] * 7])},
        {"poses": np.zeros((0, 4, 4))},
        {"poses": np.zeros((9, 4, 4)), "times": np.zeros(8)},
        {"positions": np.zeros((9, 3)), "quaternions": np.zeros((8, 4))},
        {"positions": np.zeros((9, 3))},
        {"rotations": np.zeros((9, 3, 3))},
    ],
)
def test_arrays_of_other_shapes_are_refused(tmp_path: Path, arrays: dict[str, np.ndarray]) -> None:
    np.savez(tmp_path / "a.npz", **arrays)  # type: ignore[arg-type]
    with pytest.raises(RecordingError, match=r"expected numbers: poses \(N, 4, 4\)"):
        load_recording(tmp_path / "a.npz", dt=0.1)


def test_options_are_checked(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="unit must be one of m, cm, mm, not 'inch'"):
        load_recording(tmp_path / "a.csv", unit="inch")  # type: ignore[arg-type]
    for dt in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(RecordingError, match="dt must be a positive number"):
            load_recording(tmp_path / "a.csv", dt=dt)


def test_what_cannot_be_written_is_refused(tmp_path: Path, table: np.ndarray) -> None:
    times, poses = table[:, 0], poses_of(table)
    with pytest.raises(RecordingError, match=r"expected times \(N,\) and poses"):
        save_recording(tmp_path / "a.csv", times[1:], poses)
    with pytest.raises(RecordingError, match=r"written as \.csv or \.npz, not '\.txt'"):
        save_recording(tmp_path / "a.txt", times, poses)
    with pytest.raises(RecordingError, match=r"none.*cannot be written"):
        save_recording(tmp_path / "none" / "a.csv", times, poses)
    poses[2, 0, 0] = np.nan
    with pytest.raises(RecordingError, match="expected finite times and poses"):
        save_recording(tmp_path / "a.csv", times, poses)
    poses[2, 0, 0] = 7
    with pytest.raises(RecordingError, match="sample 2: expected a pose matrix"):
        save_recording(tmp_path / "a.csv", times, poses)


def test_the_smallest_recording_is_the_smallest_window() -> None:
    assert io._MIN_POSES == MIN_VELOCITIES + 1


@pytest.mark.skipif(not DATA.is_dir(), reason="needs the real recordings, in ../shared/data")
@pytest.mark.parametrize("path", sorted(DATA.glob("*.csv")), ids=lambda path: path.stem)
def test_real_recordings(path: Path) -> None:
    recording = load_recording(path)
    table = np.loadtxt(path, delimiter=",", skiprows=1)[:, :8]
    np.testing.assert_allclose(recording.times, table[:, 0], atol=1e-9)
    np.testing.assert_allclose(recording.poses, poses_of(table), atol=1e-9)
    assert recording.notes == ()

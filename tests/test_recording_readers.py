"""Recordings: every format in, and a sentence for every file that is not in one."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recording_files import HEADER, check, poses_of, write
from scipy.spatial.transform import Rotation

from reframe_jax.recordings.reading import load_recording
from reframe_jax.recordings.recording import RecordingError

DATA = Path(__file__).parents[2] / "shared" / "data"


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


def test_comments_between_rows_are_not_rows(tmp_path: Path, table: np.ndarray) -> None:
    path = write(tmp_path / "a.csv", HEADER, table)
    text = path.read_text().splitlines()
    text.insert(4, "#" + text[3])
    text.insert(2, "% calibrated")
    path.write_text("\n".join(text))
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
    for whole in (poses, poses[:, :3], poses[:, :3].reshape(9, 12), poses.reshape(9, 16)):
        np.save(tmp_path / "b.npy", whole)
        check(tmp_path / "b.npy", table, dt=0.5)
    np.save(tmp_path / "c.npy", table[:, 1:])
    check(tmp_path / "c.npy", table, dt=0.5)


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("a.csv", "", "is empty"),
        ("a.csv", "0,0,0,0,0,0\n1,0,0,0,0,0\n", "line 1: expected a header .*, or rows of 8 numbers"),
        ("a.csv", "t,x,y,z\n0,0,0,0\n", "no column for qx, qy, qz, qw"),
        (
            "a.csv",
            "t,time,x,y,z,qx,qy,qz,qw\n0,0,0,0,0,0,0,0,1\n",
            "columns 't' and 'time' have the same meaning",
        ),
        (
            "a.csv",
            "t,x,px,y,z,qx,qy,qz,qw\n0,0,0,0,0,0,0,0,1\n",
            "columns 'x' and 'px' have the same meaning",
        ),
        ("a.csv", "when,x,y,z,qx,qy,qz,qw\n0,0,0,0,0,0,0,1\n", "has no times; name their column t, or"),
        (
            "a.csv",
            "time [d],x,y,z,qx,qy,qz,qw\n0,0,0,0,0,0,0,1\n",
            "same known unit .such as s, ms, .*: time .d.",
        ),
        ("a.txt", "", "is empty"),
        ("a.txt", "t x y z\n0 0 0 0\n", "no column for qx, qy, qz, qw"),
        ("a.npy", "no array", "expected plain arrays"),
        ("a.npz", "PK\x03\x04cut off", "expected plain arrays"),
        ("a.xyz", "", "expected one of .csv, .tsv, .txt, .tum, "),
    ],
)
def test_files_that_are_refused(tmp_path: Path, name: str, text: str, problem: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(RecordingError, match=problem):
        load_recording(tmp_path / name)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"a\.dat: cannot be read: No such file"):
        load_recording(tmp_path / "a.dat")
    with pytest.raises(RecordingError, match=r"a\.csv: cannot be read: No such file"):
        load_recording(tmp_path / "a.csv")
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(RecordingError, match="Is a directory"):
        load_recording(tmp_path / "folder.csv")
    (tmp_path / "b.csv").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(RecordingError, match="is not a text file"):
        load_recording(tmp_path / "b.csv")


@pytest.mark.parametrize("name", ["a\0.csv", "a\0.npy"])
def test_names_that_no_file_has(tmp_path: Path, name: str) -> None:
    with pytest.raises(RecordingError, match="cannot be read"):
        load_recording(tmp_path / name)


class _Trap:
    """Raises when it is unpickled."""

    def __reduce__(self) -> tuple[object, ...]:
        return (pytest.fail, ("a pickle was executed",))


def test_pickles_are_never_opened(tmp_path: Path) -> None:
    for name in ("a.pkl", "a.npy"):
        (tmp_path / name).write_bytes(pickle.dumps(_Trap()))
        with pytest.raises(RecordingError):
            load_recording(tmp_path / name)
    np.save(tmp_path / "b.npy", np.array([_Trap()], dtype=object))
    np.savez(tmp_path / "b.npz", poses=np.array([_Trap()], dtype=object))
    for name in ("b.npy", "b.npz"):
        with pytest.raises(RecordingError, match="expected plain arrays"):
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


@pytest.mark.skipif(not DATA.is_dir(), reason="needs the real recordings, in ../shared/data")
@pytest.mark.parametrize("path", sorted(DATA.glob("*.csv")), ids=lambda path: path.stem)
def test_real_recordings(path: Path) -> None:
    recording = load_recording(path)
    table = np.loadtxt(path, delimiter=",", skiprows=1)[:, :8]
    np.testing.assert_allclose(recording.times, table[:, 0], atol=1e-9)
    np.testing.assert_allclose(recording.poses, poses_of(table), atol=1e-9)
    assert not recording.left_out
    about = ("the pose jumps ", "rotations were repaired")  # of markers that a camera lost, or rounded
    assert all(note.startswith(about) for note in recording.notes)

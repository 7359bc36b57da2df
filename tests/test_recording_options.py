"""What a user chooses from a file: the registry, the options, wrenches, and the motion of two bodies."""

import argparse
import dataclasses
import inspect
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recording_files import HEADER, check, poses_of, write
from scipy.spatial.transform import Rotation, Slerp

from reframe_jax.cli.reading import add_reading, reading_options
from reframe_jax.recordings.readers import READERS, reader
from reframe_jax.recordings.reading import list_contents, load_recording
from reframe_jax.recordings.recording import Recording, RecordingError
from reframe_jax.recordings.relative import interpolate_poses, relative_poses
from reframe_jax.recordings.selection import Selection

WRENCH = ["fx", "fy", "fz", "tx", "ty", "tz"]


# the registry


def test_readers_use_options_that_exist() -> None:
    names = {field.name for field in dataclasses.fields(Selection)}
    for each in READERS:
        assert each.options <= names
        assert each.name.startswith(("a ", "an ", "arrays "))
        assert each.suffixes


def test_python_and_the_command_line_use_the_same_words() -> None:
    parser = argparse.ArgumentParser()
    add_reading(parser)
    names = set(inspect.signature(load_recording).parameters) - {"path"}
    assert set(reading_options(parser.parse_args([]))) == names
    assert {field.name for field in dataclasses.fields(Selection)} == names - {"dt"}
    given = parser.parse_args(
        ["--from", "map", "--to", "tool", "--in", "b", "--unit", "mm", "--episode", "3"]
    )
    set_ones = {name: value for name, value in reading_options(given).items() if value is not None}
    assert set_ones == {
        **{"from_frame": "map", "to_frame": "tool", "in_body": "b", "unit": "mm", "episode": 3},
    }


def test_options_that_a_format_does_not_use_are_refused(tmp_path: Path, table: np.ndarray) -> None:
    path = write(tmp_path / "a.csv", HEADER, table)
    with pytest.raises(
        RecordingError, match=r"is a table .* does not use topic \(--topic\); .*unit \(--unit\)"
    ):
        load_recording(path, topic="/pose")
    with pytest.raises(RecordingError, match=r"does not use in_body \(--in\)"):
        load_recording(path, in_body="rod")


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"unit": "inch"}, "unit must be one of m, cm, mm, not 'inch'"),
        ({"quaternion": "zyx"}, "quaternion must be one of xyzw, wxyz, not 'zyx'"),
        ({"angles": "XYX"}, "angles must be one of vector, XYZ, .*, not 'XYX'"),
        ({"body": ""}, "body must be a name, not ''"),
        ({"body": 3}, "body must be a name, not 3"),
        ({"episode": -1}, "episode must be a number from 0, not -1"),
        ({"dt": 0.0}, "dt must be a positive number"),
    ],
)
def test_values_that_no_option_has(tmp_path: Path, options: dict[str, object], problem: str) -> None:
    with pytest.raises(RecordingError, match=problem):
        load_recording(tmp_path / "a.csv", **options)  # type: ignore[arg-type]


def test_a_library_that_is_missing_is_named_with_its_extra(tmp_path: Path) -> None:
    with pytest.raises(
        RecordingError, match=r"a\.bag: needs no_library, .*: pip install 'reframe-jax\[bags\]'"
    ):
        reader.import_extra(tmp_path / "a.bag", "no_library.highlevel", "bags")


@pytest.mark.parametrize(
    ("name", "head", "library", "extra"),
    [
        ("a.bag", b"#ROSBAG V2.0\n", "rosbags.rosbag1", "bags"),
        ("a.mcap", b"\x89MCAP0\r\n", "rosbags.rosbag2", "bags"),
        ("a.c3d", b"\x02\x50", "ezc3d", "c3d"),
        ("a.parquet", b"PAR1", "pyarrow.parquet", "parquet"),
        ("a.hdf5", b"\x89HDF\r\n\x1a\n", "h5py", "hdf5"),
    ],
)
def test_libraries_are_imported_when_a_file_needs_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, head: bytes, library: str, extra: str
) -> None:
    (tmp_path / name).write_bytes(head)
    monkeypatch.setitem(sys.modules, library, None)
    for read in (load_recording, list_contents):
        with pytest.raises(RecordingError, match=rf"pip install 'reframe-jax\[{extra}\]'"):
            read(tmp_path / name)


def test_nothing_optional_is_imported_before() -> None:
    code = "import sys, reframe_jax.recordings.reading; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"rosbags", "ezc3d", "pyarrow", "h5py"} & {name.split(".")[0] for name in done.stdout.split()}


def test_what_a_library_raises_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(RecordingError) as caught, reader.translate_errors(tmp_path / "a", "a whole bag"):
        raise KeyError("first\nsecond " + "x" * 1000)
    assert str(caught.value).startswith(f"{tmp_path / 'a'}: expected a whole bag; it cannot be read: ")
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 500
    with pytest.raises(PermissionError), reader.translate_errors(tmp_path / "a", "a whole bag"):
        raise PermissionError(13, "no")


# wrenches


@pytest.mark.parametrize(
    "names",
    [
        WRENCH,
        ["Fx [N]", "Fy [N]", "Fz [N]", "Tx [Nm]", "Ty [Nm]", "Tz [Nm]"],
        [f"wrench.{kind}.{axis}" for kind in ("force", "torque") for axis in "xyz"],
    ],
)
def test_wrenches_are_kept(
    tmp_path: Path, table: np.ndarray, rng: np.random.Generator, names: list[str]
) -> None:
    wrenches = rng.normal(size=(9, 6))
    wrenches[3, 2] = np.nan
    path = write(tmp_path / "a.csv", HEADER + names, np.hstack([table, wrenches]))
    np.testing.assert_array_equal(load_recording(path).wrenches, wrenches)
    np.savez(tmp_path / "a.npz", poses=poses_of(table), times=table[:, 0], wrenches=wrenches)
    np.testing.assert_array_equal(load_recording(tmp_path / "a.npz").wrenches, wrenches)
    check(path, table)


def test_wrenches_stay_with_their_poses(tmp_path: Path, table: np.ndarray) -> None:
    rows = np.hstack([table, np.arange(54.0).reshape(9, 6)])
    rows[4, 1] = np.nan
    path = write(tmp_path / "a.csv", HEADER + WRENCH, rows)
    recording = load_recording(path)
    assert recording.wrenches is not None
    np.testing.assert_array_equal(recording.wrenches, np.delete(rows[:, 8:], 4, axis=0))


def test_wrenches_of_other_shapes_are_refused(tmp_path: Path, table: np.ndarray) -> None:
    np.savez(tmp_path / "a.npz", poses=poses_of(table), wrenches=np.zeros((9, 3)))
    with pytest.raises(RecordingError, match=r"perhaps wrenches \(N, 6\); found .* wrenches \(9, 3\)"):
        load_recording(tmp_path / "a.npz", dt=0.1)


def test_five_columns_are_no_wrench(tmp_path: Path, table: np.ndarray) -> None:
    path = write(tmp_path / "a.csv", HEADER + WRENCH[:5], np.hstack([table, np.zeros((9, 5))]))
    assert load_recording(path).wrenches is None


# two bodies


def walk(rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) that move smoothly: cubic in time."""
    powers = times[:, None] ** np.arange(4)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(powers @ rng.normal(size=(4, 3))).as_matrix()
    poses[:, :3, 3] = powers @ rng.normal(size=(4, 3))
    return poses


def record(times: np.ndarray, poses: np.ndarray, **more: object) -> Recording:
    return Recording(times, poses, Path("a.csv"), **more)  # type: ignore[arg-type]


def test_relative_poses_at_the_same_times(rng: np.random.Generator) -> None:
    times = np.linspace(0, 1, 20)
    a, b = walk(rng, times), walk(rng, times)
    wrenches = rng.normal(size=(20, 6))
    found = relative_poses(
        record(times, a, wrenches=wrenches, notes=("x",)), record(times, b, notes=("x", "y"))
    )
    np.testing.assert_allclose(found.poses, np.linalg.inv(b) @ a, atol=1e-14)
    np.testing.assert_array_equal(found.times, times)
    np.testing.assert_array_equal(found.wrenches, wrenches)
    assert found.notes == ("x", "of the other body: y")


def test_relative_poses_at_other_times(rng: np.random.Generator) -> None:
    """Clocks that count from different origins, and poses between two of the other body."""
    fine, coarse = np.linspace(0.005, 0.985, 50), np.linspace(0, 0.98, 99)
    state = rng.bit_generator.state
    a = walk(rng, fine)
    b = walk(rng, coarse)
    rng.bit_generator.state = state
    walk(rng, fine)
    truth = np.linalg.inv(walk(rng, fine)) @ a
    first = record(fine - 0.25, a, origin="1600000000.250")
    found = relative_poses(first, record(coarse, b, origin="1600000000"))
    inside = fine <= 0.98
    np.testing.assert_allclose(found.poses, truth[inside], atol=1e-3)
    np.testing.assert_array_equal(found.times, first.times[inside])
    assert found.notes == (
        f"{(~inside).sum()} of 50 poses left out: the other body was not tracked at their times.",
    )


def test_interpolation_agrees_with_scipy(rng: np.random.Generator) -> None:
    times = np.cumsum(rng.uniform(0.5, 1.5, 12))
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = Rotation.random(12, rng).as_matrix(), rng.normal(size=(12, 3))
    wanted = np.sort(np.append(rng.uniform(times[0], times[-1], 30), times[[0, 3, 11]]))
    found, known = interpolate_poses(times, poses, wanted)
    assert known.all()
    turned = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(wanted).as_matrix()
    np.testing.assert_allclose(found[:, :3, :3], turned, atol=1e-12)
    for axis in range(3):
        np.testing.assert_allclose(found[:, axis, 3], np.interp(wanted, times, poses[:, axis, 3]), atol=1e-12)
    np.testing.assert_array_equal(found[np.isin(wanted, times)], poses[[0, 3, 11]])


def test_nothing_is_interpolated_across_a_gap(rng: np.random.Generator) -> None:
    times = np.arange(30) * 0.1
    a = record(times, walk(rng, times / 3))
    b = record(np.delete(times, slice(10, 16)), np.delete(a.poses, slice(10, 16), axis=0))
    found = relative_poses(a, b)
    np.testing.assert_array_equal(found.times, b.times)
    np.testing.assert_allclose(found.poses, np.broadcast_to(np.eye(4), found.poses.shape), atol=1e-14)


def test_bodies_that_never_meet(rng: np.random.Generator) -> None:
    times = np.linspace(0, 1, 20)
    a = record(times, walk(rng, times))
    with pytest.raises(RecordingError, match="only 0 of its poses are at times of the other body"):
        relative_poses(a, replace(a, times=times + 5))
    with pytest.raises(RecordingError, match="expected two poses or more of the other body, found 1"):
        relative_poses(a, replace(a, times=times[:1], poses=a.poses[:1]))
    with pytest.raises(RecordingError, match="expected origins that are numbers of seconds, not 'noon'"):
        relative_poses(replace(a, origin="noon"), a)


def test_times_keep_their_origin(tmp_path: Path, table: np.ndarray) -> None:
    late = table.astype(object)
    late[:, 0] = [f"16000000{k:02}.5" for k in range(9)]
    path = write(tmp_path / "a.csv", HEADER, late)
    assert load_recording(path).origin == "1600000000.5"
    assert load_recording(path, dt=0.1).origin is None
    assert load_recording(write(tmp_path / "b.csv", HEADER, table)).origin is None

"""Files in the shapes that trackers, robots and data sets write, and the units and orders they come in."""

import datetime
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from bag_files import POSE, START, TF, Messages, write_bag
from export_files import motive
from recording_files import HEADER, poses_of, write
from scipy.spatial.transform import Rotation
from test_recording_lost import hinge

from reframe_jax.recordings.reading import list_contents, load_recording
from reframe_jax.recordings.recording import Recording, RecordingError

DATA = Path(__file__).parents[2] / "shared" / "data" / "cases"
NS = 1403715524907143168  # as EuRoC counts
STEP = 20_000_000  # ns


@pytest.fixture
def rows(rng: np.random.Generator) -> np.ndarray:
    """(60, 8) t, x, y, z, qx, qy, qz, qw of a hinge."""
    return hinge(rng, count=60)


def same(recording: Recording, rows: np.ndarray, atol: float = 1e-9) -> None:
    np.testing.assert_allclose(recording.poses, poses_of(rows), atol=atol)
    np.testing.assert_allclose(recording.times, rows[:, 0] - rows[0, 0], atol=1e-6)
    assert not any("quaternion" in note or "jumps" in note for note in recording.notes), recording.notes


def stamps(rows: np.ndarray) -> list[str]:
    return [str(NS + k * STEP) for k in range(len(rows))]


def text(path: Path, header: str, cells: Any, sep: str = ",") -> Path:
    lines = [sep.join(map(str, row)) for row in cells]
    path.write_text("\n".join([*([header] if header else []), *lines]) + "\n")
    return path


# data sets


@pytest.mark.parametrize("more", [0, 9])
def test_euroc(tmp_path: Path, rows: np.ndarray, more: int) -> None:
    """And TUM-VI: nanoseconds, w first; EuRoC adds velocities and biases."""
    header = "#timestamp [ns], " + ", ".join(f"p_RS_R_{axis} [m]" for axis in "xyz")
    header += "".join(f", q_RS_{axis} []" for axis in "wxyz")
    names = [
        f"{name}_{axis} [{unit}]"
        for name, unit in (("v_RS_R", "m s^-1"), ("b_w_RS_S", "rad s^-1"))
        for axis in "xyz"
    ]
    names += [f"b_a_RS_S_{axis} [m s^-2]" for axis in "xyz"]
    header += "".join(f", {name}" for name in names[:more])
    numbers = np.column_stack([rows[:, [1, 2, 3, 7, 4, 5, 6]], np.zeros((len(rows), more))])
    cells = [[stamp, *row] for stamp, row in zip(stamps(rows), numbers, strict=True)]
    for name in ("data.csv", "data.txt"):
        recording = load_recording(text(tmp_path / name, header, cells))
        same(recording, rows)
        assert recording.origin == "1403715524.907143168"
    without = load_recording(text(tmp_path / "a.csv", header.replace(" [ns]", ""), cells))
    same(without, rows)  # EuRoC itself states no unit of time
    assert without.origin == "1403715524.907143168"


@pytest.mark.parametrize("width", [12, 16])
@pytest.mark.parametrize("name", ["00.txt", "00.csv"])
def test_kitti(tmp_path: Path, rows: np.ndarray, width: int, name: str) -> None:
    sep = "," if name.endswith("csv") else " "
    numbers = poses_of(rows).reshape(len(rows), 16)[:, :width]
    path = text(tmp_path / name, "", numbers, sep)
    with pytest.raises(RecordingError, match=r"has no times; KITTI .*, dt \(--dt\)"):
        load_recording(path)
    same(load_recording(path, dt=0.02), rows)
    kept = np.delete(np.arange(60), [4, 5])
    numbered = np.column_stack([kept, numbers[kept]]).astype(object)
    numbered[:, 0] = kept  # KITTI-360: the number of the frame
    same(load_recording(text(path, "", numbered, sep), dt=0.02), rows[kept])
    timed = np.column_stack([rows[:, 0], numbers])
    same(load_recording(text(path, "", timed, sep)), rows)


@pytest.mark.parametrize("name", ["a.csv", "a.txt", "a.tum", "a.tsv"])
@pytest.mark.parametrize("sep", [",", ", ", " ", ";", "\t"])
def test_tum_between_any_marks_and_of_any_suffix(
    tmp_path: Path, rows: np.ndarray, name: str, sep: str
) -> None:
    path = text(tmp_path / name, "", rows, sep)
    same(load_recording(path), rows)
    same(load_recording(text(path, "# ground truth, of today", rows, sep)), rows)
    same(load_recording(text(path, "# timestamp tx ty tz qx qy qz qw", rows, sep)), rows)
    same(load_recording(text(path, "", rows[:, 1:], sep), dt=0.02), rows)


@pytest.mark.parametrize("name", ["a.txt", "a.tum", "a.csv"])
@pytest.mark.parametrize("sep", [",", " ", "\t"])
def test_tables_of_any_suffix(tmp_path: Path, rows: np.ndarray, name: str, sep: str) -> None:
    same(load_recording(text(tmp_path / name, sep.join(HEADER), rows, sep)), rows)


def test_decimal_commas(tmp_path: Path, rows: np.ndarray) -> None:
    cells = [[f"{value:.9f}".replace(".", ",") for value in row] for row in rows]
    for header in (";".join(HEADER), "sep=;\n" + ";".join(HEADER), ""):
        same(load_recording(text(tmp_path / "a.csv", header, cells, ";")), rows)
    same(load_recording(text(tmp_path / "a.tsv", "\t".join(HEADER), cells, "\t")), rows)
    cells[0][0] = "0"
    for header in (" ".join(HEADER), ""):
        same(load_recording(text(tmp_path / "a.txt", header, cells, "  ")), rows)


# robots


@pytest.mark.parametrize("kind", ["pose", "odometry", "transform"])
def test_rostopic_echo(tmp_path: Path, rows: np.ndarray, kind: str) -> None:
    """Nanoseconds in two columns: when a message came, and the stamp of its header, which counts."""
    path, turn = {
        "pose": ("pose.position", "pose.orientation"),
        "odometry": ("pose.pose.position", "pose.pose.orientation"),
        "transform": ("transform.translation", "transform.rotation"),
    }[kind]
    header = ["%time", "field.header.seq", "field.header.stamp", "field.header.frame_id"]
    header += [f"field.{path}.{axis}" for axis in "xyz"] + [f"field.{turn}.{axis}" for axis in "xyzw"]
    header += [f"field.pose.covariance{k}" for k in range(36)] + [
        f"field.twist.twist.linear.{a}" for a in "xyz"
    ]
    late = [str(int(stamp) + 3_000_000 + 1000 * k * k) for k, stamp in enumerate(stamps(rows))]
    cells = [
        [came, k, stamp, "map", *row[1:], *([0.0] * 39)]
        for k, (came, stamp, row) in enumerate(zip(late, stamps(rows), rows, strict=True))
    ]
    recording = load_recording(text(tmp_path / "a.csv", ",".join(header), cells))
    same(recording, rows)
    assert recording.origin == "1403715524.907143168"


def test_rostopic_echo_of_several_poses(tmp_path: Path, rows: np.ndarray) -> None:
    header = ["%time", "field.header.stamp"]
    for k in range(2):
        header += [f"field.poses{k}.position.{axis}" for axis in "xyz"]
        header += [f"field.poses{k}.orientation.{axis}" for axis in "xyzw"]
    cells = [
        [stamp, stamp, *row[1:], *other[1:]]
        for stamp, row, other in zip(stamps(rows), rows, rows[::-1], strict=True)
    ]
    path = text(tmp_path / "a.csv", ",".join(header), cells)
    with pytest.raises(RecordingError, match=r"have the same meaning; select one .*body \(--body\)"):
        load_recording(path)
    for body in ("field.poses0", "poses0", "0"):
        same(load_recording(path, body=body), rows)


def test_rows_of_units_and_headers_again(tmp_path: Path, rows: np.ndarray) -> None:
    """As programs write units below the names, and as files that were joined repeat the header."""
    cells = (rows * [1000, 100, 100, 100, 1, 1, 1, 1]).tolist()
    for units in (["ms", "cm", "cm", "cm", "", "", "", ""], ["[ms]", *["[cm]"] * 3, *["[-]"] * 4]):
        same(load_recording(text(tmp_path / "a.csv", ",".join(HEADER), [units, *cells])), rows)
    joined = [*rows[:30].tolist(), HEADER, *rows[30:].tolist()]
    same(load_recording(text(tmp_path / "a.csv", ",".join(HEADER), joined)), rows)


def test_numbers_as_spreadsheets_and_typesetters_write_them(tmp_path: Path, rows: np.ndarray) -> None:
    cells = [[f'"{value:.9f}"'.replace(".", ",") for value in row] for row in rows]
    same(load_recording(text(tmp_path / "a.csv", ",".join(HEADER), cells)), rows)
    cells = [[f"{value:.9f}".replace("-", "\u2212") for value in row] for row in rows]
    same(load_recording(text(tmp_path / "b.csv", ",".join(HEADER), cells)), rows)


def test_a_scalar_called_rw(tmp_path: Path, rows: np.ndarray) -> None:
    for header in ("t,tx,ty,tz,rx,ry,rz,rw", "time,location_x,location_y,location_z,rx,ry,rz,rw"):
        same(load_recording(text(tmp_path / "a.csv", header, rows)), rows)


def test_frames_are_counted(tmp_path: Path, rows: np.ndarray) -> None:
    cells = [[100 + k, *row[1:]] for k, row in enumerate(rows) if not 20 <= k < 30]
    path = text(tmp_path / "a.csv", ",".join(["frame", *HEADER[1:]]), cells)
    with pytest.raises(RecordingError, match="has no times; name their column t"):
        load_recording(path)
    same(load_recording(path, dt=0.02), np.delete(rows, range(20, 30), axis=0))


def test_rostopic_echo_of_tf(tmp_path: Path, rows: np.ndarray) -> None:
    names = [f"translation.{axis}" for axis in "xyz"] + [f"rotation.{axis}" for axis in "xyzw"]
    header = [
        "%time",
        "field.transforms0.header.stamp",
        *(f"field.transforms0.transform.{name}" for name in names),
    ]
    cells = [[int(stamp) + 7000, stamp, *row[1:]] for stamp, row in zip(stamps(rows), rows, strict=True)]
    same(load_recording(text(tmp_path / "a.csv", ",".join(header), cells)), rows)


def test_a_file_of_positions_alone_says_what_is_missing(tmp_path: Path, rows: np.ndarray) -> None:
    header = "#timestamp [ns], " + ", ".join(f"p_RS_R_{axis} [m]" for axis in "xyz")
    cells = [[stamp, *row[1:4]] for stamp, row in zip(stamps(rows), rows, strict=True)]
    with pytest.raises(RecordingError, match="no column for qx, qy, qz, qw"):
        load_recording(text(tmp_path / "a.csv", header, cells))


def test_dates_as_times(tmp_path: Path, rows: np.ndarray) -> None:
    start = datetime.datetime(2024, 2, 29, 23, 59, 59, 900_000)
    steps = [datetime.timedelta(seconds=float(time)) for time in rows[:, 0]]
    cells = [[str(start + step), *row[1:]] for step, row in zip(steps, rows, strict=True)]
    recording = load_recording(text(tmp_path / "a.csv", ",".join(HEADER), cells))
    same(recording, rows)
    assert recording.origin == "1709251199.900000"
    for name in ("date", "DateTime"):
        same(load_recording(text(tmp_path / "a.csv", ",".join([name, *HEADER[1:]]), cells)), rows)
    days = [["2024-02-29", *row] for row in rows]
    same(load_recording(text(tmp_path / "a.csv", ",".join(["Date", "Seconds", *HEADER[1:]]), days)), rows)
    with pytest.raises(RecordingError, match="found '2024-02-29'; write times in seconds, or as 2024-05-01"):
        load_recording(
            text(tmp_path / "a.csv", ",".join(["Date", *HEADER[1:]]), [day[:1] + day[2:] for day in days])
        )


def test_seconds_and_nanoseconds(tmp_path: Path, rows: np.ndarray) -> None:
    header = "header.stamp.sec,header.stamp.nanosec," + ",".join(HEADER[1:])
    cells = [
        [int(stamp) // 10**9, int(stamp) % 10**9, *row[1:]]
        for stamp, row in zip(stamps(rows), rows, strict=True)
    ]
    same(load_recording(text(tmp_path / "a.csv", header, cells)), rows)
    header = "#sec nsec " + " ".join(HEADER[1:])
    same(load_recording(text(tmp_path / "a.txt", header, cells, " ")), rows)


def test_units_after_blanks(tmp_path: Path, rows: np.ndarray) -> None:
    header = "#timestamp [ns] p_RS_R_x [m] p_RS_R_y [m] p_RS_R_z [m] q_RS_w [] q_RS_x [] q_RS_y [] q_RS_z []"
    cells = [[stamp, *row[[1, 2, 3, 7, 4, 5, 6]]] for stamp, row in zip(stamps(rows), rows, strict=True)]
    same(load_recording(text(tmp_path / "a.txt", header, cells, " ")), rows)


@pytest.mark.parametrize("first", [0, 1])
def test_rotations_by_their_elements(tmp_path: Path, rows: np.ndarray, first: int) -> None:
    numbers = np.column_stack([rows[:, 0], poses_of(rows)[:, :3].reshape(-1, 12)])
    header = "t," + ",".join(
        f"r{first + i}{first + j}" if j < 3 else f"t{'xyz'[i]}" for i in range(3) for j in range(4)
    )
    same(load_recording(text(tmp_path / "a.csv", header, numbers)), rows)


def test_stamps_that_nobody_set_in_rostopic_echo(tmp_path: Path, rows: np.ndarray) -> None:
    header = "%time,field.header.stamp," + ",".join(
        [*(f"field.pose.position.{axis}" for axis in "xyz"), *(f"field.pose.orientation.{a}" for a in "xyzw")]
    )
    cells = [[stamp, 0, *row[1:]] for stamp, row in zip(stamps(rows), rows, strict=True)]
    same(load_recording(text(tmp_path / "a.csv", header, cells)), rows)


def test_times_that_are_all_zero_were_never_set(tmp_path: Path, rows: np.ndarray) -> None:
    path = text(tmp_path / "a.csv", "", [[0, 0, "map", *row[1:]] for row in rows])
    with pytest.raises(RecordingError, match=r"all times are 0 .* sample time, dt \(--dt\)"):
        load_recording(path)
    same(load_recording(path, dt=0.02), rows)


@pytest.mark.parametrize("row", [0, 5, 59])
def test_a_clock_that_was_not_set_in_a_row(tmp_path: Path, rows: np.ndarray, row: int) -> None:
    rows[:, 0] += 1.7e9
    rows[row, 0] = 0
    np.savez(tmp_path / "a.npz", times=rows[:, 0], positions=rows[:, 1:4], quaternions=rows[:, 4:])
    for path in (write(tmp_path / "a.csv", HEADER, rows), tmp_path / "a.npz"):
        recording = load_recording(path)
        same(recording, np.delete(rows, row, axis=0))
        assert any("their time is 0, so the clock was not set" in note for note in recording.notes)
    rows[:, 0] = 1.7e9
    with pytest.raises(RecordingError, match=r"all times are 1700000000.0 .* sample time, dt \(--dt\)"):
        load_recording(write(tmp_path / "a.csv", HEADER, rows))


def test_numbers_in_another_order_are_no_lost_tracking(tmp_path: Path, rows: np.ndarray) -> None:
    by_column = poses_of(rows).swapaxes(1, 2).reshape(-1, 16)
    with pytest.raises(RecordingError, match=r"also in 59 of the other 59 rows: .* another order") as caught:
        load_recording(text(tmp_path / "a.txt", "", by_column, " "), dt=0.02)
    assert "delete" not in str(caught.value)


@pytest.mark.parametrize("frames", [["map"], ["map", "tool"]])
def test_ros2_topic_echo(tmp_path: Path, rows: np.ndarray, frames: list[str]) -> None:
    cells = [
        [int(stamp) // 10**9, int(stamp) % 10**9, *frames, *row[1:], *([0.0] * 36)]
        for stamp, row in zip(stamps(rows), rows, strict=True)
    ]
    same(load_recording(text(tmp_path / "a.csv", "", cells)), rows)


def test_columns_of_a_table_that_the_user_names(tmp_path: Path, rows: np.ndarray) -> None:
    path = text(tmp_path / "a.csv", "t,tcp.a,tcp.b,tcp.c,s,i,j,k", rows[:, [0, 1, 2, 3, 7, 4, 5, 6]])
    with pytest.raises(RecordingError, match="no column for x, y, z, qx"):
        load_recording(path)
    options: dict[str, Any] = {"position": "tcp.a,tcp.b,tcp.c", "orientation": "s,i,j,k"}
    with pytest.raises(
        RecordingError, match=r"the meaning of the 4 numbers of an orientation; give quaternion"
    ):
        load_recording(path, **options)
    same(load_recording(path, **options, quaternion="wxyz"), rows)
    angles = Rotation.from_quat(rows[:, 4:]).as_euler("ZYX", degrees=True)
    path = text(path, "t,X1,Y1,Z1,A,B,C", np.column_stack([rows[:, :4], angles]))  # as KUKA has them
    options = {"position": "X1,Y1,Z1", "orientation": "A,B,C", "angles": "ZYX", "angle_unit": "deg"}
    same(load_recording(path, **options), rows)


def test_tables_of_several_poses(tmp_path: Path, rows: np.ndarray) -> None:
    names = [f"{body}_{name}" for body in ("tool", "door") for name in HEADER[1:]]
    path = text(tmp_path / "a.csv", ",".join(["t", *names]), np.hstack([rows, rows[::-1, 1:]]))
    with pytest.raises(
        RecordingError, match=r"several poses in a row; select one, body \(--body\): door, tool"
    ):
        load_recording(path)
    same(load_recording(path, body="tool"), rows)


@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
def test_arrays_of_poses(tmp_path: Path, rows: np.ndarray, name: str) -> None:
    messages, kind = Messages(name), "geometry_msgs/msg/PoseArray"
    poses = poses_of(rows)
    for count in (1, 2):
        samples = []
        for k, pose in enumerate(poses):
            stamp = START + k * STEP
            plain = [messages.pose(POSE, stamp, each).pose for each in (pose, poses[-1 - k])[:count]]
            header = messages.header(stamp, "map")
            samples.append(("/a", kind, messages.make(kind, header=header, poses=plain), stamp))
        folder = tmp_path / str(count)
        folder.mkdir()
        path = write_bag(folder, name, samples)
        if count == 2:
            with pytest.raises(
                RecordingError, match=r"arrays of 2 poses; give the number .*\(--body\), from 0 to 1"
            ):
                load_recording(path)
            same(load_recording(path, body="1"), np.column_stack([rows[:, :1], rows[::-1, 1:]]))
            with pytest.raises(RecordingError, match=r"give the number of one, body \(--body\), from 0 to 1"):
                load_recording(path, body="2")
        same(load_recording(path, body="0" if count == 2 else None), rows)


def test_arrays_without_a_pose_are_left_out(tmp_path: Path, rows: np.ndarray) -> None:
    messages, kind, samples = Messages("a.mcap"), "geometry_msgs/msg/PoseArray", []
    for k, pose in enumerate(poses_of(rows)):
        stamp = START + k * STEP
        plain = [] if 20 <= k < 25 else [messages.pose(POSE, stamp, pose).pose]
        header = messages.header(0 if k == 40 else stamp, "map")
        samples.append(("/a", kind, messages.make(kind, header=header, poses=plain), stamp))
    recording = load_recording(write_bag(tmp_path, "a.mcap", samples))
    gone = [40, *range(20, 25)]
    np.testing.assert_allclose(recording.poses, poses_of(np.delete(rows, gone, axis=0)), atol=1e-9)
    assert [row for each in recording.left_out for row in each.rows] == gone
    assert recording.left_out[0].why == "their stamp is 0"


@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
@pytest.mark.parametrize(
    ("stamp", "words"),
    [(None, "most messages"), (0, "most messages"), (START, "all messages have the same stamp")],
)
def test_poses_without_stamps_have_the_time_of_their_recording(
    tmp_path: Path, rows: np.ndarray, name: str, stamp: int | None, words: str
) -> None:
    messages = Messages(name)
    samples = []
    for k, pose in enumerate(poses_of(rows)):
        message = messages.pose(POSE, stamp or 0, pose)
        kind = "geometry_msgs/msg/Pose" if stamp is None else POSE
        samples.append(("/a", kind, message.pose if stamp is None else message, START + k * STEP))
    recording = load_recording(write_bag(tmp_path, name, samples))
    same(recording, rows)
    assert recording.notes[0].startswith(words)
    assert recording.notes[0].endswith(": the times are those at which the messages were recorded.")


def test_a_tf_frame_that_was_lost(tmp_path: Path, rows: np.ndarray) -> None:
    """The identity in one edge of a chain is no constant in the pose of the chain."""
    messages, samples = Messages("a.mcap"), []
    lost, poses = range(20, 30), poses_of(rows)
    base = np.eye(4)
    for k, pose in enumerate(poses):
        stamp = START + k * STEP
        base[:3, 3] = [0.01 * k, 0.3, 0.1]
        edges = [
            ("map", "base", base),
            ("base", "tool", np.eye(4) if k in lost else np.linalg.inv(base) @ pose),
        ]
        samples.append(("/tf", TF, messages.tf(stamp, edges), stamp))
    recording = load_recording(write_bag(tmp_path, "a.mcap", samples), from_frame="map", to_frame="tool")
    np.testing.assert_allclose(recording.poses, poses_of(np.delete(rows, lost, axis=0)), atol=1e-9)
    assert any("messages 20-29 (10 rows) left out, as tracking was lost" in note for note in recording.notes)


# motion capture


def test_motive_from_a_spreadsheet(tmp_path: Path, rows: np.ndarray) -> None:
    """Semicolons, decimal commas, and every line as long as the longest."""
    for rotation in ("Quaternion", "XYZ"):
        lines = motive({"Rod": poses_of(rows)}, rate=50, rotation=rotation, lost=(3,)).splitlines()
        wide = max(line.count(",") for line in lines)
        lines = [line + "," * (wide - line.count(",")) for line in lines]
        saved = [line.replace(",", ";").replace(".", ",") for line in lines]
        saved[0] = saved[0].replace("Take 2024", "Türgriff 2024")
        for first, encoding in (("", "utf-8-sig"), ("", "cp1252"), ("", "utf-16"), ("sep=;\r\n", "utf-8")):
            (tmp_path / "a.csv").write_bytes((first + "\r\n".join(saved)).encode(encoding))
            recording = load_recording(tmp_path / "a.csv")
            same(recording, np.delete(rows, 3, axis=0), atol=1e-7)
            assert recording.left_out[0].reason == "missing"


def test_motive_without_markers_ends_with_a_column_without_an_axis(tmp_path: Path, rows: np.ndarray) -> None:
    lines = motive({"Rod": poses_of(rows)}, rate=50).splitlines()
    (tmp_path / "a.csv").write_text("\n".join(",".join(line.split(",")[:10]) for line in lines[1:]))
    first = lines[0] + "\n"
    (tmp_path / "a.csv").write_text(first + (tmp_path / "a.csv").read_text())
    same(load_recording(tmp_path / "a.csv"), rows, atol=1e-7)


def trc(points: np.ndarray, labels: list[str], unit: str = "mm", rate: float = 50) -> str:
    """Markers (N, M, 3) as OpenSim has them."""
    count = len(points)
    axes = [f"{axis}{k + 1}" for k in range(len(labels)) for axis in "XYZ"]
    lines = [
        "PathFileType\t4\t(X/Y/Z)\ttrial.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate:.2f}\t{rate:.2f}\t{count}\t{len(labels)}\t{unit}\t{rate:.2f}\t1\t{count}",
        "Frame#\tTime\t" + "\t\t\t".join(labels) + "\t\t",
        "\t\t" + "\t".join(axes),
        "",
    ]
    for k, row in enumerate(points.reshape(count, -1)):
        cells = ["" if np.isnan(value) else f"{value:.9f}" for value in row]
        lines.append("\t".join([str(k + 1), f"{k / rate:.6f}", *cells]))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(("unit", "scale"), [("mm", 1e3), ("m", 1.0), ("Meters", 1.0)])
def test_trc(tmp_path: Path, rows: np.ndarray, unit: str, scale: float) -> None:
    marks = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.08, 0], [0, 0, 0.06]])
    poses = poses_of(rows)
    points = np.einsum("nij,kj->nki", poses[:, :3, :3], marks) + poses[:, None, :3, 3]
    still = np.broadcast_to([[1, 0, 0], [1, 1, 0], [2, 0, 1.0]], (60, 3, 3))
    points = scale * np.concatenate([points, still], axis=1)
    points[7, 1] = np.nan
    labels = ["rod1", "rod2", "rod3", "rod4", "LASI", "RASI", "SACR"]
    path = tmp_path / "a.trc"
    path.write_text(trc(points, labels, unit))
    first = np.eye(4)
    first[:3, 3] = (poses[0, :3, :3] @ marks.mean(axis=0)) + poses[0, :3, 3]
    own = np.linalg.inv(poses[0]) @ first  # the frame of the markers in that of the body
    recording = load_recording(path, body="rod")
    np.testing.assert_allclose(recording.poses, poses @ own, atol=1e-6)
    np.testing.assert_allclose(recording.times, rows[:, 0], atol=1e-6)
    assert load_recording(path, body="rod1,rod2,rod4").poses.shape == (59, 4, 4)
    entries = list_contents(path)[1]
    assert entries is not None
    assert [(entry.option, entry.name) for entry in entries] == [("body", "rod"), ("body", "LASI,RASI,SACR")]
    relative = load_recording(path, body="rod", in_body="LASI,RASI,SACR")
    assert relative.poses.shape == (60, 4, 4)
    with pytest.raises(
        RecordingError, match=r"has no body 'leg'; name a prefix .*\(--body\); prefixes: rod; "
    ):
        load_recording(path, body="leg")
    with pytest.raises(RecordingError, match=r"states another unit than cm; leave out unit \(--unit\)"):
        load_recording(path, body="rod", unit="cm")
    path.write_text(trc(points[:, 4:], labels[4:], unit).replace("\t", "  "))  # between blanks
    assert load_recording(path, body="LASI,RASI,SACR").poses.shape == (60, 4, 4)
    path.write_text(trc(points[:, 4:], labels[4:], unit=""))
    with pytest.raises(RecordingError, match=r"does not state its unit; give unit \(--unit\)"):
        load_recording(path)
    assert load_recording(path, unit="m").poses.shape == (60, 4, 4)
    path.write_text(trc(points[:, 4:], labels[4:], unit).replace("Units", "Unit"))
    with pytest.raises(RecordingError, match="expected the header of a TRC file"):
        load_recording(path)


def test_plus(tmp_path: Path, rows: np.ndarray) -> None:
    """Transforms in mm between lines on images, which follow as bytes."""
    lines = ["ObjectType = Image", "NDims = 3", "DimSize = 4 4 60", "ElementType = MET_UCHAR"]
    for k, pose in enumerate(poses_of(rows)):
        scaled = pose.copy()
        scaled[:3, 3] *= 1000
        for name, matrix in (("ProbeToTracker", scaled), ("ReferenceToTracker", np.eye(4))):
            numbers = " ".join(map(repr, matrix.ravel().tolist()))
            lost = name == "ProbeToTracker" and k in (4, 5)
            lines.append(f"Seq_Frame{k:04d}_{name}Transform = {numbers}")
            lines.append(f"Seq_Frame{k:04d}_{name}TransformStatus = {'INVALID' if lost else 'OK'}")
        lines += [
            f"Seq_Frame{k:04d}_Timestamp = {12.5 + rows[k, 0]:.6f}",
            f"Seq_Frame{k:04d}_ImageStatus = OK",
        ]
    path = tmp_path / "a.mha"
    path.write_bytes("\n".join([*lines, "ElementDataFile = LOCAL", ""]).encode() + bytes(range(256)) * 8)
    kept = np.delete(rows, [4, 5], axis=0)
    recording = load_recording(path, body="ProbeToTracker")
    same_from_start = np.column_stack([kept[:, 0] + 12.5, kept[:, 1:]])
    np.testing.assert_allclose(recording.times, same_from_start[:, 0], atol=1e-6)
    np.testing.assert_allclose(recording.poses, poses_of(kept), atol=1e-9)
    assert (recording.left_out[0].rows.tolist(), recording.left_out[0].reason) == ([4, 5], "untracked")
    with pytest.raises(
        RecordingError, match=r"several transforms; name one, body .*: ProbeToTracker, Reference"
    ):
        load_recording(path)
    relative = load_recording(path, body="ProbeToTracker", in_body="ReferenceToTracker")
    np.testing.assert_allclose(relative.poses, poses_of(kept), atol=1e-9)
    path.write_text("\n".join(lines[:8]).replace("0.0 0.0 0.0 1.0", "0.0 0.0 1.0"))
    with pytest.raises(RecordingError, match="expected the 16 numbers of a transform"):
        load_recording(path, body="ProbeToTracker")


@pytest.mark.parametrize("times", ["timespec", "frames"])
def test_ndi(tmp_path: Path, rows: np.ndarray, times: str) -> None:
    stamp = ",timespec_s,timespec_ns" if times == "timespec" else ""
    block = f",ToolInfo,Frame#,PortHandle,Face#{stamp},TransformStatus,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error,#Markers"
    header = "ToolCount" + block + ",Marker0.Status,Tx,Ty,Tz" + block.replace(stamp, "")
    cells = []
    for k, row in enumerate(rows):
        numbers = [row[7], *row[4:7], *(1000 * row[1:4])]
        state = "Missing" if k == 9 else "Enabled"
        clock = [NS // 10**9, NS % 10**9 // 1000 * 1000 + k * STEP] if times == "timespec" else []
        if clock:
            clock = [clock[0] + clock[1] // 10**9, clock[1] % 10**9]
        shown = [""] * 7 if k == 9 else numbers
        tool = ["", 100 + k, "0A", 0, *clock, state, *shown, 0.1, 4]
        other = ["", 100 + k, "0B", 0, "OK", 1, 0, 0, 0, 10, 20, -1500, 0.1, 4]
        cells.append([2, *tool, "OK", 1, 2, 3, *other])
    path = text(tmp_path / "a.csv", header, cells)
    kept = np.delete(rows, 9, axis=0)
    options: dict[str, Any] = {} if times == "timespec" else {"dt": 0.02}
    recording = load_recording(path, body="0A", **options)
    same(recording, kept)
    assert recording.left_out[0].rows.tolist() == [11]
    assert any("mm, as NDI writes" in note for note in recording.notes)
    with pytest.raises(RecordingError, match=r"several tools; name one, body .*: 0A, 0B"):
        load_recording(path, **options)


def test_ndi_with_a_row_for_every_tool(tmp_path: Path, rows: np.ndarray) -> None:
    cells = []
    for k, row in enumerate(rows):
        numbers = [row[7], *row[4:7], *(1000 * row[1:4])]
        cells.append([100 + k, "0A", "OK", *(["-3.697314e28"] * 7 if k == 9 else numbers), 0.1])
        cells.append([100 + k, "0B", "OK", 1, 0, 0, 0, 10, 20, -1500, 0.1])
    header = "Frame#,ToolHandle,TransformStatus,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error"
    path = text(tmp_path / "a.csv", header, cells)
    same(load_recording(path, body="0A", dt=0.02), np.delete(rows, 9, axis=0))
    with pytest.raises(RecordingError, match=r"several tools; name one, body .*: 0A, 0B"):
        load_recording(path, dt=0.02)


@pytest.mark.parametrize("word", ["null", "N/A", "--", "---", "?", "*", "invalid", "Occluded", "NaN", ""])
def test_words_for_missing_numbers(tmp_path: Path, rows: np.ndarray, word: str) -> None:
    cells = rows.astype(object)
    cells[5, 1:] = word
    recording = load_recording(write(tmp_path / "a.csv", HEADER, cells))
    same(recording, np.delete(rows, 5, axis=0))
    assert recording.left_out[0].reason == "missing"


def test_a_scalar_called_q0(tmp_path: Path, rows: np.ndarray) -> None:
    numbers = rows[:, [0, 7, 4, 5, 6, 1, 2, 3]]
    same(load_recording(text(tmp_path / "a.csv", "t,Q0,Qx,Qy,Qz,Tx,Ty,Tz", numbers)), rows)
    path = text(tmp_path / "b.csv", "t,q0,q1,q2,q3,x,y,z", numbers)
    with pytest.raises(RecordingError, match=r"does not state the order of q0, q1, q2, q3; give quaternion"):
        load_recording(path)
    same(load_recording(path, quaternion="wxyz"), rows)
    path = text(tmp_path / "b.csv", "t,q1,q2,q3,q4,x,y,z", numbers)
    with pytest.raises(RecordingError, match=r"does not state the order of q1, q2, q3, q4; give quaternion"):
        load_recording(path)
    same(load_recording(path, quaternion="wxyz"), rows)


# units


@pytest.mark.parametrize(("unit", "per"), [("min", 1 / 60), ("h", 1 / 3600)])
def test_minutes_and_hours(tmp_path: Path, rows: np.ndarray, unit: str, per: float) -> None:
    cells = rows * [per, *[1] * 7]
    same(load_recording(write(tmp_path / "a.csv", [f"t [{unit}]", *HEADER[1:]], cells)), rows)
    path = write(tmp_path / "a.tum", None, cells, " ")
    (note,) = load_recording(path).notes
    assert note.endswith("are in minutes or hours, give time_unit='min' or 'h' (--time-unit).")
    same(load_recording(path, time_unit=unit), rows)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("wrap", "unit"), [(2**32, "us"), (2**32, "ms"), (2**16, "ms"), (86400, "s"), (60, "s")]
)
def test_clocks_that_wrap_go_on(tmp_path: Path, rng: np.random.Generator, wrap: int, unit: str) -> None:
    rows = hinge(rng, count=100)
    per = {"s": 1, "ms": 1e3, "us": 1e6}[unit]
    cells = rows.astype(object)
    cells[:, 0] = [f"{(wrap - 0.6 * per + per * value) % wrap:.3f}" for value in rows[:, 0]]
    recording = load_recording(text(tmp_path / "a.tum", "", cells, " "), time_unit=unit)  # type: ignore[arg-type]
    np.testing.assert_allclose(recording.poses, poses_of(rows), atol=1e-9)
    np.testing.assert_allclose(np.diff(recording.times), 0.02, atol=1e-6)
    assert any("motion goes on: the clock restarted there" in note for note in recording.notes)


def test_parts_of_a_periodic_motion_in_another_order_are_sorted(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    rows = hinge(rng, count=242)  # one period: the last pose is close to the first one
    recording = load_recording(write(tmp_path / "a.csv", HEADER, np.roll(rows, 100, axis=0)))
    same(recording, rows)
    assert recording.notes == ("line 102 is earlier than the previous line; the rows are sorted by time.",)


def test_times_that_never_increase_are_refused(tmp_path: Path, rows: np.ndarray) -> None:
    rows[:, 0], rows[-1, 0] = 0, -1
    with pytest.raises(RecordingError, match=r"its 60 rows have only 2 different times"):
        load_recording(write(tmp_path / "a.csv", HEADER, rows))


def test_clocks_that_restart_within_the_same_times(tmp_path: Path, rng: np.random.Generator) -> None:
    rows = hinge(rng, count=100)
    cells = rows.copy()
    cells[30:, 0] -= cells[30, 0]
    cells[70:, 0] -= cells[70, 0]
    recording = load_recording(write(tmp_path / "a.csv", HEADER, cells))
    same(recording, rows)
    assert recording.notes[0].startswith("line 32: the time goes back from 0.58 s to 0 s, and the motion ")


@pytest.mark.parametrize(("unit", "per"), [("s", 1), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_times_in_any_unit(tmp_path: Path, rows: np.ndarray, unit: str, per: float) -> None:
    cells = rows.astype(object)
    cells[:, 0] = [f"{1.4e9 * per + per * value:.3f}" for value in rows[:, 0]]
    for header in (f"t [{unit}]", f"time ({unit})", f"timestamp_{unit}"):
        same(load_recording(text(tmp_path / "a.csv", ",".join([header, *HEADER[1:]]), cells)), rows)
    path = text(tmp_path / "a.tum", "", cells, " ")
    if unit != "s":
        with pytest.raises(
            RecordingError, match=rf"they look like {unit}: give time_unit='{unit}' \(--time-unit"
        ):
            load_recording(path)
    recording = load_recording(path, time_unit=unit)  # type: ignore[arg-type]
    same(recording, rows)
    assert recording.origin is not None
    assert float(recording.origin) == 1.4e9


@pytest.mark.parametrize("step", [1, 5])
def test_milliseconds_since_the_start_are_noted(tmp_path: Path, rows: np.ndarray, step: int) -> None:
    rows = rows[::step]
    path = write(tmp_path / "a.csv", HEADER, rows * [1000, *[1] * 7])
    assert any("in ms, give time_unit='ms' (--time-unit ms)" in note for note in load_recording(path).notes)
    same(load_recording(path, time_unit="ms"), rows)


def test_millimetres_are_noticed_and_vehicles_are_not_refused(tmp_path: Path, rows: np.ndarray) -> None:
    path = write(tmp_path / "a.csv", HEADER, rows * [1, 1000, 1000, 1000, *[1] * 4])
    with pytest.raises(RecordingError, match=r"more than that of a vehicle; .* give unit='mm' \(--unit mm\)"):
        load_recording(path)
    same(load_recording(path, unit="mm"), rows)
    rows[:, 1:4] = 40 * (rows[:, 1:4] - rows[:, 1:4].mean(axis=0))  # a motion of 18 mm about the origin
    small = load_recording(write(path, HEADER, rows))
    assert any("more than that of a hand; if the positions are in mm" in note for note in small.notes)
    times = 0.1 * np.arange(600)
    turned = Rotation.from_rotvec(np.outer(0.1 * times, [0, 0, 1])).as_quat()
    places = 80 * np.column_stack([np.sin(0.1 * times), np.cos(0.1 * times), 0 * times])
    drive = load_recording(write(path, HEADER, np.column_stack([times, places, turned])))
    assert len(drive.times) == 600
    assert any("span 226 m, like those of a vehicle" in note for note in drive.notes)
    places[300] = [1e6, 0, 0]
    outlier = load_recording(write(path, HEADER, np.column_stack([times, places, turned])))
    assert outlier.left_out[0].rows.tolist() == [302]


def test_a_row_that_is_far_away_is_left_out(tmp_path: Path, rows: np.ndarray) -> None:
    wrong = rows.copy()
    wrong[20, 1] = 500.0
    recording = load_recording(write(tmp_path / "a.csv", HEADER, wrong))
    assert (recording.left_out[0].rows.tolist(), recording.left_out[0].reason) == ([22], "far")
    same(recording, np.delete(rows, 20, axis=0))


def test_a_large_motion_in_another_unit_is_not_cut(tmp_path: Path, rng: np.random.Generator) -> None:
    rows = hinge(rng) * [3, 100, 100, 100, 1, 1, 1, 1]
    assert not load_recording(write(tmp_path / "a.csv", HEADER, rows)).left_out


@pytest.mark.parametrize(
    ("header", "step", "sentence"),
    [
        (
            "t,x [mm],y [mm],z [mm],qx,qy,qz,qw",
            0.02,
            "mm; if they are in m, correct the unit in the file, or give unit (--unit) if the file states "
            "none.",
        ),
        (
            "t,x,y,z,qx,qy,qz,qw",
            1.0,
            "if they are frame numbers, give the sample time, dt (--dt); ",
        ),
    ],
)
def test_units_that_do_not_fit_are_noted(
    tmp_path: Path, rows: np.ndarray, header: str, step: float, sentence: str
) -> None:
    rows[:, 0] = step * np.arange(len(rows))
    (note,) = load_recording(text(tmp_path / "a.csv", header, rows)).notes
    assert sentence in note


def test_positions_in_a_map_are_not_in_mm(tmp_path: Path, rows: np.ndarray) -> None:
    rows[:, 1:4] += [5e5, 4e6, 100]
    assert not load_recording(text(tmp_path / "a.csv", ",".join(HEADER), rows)).notes


def test_matrices_that_are_stored_by_column_are_noted(tmp_path: Path, rng: np.random.Generator) -> None:
    rows = hinge(rng)
    for order, expected in ((1, 0), (-1, 1)):
        matrices = poses_of(rows)[:, :3]
        if order < 0:
            matrices[:, :, :3] = matrices[:, :, :3].swapaxes(1, 2).copy()
        notes = load_recording(text(tmp_path / "a.txt", "", matrices.reshape(-1, 12), " "), dt=0.02).notes
        assert len(notes) == expected
        assert all("constrained only if they are read column by column: check" in note for note in notes)


def test_a_body_that_no_column_names_is_refused(tmp_path: Path, rows: np.ndarray) -> None:
    path = text(tmp_path / "a.csv", ",".join(HEADER), rows)
    with pytest.raises(
        RecordingError, match=r"no column has 'rod' in its name, body \(--body\); columns: t, x"
    ):
        load_recording(path, body="rod")


def test_decimal_commas_between_commas_are_refused(tmp_path: Path, rows: np.ndarray) -> None:
    cells = [[str(cell).replace(".", ",") for cell in row] for row in rows]
    with pytest.raises(
        RecordingError, match=r"found 1[56]; if numbers have decimal commas, separate .* semicolons"
    ):
        load_recording(text(tmp_path / "a.csv", ",".join(HEADER), cells))


def lerobot(path: Path, rows: np.ndarray, angles: np.ndarray) -> dict[str, Any]:
    state = pa.array(np.column_stack([rows[:, 1:4], angles]).tolist())
    pq.write_table(pa.table({"observation.state": state, "timestamp": pa.array(rows[:, 0])}), path)
    return {"position": "observation.state[0:3]", "orientation": "observation.state[3:6]"}


@pytest.mark.parametrize("how", ["xyz", "ZYX", "vector"])
def test_degrees_are_not_taken_for_radians(tmp_path: Path, rows: np.ndarray, how: str) -> None:
    turned = Rotation.from_quat(rows[:, 4:])
    angles = turned.as_rotvec() if how == "vector" else turned.as_euler(how)
    path = tmp_path / "a.parquet"
    options = {**lerobot(path, rows, np.degrees(angles)), "angles": how}
    with pytest.raises(
        RecordingError, match=r"6\.28 rad of a turn; .* angle_unit='deg' \(--angle-unit deg\)"
    ):
        load_recording(path, **options)
    same(load_recording(path, **options, angle_unit="deg"), rows)
    lerobot(path, rows, angles)
    same(load_recording(path, **options), rows)
    same(load_recording(path, **options, angle_unit="rad"), rows)


def test_small_angles_in_degrees_turn_too_fast(tmp_path: Path, rng: np.random.Generator) -> None:
    angles = 5 * np.sin(np.outer(4 * np.arange(60) * 0.02, [1, 0.7, 0.4]))
    rows = hinge(rng, count=60)
    options = {**lerobot(tmp_path / "a.parquet", rows, angles), "angles": "xyz"}
    notes = load_recording(tmp_path / "a.parquet", **options).notes
    assert any("if they are in degrees, give angle_unit='deg'" in note for note in notes)
    rows[:, 0] /= 10
    lerobot(tmp_path / "a.parquet", rows, angles)
    with pytest.raises(RecordingError, match=r"faster than hands and robots turn; .*\(--angle-unit deg\)"):
        load_recording(tmp_path / "a.parquet", **options)


@pytest.mark.parametrize("size", [0.01, 0.05])
def test_small_angles_in_degrees_are_noticed_by_the_positions(
    tmp_path: Path, rng: np.random.Generator, size: float
) -> None:
    """Of a body that turns about a point by less than a few degrees."""
    times = 0.02 * np.arange(300)
    turned = Rotation.from_rotvec(size * np.sin(np.outer(times, [1.3, 0.7, 2.1])))
    places = [0.5, 0.3, 0.2] + turned.apply([0.4, 0.05, 0.1]) + 5e-5 * rng.normal(size=(300, 3))
    rows = np.column_stack([times, places, turned.as_quat()])
    options = {**lerobot(tmp_path / "a.parquet", rows, turned.as_euler("xyz", degrees=True)), "angles": "xyz"}
    (note,) = load_recording(tmp_path / "a.parquet", **options).notes
    assert note.startswith(
        "read in degrees, the angles turn the body about a fixed point, but not if read in rad; "
    )
    assert "angle_unit='deg' (--angle-unit deg)" in note
    for unit in ("deg", "rad"):
        assert not load_recording(tmp_path / "a.parquet", **options, angle_unit=unit).notes
    lerobot(tmp_path / "a.parquet", rows, turned.as_euler("xyz"))
    assert not load_recording(tmp_path / "a.parquet", **options).notes
    if size < 0.02:
        return  # as good with a longer lever
    (note,) = load_recording(tmp_path / "a.parquet", **options, angle_unit="deg").notes
    assert note.endswith("if they are in rad, give angle_unit='rad' (--angle-unit rad).")


@pytest.mark.parametrize("unit", ["deg", "rad"])
def test_tables_of_angles(tmp_path: Path, rows: np.ndarray, unit: str) -> None:
    angles = Rotation.from_quat(rows[:, 4:]).as_euler("xyz", degrees=unit == "deg")
    cells = np.column_stack([rows[:, :4], angles])
    path = text(tmp_path / "a.csv", "t,x,y,z,roll,pitch,yaw", cells)
    with pytest.raises(
        RecordingError, match=r"the meaning of the angles roll, pitch, yaw; give angles \(--angles\)"
    ):
        load_recording(path)
    same(load_recording(path, angles="xyz", angle_unit=unit), rows)  # type: ignore[arg-type]
    stated = ",".join(["t,x,y,z", *(f"{name} [{unit}]" for name in ("roll", "pitch", "yaw"))])
    same(load_recording(text(path, stated, cells), angles="xyz"), rows)
    turns = np.column_stack([rows[:, :4], Rotation.from_quat(rows[:, 4:]).as_rotvec()])
    same(load_recording(text(path, "t,x,y,z,rx,ry,rz", turns), angles="vector"), rows)


# quaternions


def make_tum(path: Path, rows: np.ndarray) -> Path:
    return write(path / "a.tum", None, rows, " ")


def make_csv(path: Path, rows: np.ndarray) -> Path:
    return write(path / "a.csv", HEADER, rows)


def make_npz(path: Path, rows: np.ndarray) -> Path:
    np.savez(path / "a.npz", times=rows[:, 0], positions=rows[:, 1:4], quaternions=rows[:, 4:])
    return path / "a.npz"


def make_bag(path: Path, rows: np.ndarray) -> Path:
    messages, samples = Messages("a.mcap"), []
    for k, row in enumerate(rows):
        message = messages.pose(POSE, START + k * STEP, np.eye(4))
        for name, value in zip("xyzw", row[4:], strict=True):
            object.__setattr__(message.pose.orientation, name, float(value))
        for name, value in zip("xyz", row[1:4], strict=True):
            object.__setattr__(message.pose.position, name, float(value))
        samples.append(("/a", POSE, message, START + k * STEP))
    return write_bag(path, "a.mcap", samples)


@pytest.mark.parametrize("make", [make_tum, make_csv, make_npz, make_bag])
def test_quaternions_with_w_first_are_noticed_and_read(
    tmp_path: Path, rows: np.ndarray, make: Callable[[Path, np.ndarray], Path]
) -> None:
    path = make(tmp_path, rows[:, [0, 1, 2, 3, 7, 4, 5, 6]])
    recording = load_recording(path)
    assert any("give quaternion='wxyz' (--quaternion wxyz)" in note for note in recording.notes)
    same(load_recording(path, quaternion="wxyz"), rows)
    path.unlink()
    shutil.rmtree(tmp_path / "rosbag", ignore_errors=True)
    path = make(tmp_path, rows)
    same(load_recording(path), rows)
    notes = load_recording(path, quaternion="wxyz").notes
    assert any("give quaternion='xyzw' (--quaternion xyzw)" in note for note in notes)


def test_names_of_columns_tell_the_order_and_the_option_wins(tmp_path: Path, rows: np.ndarray) -> None:
    numbers = rows[:, [0, 1, 2, 3, 7, 4, 5, 6]]
    header = "t,x,y,z,qw,qx,qy,qz"
    same(load_recording(text(tmp_path / "a.csv", header, numbers)), rows)
    same(load_recording(text(tmp_path / "a.csv", header, numbers), quaternion="wxyz"), rows)
    same(load_recording(text(tmp_path / "a.csv", header, rows), quaternion="xyzw"), rows)


# equal and unsorted times


def test_equal_times_are_left_out_and_counted(tmp_path: Path, rows: np.ndarray) -> None:
    wrong = rows.copy()
    again = np.arange(7, 60, 8)
    wrong[again, 0] = wrong[again - 1, 0]
    recording = load_recording(write(tmp_path / "a.csv", HEADER, wrong))
    same(recording, np.delete(rows, again, axis=0))
    (left_out,) = recording.left_out
    assert (left_out.rows.tolist(), left_out.reason) == ((again + 2).tolist(), "equal_time")
    assert any(
        note.startswith("7 of 60 rows left out, from line 9 on: each has the time")
        for note in recording.notes
    )


def test_unsorted_rows_are_sorted(tmp_path: Path, rows: np.ndarray, rng: np.random.Generator) -> None:
    order = rng.permutation(60)
    recording = load_recording(write(tmp_path / "a.csv", HEADER, rows[order]))
    np.testing.assert_allclose(recording.poses, poses_of(rows), atol=1e-12)
    assert recording.rows is not None
    np.testing.assert_array_equal(order[recording.rows - 2], np.arange(60))
    assert any("the rows are sorted by time" in note for note in recording.notes)


def test_several_recordings_or_bodies_in_a_file_are_refused(tmp_path: Path, rows: np.ndarray) -> None:
    other = rows + np.array([0, 0.3, 0, 0.2, 0, 0, 0, 0])
    path = tmp_path / "a.csv"
    shifted = other.copy()
    shifted[:, 0] += 0.01
    write(path, HEADER, np.concatenate([rows, shifted]))
    with pytest.raises(
        RecordingError, match=r"line 62: the time goes back from .* contains several recordings; divide it"
    ):
        load_recording(path)
    write(path, HEADER, np.stack([rows, other], axis=1).reshape(-1, 8))
    with pytest.raises(RecordingError, match=r"another pose at the same time, .* contains several bodies"):
        load_recording(path)
    rounded = rows.copy()
    rounded[:, 0] = np.floor(rows[:, 0])
    with pytest.raises(RecordingError, match="have only 2 different times; the times are rounded"):
        load_recording(write(path, HEADER, rounded))


# the reported files


@pytest.mark.skipif(not DATA.is_dir(), reason="needs the small inputs in ../shared/data/cases")
@pytest.mark.parametrize(
    ("name", "options", "count"),
    [
        ("euroc_header.csv", {}, 59),
        ("tum_commas.csv", {}, 40),
        ("tum_commas.txt", {}, 40),
        ("w_first_tum.txt", {"quaternion": "wxyz"}, 60),
        ("duplicate_stamp.csv", {}, 299),
        ("bag_duplicate_stamp", {}, 294),
        ("tcp_four.csv", {}, 4),
        ("tcp_touches_14.csv", {}, 14),
    ],
)
def test_the_cases(name: str, options: dict[str, Any], count: int) -> None:
    recording = load_recording(DATA / name, **options)
    assert len(recording.times) == count
    if "tcp" in name:
        return
    axis = np.array([0.0976, 0.1952, 0.9759])
    steps = recording.poses[10:, :3, :3] @ recording.poses[:-10, :3, :3].swapaxes(1, 2)
    turns = Rotation.from_matrix(steps).as_rotvec()
    main = np.linalg.svd(turns)[2][0]
    assert np.degrees(np.arccos(min(abs(main @ axis), 1))) < 1

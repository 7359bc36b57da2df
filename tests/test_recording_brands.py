"""Spellings, units and gaps in files of other programs: read as meant, or refused with the remedy."""

import datetime
from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from recording_files import HEADER, poses_of, write
from scipy.spatial.transform import Rotation
from test_recording_lost import hinge
from test_recording_shapes import same, text

from reframe_jax.recordings.conventions import fits_better, reorder
from reframe_jax.recordings.reading import load_recording
from reframe_jax.recordings.recording import RecordingError


@pytest.fixture
def rows(rng: np.random.Generator) -> np.ndarray:
    """(60, 8) t, x, y, z, qx, qy, qz, qw of a hinge."""
    return hinge(rng, count=60)


# text


@pytest.mark.parametrize("sep", [",\t", ", \t", ";\t", " ; ", "|", " | "])
@pytest.mark.parametrize("name", ["a.csv", "a.txt", "a.tum"])
def test_tables_and_trajectories_with_two_marks_between_cells(
    tmp_path: Path, rows: np.ndarray, sep: str, name: str
) -> None:
    same(load_recording(text(tmp_path / name, sep.join(HEADER), rows, sep)), rows)
    same(load_recording(text(tmp_path / name, "", rows, sep)), rows)


@pytest.mark.parametrize(
    "preamble",
    [
        "// made by a tracker",
        "Device: Foo 3000\nSerial: 12\n",
        "Sampling rate,100\nOperator,Kim",
        "# frame: map\n\nUnits,metres and seconds",
    ],
)
@pytest.mark.parametrize("gaps", [0, 3])
def test_lines_before_the_header(tmp_path: Path, rows: np.ndarray, preamble: str, gaps: int) -> None:
    """Also if tracking starts late, with rows of a time and empty cells."""
    cells = rows.astype(object)
    cells[:gaps, 1:] = ""
    recording = load_recording(text(tmp_path / "a.csv", f"{preamble}\n{','.join(HEADER)}", cells))
    np.testing.assert_allclose(recording.poses, poses_of(rows[gaps:]), atol=1e-9)
    np.testing.assert_allclose(recording.times, rows[gaps:, 0], atol=1e-9)


def test_lines_between_the_header_and_the_numbers(tmp_path: Path, rows: np.ndarray) -> None:
    units = "# in the ground frame\nms,mm,mm,mm,,,,\n--------"
    cells = rows * [1e3, 1e3, 1e3, 1e3, 1, 1, 1, 1]
    same(load_recording(text(tmp_path / "a.csv", f"{','.join(HEADER)}\n{units}", cells)), rows)


@pytest.mark.parametrize(
    "header",
    [
        "Time,PosX,PosY,PosZ,QuatX,QuatY,QuatZ,QuatW",
        "timeStamp,positionX,positionY,positionZ,rotationX,rotationY,rotationZ,rotationW",
        "TIME,X,Y,Z,QX,QY,QZ,QW",
        "Timestamp,HMDPositionX,HMDPositionY,HMDPositionZ,HMDRotX,HMDRotY,HMDRotZ,HMDRotW",
        "Zeit [s],x,y,z,qx,qy,qz,qw",
        "temps,x,y,z,qx,qy,qz,qw",
    ],
)
def test_titles_in_other_cases_and_languages(tmp_path: Path, rows: np.ndarray, header: str) -> None:
    same(load_recording(text(tmp_path / "a.csv", header, rows)), rows)


def test_of_two_columns_of_times_one_is_read(tmp_path: Path, rows: np.ndarray) -> None:
    header = "elapsed time,timestamp," + ",".join(HEADER[1:])
    cells = np.column_stack([rows[:, 0], rows])
    same(load_recording(text(tmp_path / "a.csv", header, cells)), rows)


@pytest.mark.parametrize("word", ["-nan(ind)", "1.#QNAN", "#DIV/0!", "#N/A", "lost", "NULL"])
def test_words_for_lost_tracking(tmp_path: Path, rows: np.ndarray, word: str) -> None:
    cells = rows.astype(object)
    cells[5, 1:] = word
    same(load_recording(write(tmp_path / "a.csv", HEADER, cells)), np.delete(rows, 5, axis=0))


@pytest.mark.parametrize(
    ("name", "remedy"),
    [("a.csv.gz", "decompress"), ("a.XLSX", "save the sheet as .csv"), ("a.mat", "save the arrays as .npz")],
)
def test_files_that_need_another_program_first(tmp_path: Path, name: str, remedy: str) -> None:
    (tmp_path / name).write_bytes(b"PK\3\4")
    with pytest.raises(RecordingError, match=f"files are not read; {remedy}"):
        load_recording(tmp_path / name)


@pytest.mark.parametrize("scale", [1.4, "varying"])
def test_quaternions_that_are_not_normalized(
    tmp_path: Path, rows: np.ndarray, rng: np.random.Generator, scale: float | str
) -> None:
    factors = rng.uniform(0.5, 2, (60, 1)) if scale == "varying" else scale
    wrong = np.hstack([rows[:, :4], rows[:, 4:] * factors])
    with pytest.raises(RecordingError, match=r"lengths are .*not normalized.*divide each .* by its length"):
        load_recording(write(tmp_path / "a.csv", HEADER, wrong))


# units


def test_hours_and_minutes_are_times(tmp_path: Path, rows: np.ndarray) -> None:
    start = datetime.datetime(2024, 5, 1, 9, 59, 59, 500_000)
    moments = [start + datetime.timedelta(seconds=float(time)) for time in rows[:, 0]]
    for form in ("%H:%M:%S.%f", "%Y-%m-%dT%H:%M:%S.%fZ"):
        cells = [
            [moment.strftime(form), *row[1:]] for moment, row in zip(moments, rows.tolist(), strict=True)
        ]
        recording = load_recording(text(tmp_path / "a.csv", ",".join(HEADER), cells))
        np.testing.assert_allclose(recording.times - recording.times[0], rows[:, 0], atol=1e-6)
    cells = [[f"{moment:%d.%m.%Y %H:%M:%S}", *row[1:]] for moment, row in zip(moments, rows, strict=True)]
    with pytest.raises(RecordingError, match=r"write times in seconds, or as 2024-05-01 10:00:00\.250"):
        load_recording(text(tmp_path / "a.csv", ",".join(HEADER), cells))


@pytest.mark.parametrize(("unit", "per"), [("us", 1e6), ("ns", 1e9)])
@pytest.mark.parametrize("start", [0.0, 3600.0, 12345.0, 1.7e9])
def test_the_unit_of_stamps_since_any_moment(
    tmp_path: Path, rows: np.ndarray, unit: str, per: float, start: float
) -> None:
    cells = rows.astype(object)
    cells[:, 0] = [str(round((start + time) * per)) for time in rows[:, 0]]
    path = write(tmp_path / "a.csv", HEADER, cells)
    with pytest.raises(RecordingError, match=rf"they look like {unit}: give time_unit='{unit}'"):
        load_recording(path)
    same(load_recording(path, time_unit=unit), rows)  # type: ignore[arg-type]


@pytest.mark.parametrize(("unit", "scale"), [("cm", 100.0), ("\u00b5m", 1e6), ("mm", 1e3)])
def test_units_of_length(tmp_path: Path, rng: np.random.Generator, unit: str, scale: float) -> None:
    """Of a small motion, whose size does not show the unit; its distance from the origin does."""
    small = hinge(rng, count=60)
    small[:, 1:4] = small[0, 1:4] + 0.02 * (small[:, 1:4] - small[0, 1:4])
    cells = small * [1, scale, scale, scale, 1, 1, 1, 1]
    header = ",".join(["t", *(f"{axis} [{unit}]" for axis in "xyz"), *HEADER[4:]])
    np.testing.assert_allclose(
        load_recording(text(tmp_path / "a.csv", header, cells)).poses, poses_of(small), atol=1e-9
    )
    path = write(tmp_path / "b.csv", HEADER, cells)
    try:
        notes = load_recording(path).notes
    except RecordingError as error:
        notes = (str(error),)
    assert any(
        "if the positions are in mm, give unit='mm' (--unit mm), for cm unit='cm'" in note for note in notes
    )
    mixed = header.replace(f"z [{unit}]", "z [m]")
    with pytest.raises(
        RecordingError, match=r"expected the same known unit \(such as m, cm, mm, um\) in all columns: x"
    ):
        load_recording(text(tmp_path / "c.csv", mixed, cells))


def plus(path: Path, poses: np.ndarray, scale: float) -> Path:
    lines = ["ObjectType = Image"]
    for k, pose in enumerate(poses):
        scaled = pose.copy()
        scaled[:3, 3] *= scale
        lines.append(
            f"Seq_Frame{k:04d}_ProbeToTrackerTransform = {' '.join(map(repr, scaled.ravel().tolist()))}"
        )
        lines.append(f"Seq_Frame{k:04d}_Timestamp = {0.02 * k:.6f}")
    path.write_text("\n".join([*lines, "ElementDataFile = LOCAL", ""]))
    return path


@pytest.mark.parametrize(
    ("scale", "note"), [(1.0, "positions are read in m, "), (1e3, "read in mm, as Plus")]
)
def test_sequences_of_plus_in_metres(tmp_path: Path, rows: np.ndarray, scale: float, note: str) -> None:
    path = plus(tmp_path / "a.mha", poses_of(rows), scale)
    recording = load_recording(path)
    same(recording, rows)
    assert any(note in each for each in recording.notes)
    given = load_recording(path, unit="m" if scale == 1 else "mm")
    same(given, rows)
    assert not any("are read in" in each for each in given.notes)


def test_a_csv_of_ndi_below_a_title(tmp_path: Path, rows: np.ndarray) -> None:
    cells = [[k, "OK", row[7], *row[4:7], *(1e3 * row[1:4]), 0.1] for k, row in enumerate(rows)]
    header = "Export of the tracker\nFrame,State,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error"
    same(load_recording(text(tmp_path / "a.csv", header, cells), dt=0.02), rows)
    metres = [[*row[:6], *(1e-3 * np.array(row[6:9])), 0.1] for row in cells]
    stated = header.replace("Tx,Ty,Tz", "Tx [m],Ty [m],Tz [m]")
    same(load_recording(text(tmp_path / "b.csv", stated, metres), dt=0.02), rows)


@pytest.mark.parametrize("count", [8, 10, 40])
def test_touches_in_degrees_are_noticed(tmp_path: Path, rng: np.random.Generator, count: int) -> None:
    turned = Rotation.from_rotvec(0.03 * rng.normal(size=(count, 3)))
    places = [0.25, -0.88, 0.04] - turned.apply([0.005, 0.095, 0.308])
    header = "x,y,z,roll,pitch,yaw"
    for degrees in (True, False):
        angles = turned.as_euler("xyz", degrees=degrees)
        path = text(tmp_path / "a.csv", header, np.column_stack([places, angles]))
        notes = load_recording(path, angles="xyz", dt=1.0).notes
        assert any("about a fixed point" in note for note in notes) == degrees


# the order of quaternions


def wave(rng: np.random.Generator, times: np.ndarray, width: int) -> np.ndarray:
    """Sums (N, width) of three sines, of at most one cycle in a unit of time."""
    rates, phases = 2 * np.pi * rng.uniform(0.2, 1, (3, width)), rng.uniform(0, 2 * np.pi, (3, width))
    return np.sum(rng.normal(size=(3, width)) * np.sin(rates * times[:, None, None] + phases), axis=1) / 2


def reach(rng: np.random.Generator, times: np.ndarray, width: int) -> np.ndarray:
    """Smooth steps (N, width) from point to point, one in a unit of time."""
    points = rng.normal(size=(int(np.ceil(times[-1])) + 1, width)) / 2
    now = np.minimum(times.astype(int), len(points) - 2)
    part = (times - now)[:, None]
    return points[now] + (10 * part**3 - 15 * part**4 + 6 * part**5) * (points[now + 1] - points[now])


def walk(rng: np.random.Generator, times: np.ndarray, width: int) -> np.ndarray:
    """Random walks (N, width)."""
    return np.cumsum(rng.normal(size=(len(times), width)), axis=0) / np.sqrt(len(times))


LEVER = np.array([0.2, 0.1, 0.15])  # m
KINDS: dict[str, tuple[Callable[..., np.ndarray], int, bool]] = {
    "free": (wave, 3, False),
    "free reach": (reach, 3, False),
    "free walk": (walk, 3, False),
    "hinge": (wave, 1, True),
    "ball": (wave, 3, True),
    "ball reach": (reach, 3, True),
}


@pytest.mark.parametrize("kind", KINDS)
def test_the_order_of_quaternions_is_rarely_doubted_in_free_motions(kind: str) -> None:
    """Of 40 motions, short and long, with little and much noise, in both orders."""
    make, width, constrained = KINDS[kind]
    wrong, noticed = [], []
    for seed, (cycles, count), noise in product(
        range(5), ((0.5, 60), (1, 100), (2, 250), (6, 400)), (1e-4, 1e-3)
    ):
        rng = np.random.default_rng([seed, count, int(1e6 * noise)])
        times = np.linspace(0, cycles, count)
        turns = np.zeros((count, 3))
        turns[:, :width] = 0.6 * make(rng, times, width)
        home = Rotation.random(rng=rng)
        turned = Rotation.random(rng=rng) * Rotation.from_rotvec(turns) * home
        places = turned.apply(LEVER) if constrained else 0.3 * make(rng, times, 3)
        places = places + noise * rng.normal(size=(count, 3))
        turned = turned * Rotation.from_rotvec(10 * noise * rng.normal(size=(count, 3)))
        own = turned.as_quat()
        for stored, meant in (("xyzw", "wxyz"), ("wxyz", "xyzw")):
            other = Rotation.from_quat(reorder(own, stored, meant))
            wrong.append(fits_better(places, turned.as_matrix(), other.as_matrix()) > 0)
            noticed.append(fits_better(places, other.as_matrix(), turned.as_matrix()) > 0)
    assert np.mean(wrong) <= 0.01
    if constrained:
        assert np.mean(noticed) > 0.45

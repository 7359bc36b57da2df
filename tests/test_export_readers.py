"""Exports of OptiTrack Motive, Vicon and Qualisys: read as they mean it, or refused in a line."""

import re
from pathlib import Path

import numpy as np
import pytest
from export_files import BODIES, motion, motive, qualisys, vicon
from scipy.spatial.transform import Rotation

from reframe_jax.recordings.reading import list_contents, load_recording
from reframe_jax.recordings.recording import Recording, RecordingError

Poses = dict[str, np.ndarray]


@pytest.fixture
def bodies(rng: np.random.Generator) -> Poses:
    return {name: motion(rng) for name in BODIES}


def save(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8", newline="")
    return path


def same(recording: Recording, poses: np.ndarray, keep: object = slice(None)) -> None:
    np.testing.assert_allclose(recording.poses, poses[keep], atol=2e-8)  # type: ignore[index]
    np.testing.assert_allclose(recording.times, (np.arange(len(poses)) / 100)[keep], atol=1e-9)  # type: ignore[index]


def test_several_bodies_must_be_named(tmp_path: Path, bodies: Poses) -> None:
    files = {"a.csv": motive(bodies), "b.csv": vicon(bodies), "c.tsv": qualisys(bodies)}
    for name, text in files.items():
        path = save(tmp_path / name, text)
        for option, problem in (
            (None, r"has several .*; name one, body \(--body\): Rod, Door 1\."),
            ("Window", "has no 'Window' among its .*: Rod, Door 1"),
        ):
            with pytest.raises(RecordingError, match=re.escape(str(path)) + ": " + problem):
                load_recording(path, body=option, angles="vector" if name == "b.csv" else None)
        kind, entries = list_contents(path)
        assert entries is not None
        assert kind.startswith("a")
        assert [(entry.option, entry.name) for entry in entries] == [("body", "Rod"), ("body", "Door 1")]


def test_the_motion_of_two_bodies(tmp_path: Path, bodies: Poses) -> None:
    expected = np.linalg.inv(bodies["Door 1"]) @ bodies["Rod"]
    files = {"a.csv": motive(bodies), "b.csv": vicon(bodies), "c.tsv": qualisys(bodies)}
    for name, text in files.items():
        angles = {"angles": "vector"} if name == "b.csv" else {}
        path = save(tmp_path / name, text)
        same(load_recording(path, body="Rod", in_body="Door 1", **angles), expected)  # type: ignore[arg-type]


def test_units_of_the_file_are_not_given_twice(tmp_path: Path, bodies: Poses) -> None:
    path = save(tmp_path / "a.csv", motive(bodies))
    with pytest.raises(RecordingError, match=r"is an export of OptiTrack Motive, which does not use unit"):
        load_recording(path, body="Rod", unit="mm")


def test_sample_times_given_replace_those_of_the_file(tmp_path: Path, bodies: Poses) -> None:
    recording = load_recording(save(tmp_path / "a.csv", vicon(bodies)), body="Rod", angles="vector", dt=0.5)
    np.testing.assert_allclose(recording.times, 0.5 * np.arange(12))


# Motive


@pytest.mark.parametrize("version", ["1.2", "1.23", "1.25"])
@pytest.mark.parametrize("rotation", ["Quaternion", "XYZ", "ZYX", "YXZ"])
def test_motive(tmp_path: Path, bodies: Poses, rotation: str, version: str) -> None:
    path = save(tmp_path / "a.csv", motive(bodies, rotation=rotation, version=version))
    for name, poses in bodies.items():
        recording = load_recording(path, body=name)
        same(recording, poses)
        assert recording.notes == ()


@pytest.mark.parametrize("unit", [("Meters", 1.0), ("Centimeters", 1e-2), ("Millimeters", 1e-3)])
def test_units_of_motive(tmp_path: Path, bodies: Poses, unit: tuple[str, float]) -> None:
    same(load_recording(save(tmp_path / "a.csv", motive(bodies, unit=unit)), body="Rod"), bodies["Rod"])


def test_a_single_body_of_motive_needs_no_name(tmp_path: Path, bodies: Poses) -> None:
    text = "\ufeff" + motive({"Rod": bodies["Rod"]}, lost=(3, 4))
    recording = load_recording(save(tmp_path / "a.csv", text))
    same(recording, bodies["Rod"], np.delete(np.arange(12), [3, 4]))
    assert recording.notes == ("lines 11-12 left out: a number is missing or not finite.",)


def test_rows_of_headings_that_came_later_or_earlier(tmp_path: Path, bodies: Poses) -> None:
    """Version 1.25 names parents; 1.2 leaves out the words Type, Name and ID."""
    lines = motive(bodies, version="1.25").splitlines()
    lines.insert(5, ",Parent" + "," * (lines[4].count(",") - 1))
    same(load_recording(save(tmp_path / "a.csv", "\n".join(lines)), body="Rod"), bodies["Rod"])
    text = motive(bodies).replace(",Type,", ",,").replace(",Name,", ",,").replace(",ID,", ",,")
    same(load_recording(save(tmp_path / "b.csv", text), body="Rod"), bodies["Rod"])


def test_names_of_takes_with_commas(tmp_path: Path, bodies: Poses) -> None:
    text = motive(bodies).replace("Take 2024", "Door, left, 2024")
    same(load_recording(save(tmp_path / "a.csv", text), body="Rod"), bodies["Rod"])


def test_bones_of_motive(tmp_path: Path, bodies: Poses) -> None:
    text = motive(bodies).replace("Rigid Body,", "Bone,")
    same(load_recording(save(tmp_path / "a.csv", text), body="Rod"), bodies["Rod"])
    with pytest.raises(RecordingError, match="has no rigid bodies"):
        load_recording(save(tmp_path / "b.csv", text.replace("Space,Global", "Space,Local")), body="Rod")


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("Meters", "Inches", "line 1: expected Length Units of Meters, .* found 'Inches'"),
        (
            "Type,Quaternion",
            "Type,XYX",
            "line 1: expected a Rotation Type of Quaternion or XYZ, .* found 'XYX'",
        ),
        ("Rotation,", "Attitude,", "no column for Rotation X, .* of the body; export both"),
        (
            "\r\nFrame,",
            "\r\nPicture,",
            "expected the header of a Motive export .*; the file states version '1.23'",
        ),
        ("Rigid Body,", "Marker,", "has no rigid bodies"),
        ("Door 1", "Rod", "two bodies have the name 'Rod'"),
        ("\r\n3,", "\r\n3,0,", "line 11: expected 24 columns, found 25"),
        ("\r\n3,0.03", "\r\n3,noon", "line 11: expected numbers: found 'noon"),
    ],
)
def test_broken_files_of_motive(tmp_path: Path, bodies: Poses, old: str, new: str, problem: str) -> None:
    text = motive(bodies)
    assert old in text
    with pytest.raises(RecordingError, match=problem):
        load_recording(save(tmp_path / "a.csv", text.replace(old, new)), body="Rod")


def test_a_header_of_motive_that_ends(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="expected the header of a Motive export"):
        load_recording(save(tmp_path / "a.csv", "Format Version,1.1\n"))


# Vicon


@pytest.mark.parametrize("unit", ["rad", "deg"])
@pytest.mark.parametrize("angles", ["vector", "XYZ", "zyx", "YXZ"])
def test_vicon(tmp_path: Path, bodies: Poses, angles: str, unit: str) -> None:
    path = save(tmp_path / "a.csv", vicon(bodies, angles=angles, unit=unit))
    for name, poses in bodies.items():
        recording = load_recording(path, body=name, angles=angles)  # type: ignore[arg-type]
        same(recording, poses)
        assert recording.notes == ()


def test_vicon_does_not_say_what_its_angles_are(tmp_path: Path, bodies: Poses) -> None:
    with pytest.raises(
        RecordingError, match=r"does not state the meaning of RX, RY, RZ; give angles \(--angles\)"
    ):
        load_recording(save(tmp_path / "a.csv", vicon(bodies)), body="Rod")
    path = save(tmp_path / "b.csv", vicon(bodies, angles="quaternion"))
    same(load_recording(path, body="Rod"), bodies["Rod"])
    with pytest.raises(RecordingError, match=r"has 4 orientation numbers; leave out angles"):
        load_recording(path, body="Rod", angles="vector")


def test_headings_of_vicon_before_names(tmp_path: Path, bodies: Poses) -> None:
    """Tracker says there that it wrote quaternions; its rows may end in a comma."""
    text = vicon(bodies, angles="quaternion").replace("Global Angle ", "Global Angle (Quaternion) ")
    path = save(tmp_path / "a.csv", text.replace("\n", ",\n"))
    same(load_recording(path, body="Door 1"), bodies["Door 1"])


@pytest.mark.parametrize("sep", [";", "\t"])
def test_vicon_separators_and_other_sections(tmp_path: Path, bodies: Poses, sep: str) -> None:
    rows = (["Trajectories"], ["100"], ["", "", "m1"], ["Frame", "Sub Frame", "X", "Y", "Z"])
    rows += (["", "", "mm", "mm", "mm"], ["1", "0", "1.0", "2.0", "3.0"], [])
    other = "".join(sep.join(row) + "\n" for row in rows)
    text = other + vicon(bodies, sep=sep, title="Segments" + sep * 3, first=7) + "\n" + other
    same(load_recording(save(tmp_path / "a.csv", text), body="Rod", angles="vector"), bodies["Rod"])


def test_bodies_that_vicon_lost(tmp_path: Path, bodies: Poses) -> None:
    one, kept = {"Rod": bodies["Rod"]}, np.delete(np.arange(12), [3, 4])
    recording = load_recording(save(tmp_path / "a.csv", vicon(one, lost=(3, 4))), angles="vector")
    same(recording, bodies["Rod"], kept)
    ends = re.sub(r"^([45],0),.*$", r"\1", vicon(one), flags=re.MULTILINE)
    same(load_recording(save(tmp_path / "c.csv", ends), angles="vector"), bodies["Rod"], kept)
    zeros = re.sub(r"^([45],0),.*$", r"\1,0,0,0,0,0,0", vicon(one), flags=re.MULTILINE)
    recording = load_recording(save(tmp_path / "b.csv", zeros), angles="vector")
    same(recording, bodies["Rod"], kept)
    assert recording.notes == ("lines 9-10 left out: all numbers are 0, as the body was not seen.",)


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("Objects", "Trajectories", "expected a section Objects or Segments; found only Trajectories"),
        ("\n100\n", "\nfast\n", "line 2: expected the rate in Hz"),
        ("Sub Frame", "Part", "line 2: expected the rate in Hz, then rows of names, of Frame,Sub Frame"),
        ("TX,TY", "TX,TX", "expected the columns RX,RY,RZ,TX,TY,TZ of every body"),
        (
            "rad,mm",
            "turns,mm",
            "expected the units rad or deg, and mm, cm or m, of Rod; found 'rad, rad, turns, mm",
        ),
        ("mm", "inch", "expected the units rad or deg, and mm, cm or m, of Rod; found 'rad, rad, rad, inch"),
        ("Door 1", "Rod", "expected different names of all bodies, found 'Rod'"),
        ("\n4,0,", "\n4,1,", "has sub frames; export one row per frame"),
        ("\n4,0,", "\n4,0,low,", "line 9: expected 14 columns, found 15"),
    ],
)
def test_broken_files_of_vicon(tmp_path: Path, bodies: Poses, old: str, new: str, problem: str) -> None:
    text = vicon(bodies)
    assert old in text
    with pytest.raises(RecordingError, match=problem):
        load_recording(save(tmp_path / "a.csv", text.replace(old, new)), body="Rod", angles="vector")


# Qualisys


@pytest.mark.parametrize("titles", [True, False])
@pytest.mark.parametrize("frames", [True, False])
def test_qualisys(tmp_path: Path, bodies: Poses, titles: bool, frames: bool) -> None:
    path = save(tmp_path / "a.tsv", qualisys(bodies, titles=titles, frames=frames))
    for name, poses in bodies.items():
        recording = load_recording(path, body=name)
        same(recording, poses)
        assert recording.notes == ()


@pytest.mark.parametrize("between", ["", "_", "."])
def test_titles_of_columns(tmp_path: Path, bodies: Poses, between: str) -> None:
    text = qualisys(bodies)
    titles = re.sub(r"(Rod|Door 1) (?=\S+)", rf"\1{between}" if between else "", text.splitlines()[9])
    lines = [*text.splitlines()[:9], titles, *text.splitlines()[10:]]
    same(load_recording(save(tmp_path / "a.tsv", "\n".join(lines)), body="Rod"), bodies["Rod"])


def test_headers_of_older_versions_of_qualisys(tmp_path: Path) -> None:
    """No FILE_VERSION, analog lines, the name of a body before X only, five digits; and a known rotation."""
    angle = np.radians([20.0, -35.0, 50.0])
    turns = [Rotation.from_rotvec(x * axis).as_matrix() for x, axis in zip(angle, np.eye(3), strict=True)]
    matrix = turns[0] @ turns[1] @ turns[2]  # roll, then pitch and yaw about the axes as they moved
    header = ["NO_OF_FRAMES\t8", "NO_OF_CAMERAS\t4", "NO_OF_BODIES\t1", "FREQUENCY\t50", "NO_OF_ANALOG\t0"]
    header += ["ANALOG_FREQUENCY\t0", "DESCRIPTION\t--", "TIME_STAMP\t2020-01-22, 17:47:17\t1.5"]
    names = ["X", "Y", "Z", "Roll", "Pitch", "Yaw", "Residual", *(f"Rot[{k}]" for k in range(9))]
    header += [
        "DATA_INCLUDED\t6D",
        "BODY_NAMES\tHull",
        "\t".join(["Frame", "Time", f"Hull {names[0]}", *names[1:]]),
    ]
    rows = [[k + 1, k / 50, 1e3 + k, 2e3, 3e3, 20.0, -35.0, 50.0, 0.7, *matrix.T.ravel()] for k in range(8)]
    lines = ["\t".join(f"{x:.5f}" for x in row) for row in rows]
    recording = load_recording(save(tmp_path / "a.tsv", "\r\n".join([*header, *lines])))
    np.testing.assert_allclose(recording.poses[:, :3, :3], np.tile(matrix, (8, 1, 1)), atol=2e-5)
    np.testing.assert_allclose(recording.poses[2, :3, 3], [1.002, 2.0, 3.0])
    np.testing.assert_allclose(recording.times, np.arange(8) / 50, atol=1e-9)
    assert not any("convention" in note or "row by row" in note for note in recording.notes)


def test_the_order_of_matrices_is_checked_against_the_angles(tmp_path: Path, bodies: Poses) -> None:
    recording = load_recording(save(tmp_path / "a.tsv", qualisys(bodies, by_row=True)), body="Rod")
    same(recording, bodies["Rod"])
    assert recording.notes == ("the matrices are read row by row, because the angles show this order.",)
    recording = load_recording(save(tmp_path / "b.tsv", qualisys(bodies, order="zyx")), body="Rod")
    same(recording, bodies["Rod"])
    (note,) = recording.notes
    assert note.startswith("the angles do not have the convention Qualisys standard")


def test_angles_of_qualisys_without_matrices(tmp_path: Path, bodies: Poses) -> None:
    convention = "ROTATION_CONVENTION\tQualisys standard"
    path = save(tmp_path / "a.tsv", qualisys(bodies, matrices=False, more=convention))
    same(load_recording(path, body="Door 1"), bodies["Door 1"])
    for more, named in (("", "unknown"), ("ROTATION_CONVENTION\tCustom", "Custom")):
        path = save(tmp_path / "b.tsv", qualisys(bodies, matrices=False, more=more))
        expected = (
            f"has no rotation matrices, .*convention '{named}'; .* only 'Qualisys standard' can be read"
        )
        with pytest.raises(RecordingError, match=expected):
            load_recording(path, body="Rod")


def test_bodies_that_qualisys_lost(tmp_path: Path, bodies: Poses) -> None:
    one, kept = {"Rod": bodies["Rod"]}, np.delete(np.arange(12), [3, 4])
    recording = load_recording(save(tmp_path / "a.tsv", qualisys(one, lost=(3, 4))))
    same(recording, bodies["Rod"], kept)
    assert recording.notes == ("lines 14-15 left out: all numbers are 0, as the body was not seen.",)
    lines = qualisys(one).splitlines()
    for number in (13, 14):
        lines[number] = "\t".join([*lines[number].split("\t")[:2], *[""] * 16])
    same(load_recording(save(tmp_path / "b.tsv", "\n".join(lines))), bodies["Rod"], kept)


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("NO_OF_BODIES\t2\r\n", "", "expected a 6DOF export with NO_OF_BODIES .*, found 6D; export 6D data"),
        ("DATA_INCLUDED\t6D\r\nBODY", "DATA_INCLUDED\t3D\r\nMARKER", "expected 2 BODY_NAMES and 16 columns"),
        ("NO_OF_BODIES\t2", "NO_OF_BODIES\t3", "expected 3 BODY_NAMES .*; found 2 names and 34 columns"),
        ("\r\n3\t0.02", "\r\n3\tsoon", "line 13: expected numbers: found 'soon"),
        ("\r\n3\t", "\r\n3\t1\t", "line 13: expected 34 columns, found 35"),
    ],
)
def test_broken_files_of_qualisys(tmp_path: Path, bodies: Poses, old: str, new: str, problem: str) -> None:
    text = qualisys(bodies)
    assert old in text
    with pytest.raises(RecordingError, match=problem):
        load_recording(save(tmp_path / "a.tsv", text.replace(old, new)), body="Rod")


def test_qualisys_without_times(tmp_path: Path, bodies: Poses) -> None:
    text = qualisys(bodies, frames=False).replace("FREQUENCY\t100", "FREQUENCY\tEXT")
    with pytest.raises(RecordingError, match=r"has no times; .*dt \(--dt\)"):
        load_recording(save(tmp_path / "a.tsv", text), body="Rod")
    same(load_recording(tmp_path / "a.tsv", body="Rod", dt=0.01), bodies["Rod"])

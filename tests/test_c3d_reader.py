"""C3D files: rigid bodies from markers or rotations, from files that ezc3d wrote."""

import struct
from pathlib import Path

import numpy as np
import pytest
from c3d_files import SHAPE, body, markers, write_c3d
from export_files import motion
from scipy.spatial.transform import Rotation

from reframe_jax.recordings.readers import c3d
from reframe_jax.recordings.readers.markers import fit_rigid_body
from reframe_jax.recordings.reading import list_contents, load_recording
from reframe_jax.recordings.recording import RecordingError

FINE = 1e-5  # the file has single precision


@pytest.fixture
def poses(rng: np.random.Generator) -> np.ndarray:
    return motion(rng)


def as_fitted(poses: np.ndarray, shape: np.ndarray = SHAPE) -> np.ndarray:
    """Poses of the frame in the centroid of the markers, with the axes of the ground in the first frame."""
    offset = np.eye(4)
    offset[:3, :3] = poses[0, :3, :3].T
    offset[:3, 3] = shape.mean(axis=0)
    return poses @ offset


# fitting


def test_bodies_are_fitted_exactly(poses: np.ndarray) -> None:
    found, residuals = fit_rigid_body(markers(poses))
    np.testing.assert_allclose(found, as_fitted(poses), atol=1e-12)
    np.testing.assert_allclose(residuals, 0, atol=1e-12)


def test_fits_agree_with_scipy(poses: np.ndarray, rng: np.random.Generator) -> None:
    """For two frames the mean shape is known: SciPy aligns it with the same points."""
    points = markers(poses) + 1e-3 * rng.normal(size=(12, 4, 3))
    found, residuals = fit_rigid_body(points)
    shapes = np.einsum("nji,nkj->nki", found[:, :3, :3], points - found[:, None, :3, 3])
    shape = shapes.mean(axis=0)
    for k in range(12):
        centred = points[k] - points[k].mean(axis=0)
        turned, distance = Rotation.align_vectors(centred, shape - shape.mean(axis=0))
        np.testing.assert_allclose(found[k, :3, :3], turned.as_matrix(), atol=1e-5)
        assert residuals[k] == pytest.approx(distance / 2, rel=1e-3)  # of 4 markers
    assert 3e-4 < np.sqrt(np.mean(residuals**2)) < 3e-3


def test_markers_may_be_missing(poses: np.ndarray) -> None:
    points = markers(poses)
    points[3, 1] = points[4, 0] = np.nan
    points[5, :2] = np.nan
    points[6] = np.nan
    found, residuals = fit_rigid_body(points)
    lost = [5, 6]
    np.testing.assert_allclose(
        np.delete(found, lost, axis=0), np.delete(as_fitted(poses), lost, axis=0), atol=1e-12
    )
    assert np.isnan(found[lost]).all()
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(residuals)), lost)


def test_three_markers_on_a_line_are_too_few(poses: np.ndarray) -> None:
    shape = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0, 0.1, 0]])
    points = markers(poses, shape)
    points[7, 3] = np.nan
    found, _ = fit_rigid_body(points)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(found).any(axis=(1, 2))), [7])
    with pytest.raises(ValueError, match="the markers are on a line"):
        fit_rigid_body(points[:, :3])


def test_flat_bodies_are_not_mirrored(poses: np.ndarray) -> None:
    flat = np.delete(SHAPE, 3, axis=0)
    found, _ = fit_rigid_body(markers(poses, flat))
    np.testing.assert_allclose(found, as_fitted(poses, flat), atol=1e-12)


# files


@pytest.mark.parametrize(("unit", "scale"), [("mm", 1000.0), ("cm", 100.0), ("m", 1.0)])
def test_markers(tmp_path: Path, poses: np.ndarray, unit: str, scale: float) -> None:
    path = write_c3d(tmp_path / "a.c3d", body("rod", poses, scale), unit)
    recording = load_recording(path)
    np.testing.assert_allclose(recording.poses, as_fitted(poses), atol=FINE)
    np.testing.assert_allclose(recording.times, 0.01 * np.arange(12))
    (note,) = recording.notes
    assert note.startswith("4 markers are ")
    assert note.endswith(" mm at most.")
    np.testing.assert_array_equal(load_recording(path, unit=unit).poses, recording.poses)  # type: ignore[arg-type]
    other = "cm" if unit == "mm" else "mm"
    with pytest.raises(RecordingError, match=rf"states another unit than {other}; leave out unit \(--unit\)"):
        load_recording(path, unit=other)  # type: ignore[arg-type]


def test_files_without_a_unit(tmp_path: Path, poses: np.ndarray) -> None:
    path = write_c3d(tmp_path / "a.c3d", body("rod", poses), unit="")
    with pytest.raises(RecordingError, match=r"does not state its unit; give unit \(--unit\)"):
        load_recording(path)
    np.testing.assert_allclose(load_recording(path, unit="mm").poses, as_fitted(poses), atol=FINE)
    with pytest.raises(RecordingError, match="states an unknown unit, 'inch'; give unit"):
        load_recording(write_c3d(tmp_path / "b.c3d", body("rod", poses), unit="inch"))


def test_several_bodies(tmp_path: Path, poses: np.ndarray, rng: np.random.Generator) -> None:
    other = motion(rng)
    points = {**body("rod", poses), **body("door", other), "head": np.ones((12, 3))}
    path = write_c3d(tmp_path / "a.c3d", points)
    with pytest.raises(RecordingError, match=r"several bodies; name one, body \(--body\): rod, door"):
        load_recording(path)
    np.testing.assert_allclose(load_recording(path, body="door").poses, as_fitted(other), atol=FINE)
    expected = np.linalg.inv(as_fitted(other)) @ as_fitted(poses)
    relative = load_recording(path, body="rod", in_body="door")
    np.testing.assert_allclose(relative.poses, expected, atol=1e-4)
    three = load_recording(path, body="rod:0, rod:1,rod:2", in_body="door:0,door:1,door:3")
    fitted = as_fitted(poses, SHAPE[:3]), as_fitted(other, SHAPE[[0, 1, 3]])
    np.testing.assert_allclose(three.poses, np.linalg.inv(fitted[1]) @ fitted[0], atol=1e-4)
    entries = list_contents(path)[1]
    assert entries is not None
    assert [(entry.name, entry.detail) for entry in entries] == [
        ("rod", "4 markers: rod:0, rod:1, rod:2, rod:3"),
        ("door", "4 markers: door:0, door:1, door:2, door:3"),
        ("head", "other markers, 100 Hz"),
    ]


def test_rotations(tmp_path: Path, poses: np.ndarray, rng: np.random.Generator) -> None:
    scaled, other = poses.copy(), motion(rng)
    scaled[:, :3, 3] *= 1000
    scaled[4] = 0
    path = write_c3d(
        tmp_path / "a.c3d", body("door", other), rotations={"pelvis": scaled, "head": scaled[::-1]}
    )
    recording = load_recording(path, body="pelvis")
    np.testing.assert_allclose(recording.poses, np.delete(poses, 4, axis=0), atol=FINE)
    np.testing.assert_allclose(recording.times, np.delete(0.01 * np.arange(12), 4))
    assert recording.notes[0] == "frame 4 left out: all numbers are 0, as the body was not seen."
    entries = list_contents(path)[1]
    assert entries is not None
    assert [entry.name for entry in entries] == ["pelvis", "head", "door"]
    assert entries[0].detail == "rotation, 100 Hz"


def test_frames_without_markers_are_dropped(tmp_path: Path, poses: np.ndarray) -> None:
    points = body("rod", poses)
    points["rod:0"][3] = points["rod:1"][3] = np.nan
    points["rod:2"][5] = 0
    recording = load_recording(write_c3d(tmp_path / "a.c3d", points))
    np.testing.assert_allclose(recording.poses, np.delete(as_fitted(poses), 3, axis=0), atol=FINE)
    assert (
        recording.notes[-1]
        == "frame 3 left out: fewer than three markers of the body are seen, or all of them are on a line."
    )


def test_markers_that_are_on_no_body(tmp_path: Path, poses: np.ndarray, rng: np.random.Generator) -> None:
    points = {f"m{i}": 1000 * rng.normal(size=(12, 3)) for i in range(4)}
    recording = load_recording(write_c3d(tmp_path / "a.c3d", points))
    assert recording.notes[0].endswith("; check that all are on the same body.")


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        (
            None,
            r"does not state which .* commas between them, body \(--body\); markers: hip, knee, foot, head",
        ),
        ("hip,knee,nose", "has no marker nose; markers: hip, knee, foot"),
        ("hip,knee", "expected three markers or more of a body, found 2"),
        ("hip,knee,foot", "no rigid body fits, because no frame has all markers; .*: hip 6, knee 12, foot 6"),
    ],
)
def test_bodies_that_cannot_be_read(
    tmp_path: Path, rng: np.random.Generator, name: str | None, problem: str
) -> None:
    points = {label: rng.normal(size=(12, 3)) for label in ("hip", "knee", "foot", "head")}
    points["hip"][:6] = points["foot"][6:] = np.nan
    with pytest.raises(RecordingError, match=problem):
        load_recording(write_c3d(tmp_path / "a.c3d", points), body=name)


# damaged files


def damage(content: bytes, place: int, new: bytes) -> bytes:
    return content[:place] + new + content[place + len(new) :]


def test_damaged_files(tmp_path: Path, poses: np.ndarray) -> None:
    path = write_c3d(tmp_path / "a.c3d", body("rod", poses))
    whole = path.read_bytes()
    used = whole.index(b"USED") + 4
    for content, problem in (
        (b"", "expected a C3D file; the content has another format"),
        (b"\x02\x51" + whole[2:], "expected a C3D file; the content has another format"),
        (whole[:400], "it ends before its parameters"),
        (whole[:1100], "it ends within its parameters"),
        (b"\xff" + whole[1:], "it ends before its parameters"),
        (whole[:-600], r"\d+ bytes of data are announced, \d+ are there"),
        (damage(whole, used, struct.pack("<H", 60000)), "the parameters do not end"),
        (damage(whole, used + 2, bytes([2, 7, *[255] * 7])), "a parameter is larger than its record"),
        (damage(whole, 515, b"\0"), "it cannot be read: .*processor"),
    ):
        path.write_bytes(content)
        with pytest.raises(RecordingError, match=problem) as caught:
            load_recording(path)
        assert str(caught.value).startswith(f"{path}: expected a")


def test_files_with_which_ezc3d_ends_the_process(tmp_path: Path, poses: np.ndarray) -> None:
    path = write_c3d(tmp_path / "a.c3d", body("rod", poses), rotations={"rod": poses})
    path.write_bytes(path.read_bytes()[:-400])
    with pytest.raises(RecordingError, match="expected a whole C3D file; it cannot be read: "):
        load_recording(path)


def test_files_that_ezc3d_never_finishes(
    tmp_path: Path, poses: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_c3d(tmp_path / "a.c3d", body("rod", poses))
    monkeypatch.setattr(c3d, "_PATIENCE", 1e-3)
    with pytest.raises(RecordingError, match="ezc3d does not finish reading it"):
        load_recording(path)

"""Three numbers of an orientation: their unit and their meaning, contradictions to the header of the file."""

from pathlib import Path

import numpy as np
import pytest
from export_files import vicon
from recording_files import poses_of, write
from scipy.spatial.transform import Rotation
from test_recording_lost import hinge

from reframe_jax.recordings.reading import load_recording
from reframe_jax.recordings.recording import RecordingError

TITLES = ["t", "x", "y", "z", "rx", "ry", "rz"]
HOME = Rotation.from_euler("XYZ", [0.6, -0.8, 0.4])  # so that no convention is like another one


def ball(rng: np.random.Generator, count: int = 300) -> np.ndarray:
    """(count, 8) rows of a body that turns about a point."""
    times = 0.02 * np.arange(count)
    waves = np.sin(np.outer(times, [1.3, 1.9, 2.3]) + np.arange(3))
    turned = Rotation.from_rotvec(0.6 * waves) * HOME
    places = turned.apply([0.2, 0.1, 0.15]) + 1e-4 * rng.normal(size=(count, 3))
    return np.column_stack([times, places, turned.as_quat()])


def save(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def angles_of(rows: np.ndarray, convention: str) -> np.ndarray:
    turned = Rotation.from_quat(rows[:, 4:])
    return turned.as_rotvec() if convention == "vector" else turned.as_euler(convention)


MOTIONS = {"hinge": hinge, "ball": ball}


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("meant", ["vector", "xyz", "XYZ"])
@pytest.mark.parametrize("read", ["vector", "xyz", "XYZ"])
def test_angles_that_are_read_in_another_convention_are_noticed(
    tmp_path: Path, rng: np.random.Generator, motion: str, meant: str, read: str
) -> None:
    rows = MOTIONS[motion](rng)
    if motion == "hinge":
        rows[:, 4:] = (Rotation.from_quat(rows[:, 4:]) * HOME).as_quat()
    path = write(tmp_path / "a.csv", TITLES, np.column_stack([rows[:, :4], angles_of(rows, meant)]))
    notes = load_recording(path, angles=read).notes  # type: ignore[arg-type]
    if read == meant:
        assert notes == ()
        return
    (note,) = [note for note in notes if "convention" in note]
    assert note.startswith(
        f"the angles are read in the convention {read}, but the motion is constrained only "
    )
    assert note.endswith(f"check the meaning of the angles; if so, give angles={meant!r} (--angles {meant}).")


def test_rotation_vectors_that_change_their_sign_at_half_a_turn_are_noticed(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    """Of a free motion: as rotation vectors it is smooth, as Euler angles it jumps."""
    times = 0.02 * np.arange(300)
    waves = np.sin(np.outer(times, [1.3, 1.9, 2.3, 2.9, 3.1, 1.1]) + np.arange(6))
    turned = Rotation.from_rotvec(0.3 * waves[:, :3]) * Rotation.from_rotvec([1.8, 1.8, 1.8])
    rows = np.column_stack([times, 0.2 * waves[:, 3:], turned.as_rotvec()])
    path = write(tmp_path / "a.csv", TITLES, rows)
    assert load_recording(path, angles="vector").notes == ()
    notes = load_recording(path, angles="xyz").notes
    assert any("but the motion is smooth only in the convention vector: " in note for note in notes)


@pytest.mark.parametrize("angles", ["vector", "XYZ"])
def test_units_of_angles_that_contradict_the_header_are_noticed(
    tmp_path: Path, rng: np.random.Generator, angles: str
) -> None:
    rows = hinge(rng)
    rows[:, 4:] = (Rotation.from_quat(rows[:, 4:]) * HOME).as_quat()
    text = vicon({"Rod": poses_of(rows)}, rate=50, angles=angles)
    right = load_recording(save(tmp_path / "a.csv", text), angles=angles)  # type: ignore[arg-type]
    np.testing.assert_allclose(right.poses, poses_of(rows), atol=1e-6)
    assert right.notes == ()
    small = load_recording(save(tmp_path / "a.csv", text.replace("rad", "deg")), angles=angles)  # type: ignore[arg-type]
    (note,) = small.notes
    assert note.startswith(
        "read in rad, the angles turn the body about a fixed point, but not if read in degrees"
    )
    assert note.endswith("; if they are in rad, correct the unit in the file.")
    degrees = vicon({"Rod": poses_of(rows)}, rate=50, angles=angles, unit="deg").replace("deg", "rad")
    path, remedy = (
        save(tmp_path / "a.csv", degrees),
        "; if they are in degrees, correct the unit in the file.",
    )
    if angles == "vector":
        with pytest.raises(RecordingError, match=r"more than the 6.28 rad of a turn" + remedy):
            load_recording(path, angles="vector")
    else:
        notes = load_recording(path, angles="XYZ").notes
        assert any(
            note.startswith("read in rad, the angles turn ") and note.endswith(remedy) for note in notes
        )

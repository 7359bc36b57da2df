"""Poses without order: separate touches and shuffled rows are noticed, motions of every kind are not."""

from pathlib import Path

import jax
import numpy as np
import pytest
from recording_files import HEADER, poses_of, write
from scipy.spatial.transform import Rotation
from test_calibration import place, touches
from test_recording_lost import hinge

import benchmarks.motions  # noqa: F401, adds the excitations "sine" and "hand"
import reframe_jax as rf
from reframe_jax.cli import program
from reframe_jax.recordings.continuity import is_unordered
from reframe_jax.simulation.synthetic import simulate

DATA = Path(__file__).parents[2] / "shared" / "data"
SHORT = (5, 8, 10, 12, 20, 40)

Captured = pytest.CaptureFixture[str]


def file_of(path: Path, poses: np.ndarray) -> Path:
    """Touches as people send them."""
    rf.save_recording(path, np.arange(float(len(poses))), poses)
    return path


@pytest.mark.parametrize("count", [5, 6, 7, 9, 14, 25, 100, 3000])
def test_touches_have_no_order(rng: np.random.Generator, count: int) -> None:
    noticed = [is_unordered(touches(rng, count)) for _ in range(60)]
    assert np.mean(noticed) > 0.9


@pytest.mark.parametrize("count", [40, 400])
def test_touches_that_drift_have_no_order(rng: np.random.Generator, count: int) -> None:
    """From one side to the other, with more distance between neighbours."""
    turns = Rotation.from_rotvec(
        0.4 * rng.normal(size=(count, 3)) + np.linspace(-0.5, 0.5, count)[:, None] * [1, 0.5, 0]
    )
    assert is_unordered(place(turns, noise=1e-4 * rng.normal(size=(count, 3))))


@pytest.mark.parametrize("label", ["A", "B", "D", "K"])
@pytest.mark.parametrize("excitation", ["paper", "exciting", "sine", "hand"])
def test_motions_have_order_and_shuffled_rows_have_none(
    rng: np.random.Generator, label: str, excitation: str
) -> None:
    made = simulate(label, jax.random.key(3), noise=1e-3, dt=0.05, excitation=excitation)
    poses = np.asarray(made.poses)
    assert not is_unordered(poses)
    assert not any(is_unordered(poses[k : k + length]) for length in SHORT for k in range(0, 60, 7))
    if np.ptp(poses[:, :3, 3], axis=0).max() > 0.1:
        assert is_unordered(poses[rng.permutation(len(poses))])


def test_rest_noise_and_outliers_are_no_touches(rng: np.random.Generator) -> None:
    poses = poses_of(hinge(rng, count=200))
    still = np.repeat(poses[:1], 200, axis=0)
    still[:, :3, 3] += 1e-3 * rng.normal(size=(200, 3))
    assert not is_unordered(still)
    poses[rng.choice(200, 20, replace=False), :3, 3] += 2.0
    assert not is_unordered(poses)
    assert not is_unordered(np.repeat(poses[:1], 30, axis=0))
    poses[3] = np.nan
    assert not is_unordered(poses)


@pytest.mark.skipif(not DATA.is_dir(), reason="needs the real recordings, in ../shared/data")
def test_no_real_recording_is_without_order() -> None:
    paths = sorted(DATA.glob("*.csv"))
    assert len(paths) > 10
    missed: dict[int, list[bool]] = {length: [] for length in SHORT}
    for path in paths:
        poses = rf.load_recording(path).poses
        assert not is_unordered(poses), path
        for length in SHORT:
            starts = range(0, len(poses) - length, max(len(poses) // 50, 1))
            missed[length] += [is_unordered(poses[k : k + length]) for k in starts]
    for length, found in missed.items():  # a few short parts are mainly jumps of the orientation
        assert np.mean(found) <= (0.02 if length < 10 else 0), length


def test_identify_says_that_touches_are_no_motion(
    tmp_path: Path, capsys: Captured, rng: np.random.Generator
) -> None:
    poses = touches(rng, 25)
    found = rf.identify(poses, dt=1.0)
    assert (found.name, float(found.probability) > 0.9) == ("Spherical joint", True)
    fitted = rf.calibrate(poses)
    known = {rf.AngularType.G: fitted.point, rf.AngularType.B: fitted.tip}
    position_body = found.linear.frame_type.position_body
    np.testing.assert_allclose(found.linear.position, known[position_body], atol=1e-3)
    (sentence,) = [each for each in found.warnings if "not in the order of a motion" in each]
    assert "reframe-jax calibrate" in sentence
    assert not any("Record a motion" in each for each in found.warnings)
    assert program.main(["identify", "--no-cache", str(file_of(tmp_path / "touches.csv", poses))]) == 0
    out, err = capsys.readouterr()
    assert sentence in out
    assert sentence in err
    ordered = poses_of(hinge(rng, count=60))
    assert not any("order of a motion" in each for each in rf.identify(ordered, dt=0.02).warnings)
    shuffled = rf.identify(ordered[rng.permutation(60)], dt=0.02)
    assert shuffled.name == "Revolute joint"
    assert any("order of a motion" in each for each in shuffled.warnings)


def test_lost_tracking_in_arrays_is_named_by_row(tmp_path: Path, rng: np.random.Generator) -> None:
    rows = hinge(rng, count=60)
    poses = poses_of(rows)
    poses[20:28] = np.eye(4)
    with pytest.warns(
        UserWarning, match=r"Tracking seems lost in rows 20-27 \(8 rows\) of poses, counted from 0"
    ):
        rf.identify(poses, dt=0.02)
    rows[20:28, 1:] = [0, 0, 0, 0, 0, 0, 1]
    recording = rf.load_recording(write(tmp_path / "lost.csv", HEADER, rows))
    rf.identify(recording.poses, times=recording.times)  # without a warning


@pytest.mark.parametrize("distance", [1.0, 1e3, 1e6])
def test_a_distant_outlier_does_not_hide_the_order(distance: float) -> None:
    angles = np.sin(0.1 * np.arange(51))
    poses = np.tile(np.eye(4), (51, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.outer(angles, [0.1, 0.3, 0.95])).as_matrix()
    poses[:, :3, 3] = poses[:, :3, :3] @ [0.4, 0.1, 0.2]
    for row in range(51):
        here = poses.copy()
        here[row, :3, 3] += distance
        assert not is_unordered(here)


def test_outlying_touches_are_no_jumps_of_a_path(tmp_path: Path, rng: np.random.Generator) -> None:
    poses = touches(rng, 25)
    poses[7, :3, 3] += 3
    notes = rf.load_recording(file_of(tmp_path / "a.csv", poses)).notes
    assert not any("jumps" in note for note in notes)

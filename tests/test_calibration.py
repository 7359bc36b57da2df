"""Tips and axes of tools, against planted ones: intervals, outliers, order, refusals, and the command."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from recording_files import HEADER, write
from scipy.spatial.transform import Rotation

import reframe_jax as rf
from reframe_jax.calibration.robust import student_factor
from reframe_jax.cli import program

TIP = np.array([0.005, 0.095, 0.308])  # m, in the body
POINT = np.array([0.25, -0.88, 0.043])  # m, in the ground
AXIS = np.array([0.1, 0.2, 0.97]) / np.linalg.norm([0.1, 0.2, 0.97])  # in the body
DATA = Path(__file__).parents[2] / "shared" / "data" / "cases"

Captured = pytest.CaptureFixture[str]


def place(turns: Rotation, tip: np.ndarray = TIP, noise: np.ndarray | float = 0.0) -> np.ndarray:
    poses = np.tile(np.eye(4), (len(turns), 1, 1))
    poses[:, :3, :3] = turns.as_matrix()
    poses[:, :3, 3] = POINT - turns.apply(tip) + noise
    return poses


def touches(rng: np.random.Generator, count: int, sigma: float = 1e-4) -> np.ndarray:
    turns = Rotation.from_rotvec(rng.normal(size=(count, 3)) * 0.5) * Rotation.from_rotvec([3.0, 0, 0])
    return place(turns, noise=sigma * rng.normal(size=(count, 3)))


def spins(rng: np.random.Generator, count: int, sigma: float = 1e-4, wobble: float = 1e-3) -> np.ndarray:
    turns = Rotation.from_rotvec([1, 0.2, 0.3]) * Rotation.from_rotvec(
        np.linspace(-1.5, 1.5, count)[:, None] * AXIS
    )
    poses = place(turns, noise=sigma * rng.normal(size=(count, 3)))
    poses[:, :3, :3] = (turns * Rotation.from_rotvec(wobble * rng.normal(size=(count, 3)))).as_matrix()
    return poses


def file_of(path: Path, poses: np.ndarray) -> Path:
    """As people send touches: a header, one pose per second, six digits."""
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    rows = np.column_stack([np.arange(len(poses)), poses[:, :3, 3], quaternions])
    return write(path, HEADER, np.round(rows, 6))


@pytest.mark.parametrize("count", [4, 8, 25])
def test_intervals_hold_the_tip_and_the_point(rng: np.random.Generator, count: int) -> None:
    inside = []
    for _ in range(60):
        found = rf.calibrate(touches(rng, count))
        inside += [np.abs(found.tip - TIP) < found.tip_interval]
        inside += [np.abs(found.point - POINT) < found.point_interval]
    assert 0.9 < np.mean(inside) < 0.99


def test_exact_touches_give_the_exact_tip_and_no_outliers(rng: np.random.Generator) -> None:
    found = rf.calibrate(touches(rng, 10, 0))
    np.testing.assert_allclose(found.tip, TIP, atol=1e-12)
    np.testing.assert_allclose(found.point, POINT, atol=1e-12)
    assert not len(found.outliers)


def test_the_fit_is_that_of_least_squares(rng: np.random.Generator) -> None:
    poses = touches(rng, 9)
    found = rf.calibrate(poses)
    design = np.concatenate([poses[:, :3, :3], np.tile(-np.eye(3), (9, 1, 1))], axis=2).reshape(-1, 6)
    solution, square, _, _ = np.linalg.lstsq(design, -poses[:, :3, 3].ravel(), rcond=None)
    np.testing.assert_allclose(np.append(found.tip, found.point), solution, atol=1e-10)
    np.testing.assert_allclose(
        found.covariance, square / 21 * np.linalg.inv(design.T @ design), rtol=1e-6, atol=1e-18
    )
    assert found.freedom == 21


def test_factors_are_those_of_student() -> None:
    from scipy.stats import t

    for freedom in (3, 4, 6, 9, 30, 1000):
        np.testing.assert_allclose(student_factor(freedom), t.ppf(0.975, freedom), rtol=0.02)


@pytest.mark.parametrize(("count", "wrong"), [(5, 1), (9, 2), (25, 9)])
def test_outlying_touches_are_named(rng: np.random.Generator, count: int, wrong: int) -> None:
    for _ in range(10):
        poses = touches(rng, count)
        rows = np.sort(rng.choice(count, wrong, replace=False))
        poses[rows, :3, 3] += 0.02 * rng.choice([-1, 1], (wrong, 3))
        found = rf.calibrate(poses)
        assert set(rows) <= set(found.outliers)
        assert found.used.sum() >= count - wrong - 1
        assert np.abs(found.tip - TIP).max() < 2e-3
        assert found.residuals[rows].min() > 5e-3


@pytest.mark.parametrize("spin", [False, True])
def test_poses_that_repeat_count_once(rng: np.random.Generator, spin: bool) -> None:
    """As of an arm that rests at every touch while its poses are written."""
    poses = spins(rng, 9) if spin else touches(rng, 9)
    times = rng.integers(1, 60, 9)
    single, held = rf.calibrate(poses, spin=spin), rf.calibrate(np.repeat(poses, times, axis=0), spin=spin)
    np.testing.assert_array_equal(held.tip, single.tip)
    np.testing.assert_array_equal(held.tip_interval, single.tip_interval)
    np.testing.assert_array_equal(held.residuals, np.repeat(single.residuals, times))
    with pytest.raises(ValueError, match="needs 4 different poses or more; there are 3"):
        rf.calibrate(np.repeat(poses[:3], 20, axis=0), spin=spin)


@pytest.mark.parametrize("spin", [False, True])
def test_the_order_of_the_rows_plays_no_part(rng: np.random.Generator, spin: bool) -> None:
    poses = spins(rng, 30) if spin else touches(rng, 30)
    poses[3, :3, 3] += 0.02
    order = rng.permutation(30)
    found, shuffled = (rf.calibrate(each, spin=spin) for each in (poses, poses[order]))
    assert found.outliers.tolist() == [3]
    for name in ("tip", "point", "covariance"):
        np.testing.assert_array_equal(getattr(found, name), getattr(shuffled, name))
    np.testing.assert_array_equal(found.residuals[order], shuffled.residuals)
    np.testing.assert_array_equal(found.used[order], shuffled.used)


def test_a_spin_shows_the_axis(rng: np.random.Generator) -> None:
    inside, place_inside = [], []
    for count in (4, 8, 20) * 20:
        found = rf.calibrate(spins(rng, count), spin=True)
        apart = np.linalg.norm(np.cross(found.axis, AXIS))
        one = student_factor(found.freedom) * np.sqrt(np.linalg.eigvalsh(found.axis_covariance)[-1])
        inside.append(apart < min(found.axis_interval, 1.25 * one))  # two components at once
        place_inside.append(np.abs(found.tip - (TIP - AXIS * (AXIS @ TIP))) < found.tip_interval)
        ground = Rotation.from_rotvec([1, 0.2, 0.3]).apply(AXIS)
        assert np.linalg.norm(np.cross(found.ground_axis, ground)) < 5e-3
        assert np.linalg.norm(np.cross(found.point - POINT, ground)) < 1e-3
        assert found.axis @ AXIS > 0
    assert np.mean(inside) > 0.85
    assert np.mean(place_inside) > 0.88


def test_a_pose_that_turned_about_another_axis_is_left_out_of_a_spin(rng: np.random.Generator) -> None:
    poses = spins(rng, 12)
    poses[5, :3, :3] = Rotation.from_rotvec([0.3, 0.2, 1.0]).as_matrix() @ poses[5, :3, :3]
    found = rf.calibrate(poses, spin=True)
    assert found.outliers.tolist() == [5]
    assert np.linalg.norm(np.cross(found.axis, AXIS)) < 2e-3
    assert found.axis_residuals[5] > 0.1


def test_what_determines_nothing_is_refused(rng: np.random.Generator) -> None:
    with pytest.raises(ValueError, match=r"tip along \(0\.10\d, 0\.20\d, 0\.97\d\) in the body"):
        rf.calibrate(spins(rng, 12))
    still = place(Rotation.from_rotvec(1e-3 * rng.normal(size=(8, 3))))
    with pytest.raises(ValueError, match="do not determine the tip: the tool turned by only 0"):
        rf.calibrate(still)
    with pytest.raises(ValueError, match="do not determine the axis: the tool turned by only 0"):
        rf.calibrate(still, spin=True)
    with pytest.raises(ValueError, match="do not turn about one axis"):
        rf.calibrate(touches(rng, 12), spin=True)


def test_what_are_no_poses_is_refused(rng: np.random.Generator) -> None:
    poses = touches(rng, 6)
    missing, skewed, reflected = poses.copy(), poses.copy(), poses.copy()
    missing[2, 0, 3] = np.nan
    skewed[3, 0, 0] += 0.1
    reflected[4, :3, 0] *= -1
    for wrong, message in (
        (poses[:3], "needs 4 different poses or more; there are 3"),
        (poses[0], r"shape \(N, 4, 4\), not \(4, 4\)"),
        ("touches", "array of numbers"),
        (missing, "poses: row 2: is not finite"),
        (skewed, r"poses: row 3: expected a pose matrix \[R p; 0 0 0 1\]"),
        (reflected, "poses: row 4: expected a pose matrix"),
    ):
        with pytest.raises(ValueError, match=message):
            rf.calibrate(wrong)


def test_the_command_prints_and_writes_what_was_found(
    tmp_path: Path, capsys: Captured, rng: np.random.Generator
) -> None:
    poses = touches(rng, 14)
    poses[4, :3, 3] += 0.03
    file, out = file_of(tmp_path / "touches.csv", poses), tmp_path / "out.json"
    assert program.main(["calibrate", str(file), "--json", str(out)]) == 0
    text = capsys.readouterr().out
    assert "Pivot calibration\n13 of 14 poses used" in text
    assert "Outlying, and left out: line 6 does not fit the other rows." in text
    assert text.count(" mm\n") >= 13
    document = json.loads(out.read_text())
    assert document["schema"] == "reframe-jax/calibration/1"
    (record,) = document["recordings"]
    found = record["calibration"]
    assert (found["kind"], found["outliers"], found["rows"]) == ("pivot", [6], list(range(2, 16)))
    assert np.abs(np.subtract(found["tip"], TIP)).max() < 1e-3
    assert (found["axis"], record["error"]) == (None, None)


def test_the_command_finds_axes_and_says_what_is_wrong(
    tmp_path: Path, capsys: Captured, rng: np.random.Generator
) -> None:
    file = file_of(tmp_path / "spin.csv", spins(rng, 60))
    assert program.main(["calibrate", str(file), "--spin", "--json", "-"]) == 0
    (record,) = json.loads(capsys.readouterr().out)["recordings"]
    assert record["calibration"]["kind"] == "spin"
    np.testing.assert_allclose(record["calibration"]["axis"], AXIS, atol=2e-3)
    assert program.main(["calibrate", str(file), "--spin"]) == 0
    out, _ = capsys.readouterr()
    assert "Axis      (0.1" in out
    assert "Residuals, the 40 largest" in out
    assert program.main(["calibrate", str(file), str(tmp_path / "none.csv")]) == 1
    _, err = capsys.readouterr()
    assert "spin.csv: The rotations do not determine the tip along" in err
    assert len(err.splitlines()) == 2


def test_the_command_needs_no_times(tmp_path: Path, capsys: Captured, rng: np.random.Generator) -> None:
    poses = touches(rng, 8)
    rows = np.column_stack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()])
    minutes = np.repeat([0.0, 60.0, 120.0], [3, 3, 2])
    for times in (None, np.zeros(8), np.full(8, 5.0), minutes, 1e9 * minutes, np.arange(8.0)[::-1]):
        numbers = rows if times is None else np.column_stack([times, rows])
        file = write(tmp_path / "a.csv", HEADER[8 - numbers.shape[1] :], numbers)
        assert program.main(["calibrate", str(file)]) == 0
        out, err = capsys.readouterr()
        assert "8 of 8 poses used" in out
        assert not err
    with pytest.raises(
        rf.RecordingError, match=r"no times; .* touches .* no times: use reframe-jax calibrate"
    ):
        rf.load_recording(write(tmp_path / "a.csv", HEADER[1:], rows))


def test_touches_in_millimetres_are_noticed(
    tmp_path: Path, capsys: Captured, rng: np.random.Generator
) -> None:
    poses = touches(rng, 14)
    poses[:, :3, 3] *= 1000
    file = file_of(tmp_path / "a.csv", poses)
    assert program.main(["calibrate", str(file)]) == 1
    assert re.search(r"line \d+: \d+ m from the median position; .*\(--unit mm\)", capsys.readouterr().err)
    assert program.main(["calibrate", str(file), "--unit", "mm"]) == 0
    assert "14 of 14 poses used" in capsys.readouterr().out


def test_touches_with_w_first_are_noticed(tmp_path: Path, rng: np.random.Generator) -> None:
    for count in (10, 11, 25):
        poses = touches(rng, count)
        turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        for order, said in (([3, 0, 1, 2], True), ([0, 1, 2, 3], False)):
            rows = np.column_stack([np.arange(count), poses[:, :3, 3], turns[:, order]])
            np.savetxt(tmp_path / "touches.txt", rows)
            notes = rf.load_recording(tmp_path / "touches.txt").notes
            assert any("--quaternion wxyz" in note for note in notes) is said


def test_the_command_says_that_a_continuous_motion_is_no_touches(
    tmp_path: Path, capsys: Captured, rng: np.random.Generator
) -> None:
    angle = np.linspace(0, 9, 200)
    turns = Rotation.from_rotvec(0.4 * np.column_stack([np.cos(angle), np.sin(1.7 * angle), 0 * angle]))
    poses = np.tile(np.eye(4), (200, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = turns.as_matrix(), -turns.apply(TIP)
    file = file_of(tmp_path / "swing.csv", poses)
    assert program.main(["calibrate", str(file)]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert "consecutive poses are close together" in line
    assert line.endswith("or compare the result with reframe-jax identify --assume ball.")
    assert program.main(["calibrate", str(file_of(tmp_path / "touches.csv", touches(rng, 25)))]) == 0
    assert "close together" not in capsys.readouterr().err


@pytest.mark.skipif(not DATA.is_dir(), reason="needs the reported files, in ../shared/data/cases")
def test_reported_touches() -> None:
    many, four = (rf.load_recording(DATA / f"tcp_{name}.csv").poses for name in ("touches_14", "four"))
    found = rf.calibrate(many)
    truth = np.array([0.00525, 0.09513, 0.30852, 0.2457, -0.8800, 0.0432])
    assert (np.abs(found.tip - truth[:3]) < found.tip_interval).all()
    assert (np.abs(found.point - truth[3:]) < found.point_interval).all()
    found = rf.calibrate(four)
    np.testing.assert_allclose(found.tip, [0.006, 0.093, 0.307], atol=1e-3)
    assert 1.5e-3 < found.rms < 3e-3

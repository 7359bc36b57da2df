"""Files that look like others: rows and columns of several bodies, bodies at rest, and frame numbers."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reframe_jax.recordings.reading import load_recording
from reframe_jax.recordings.recording import Recording, RecordingError

NUMBER, RATE = 200, 50.0
TIMES = np.arange(NUMBER) / RATE
POSE = "x,y,z,qx,qy,qz,qw"


def hinge(angles: np.ndarray, seed: int) -> np.ndarray:
    """Positions, m, and quaternions (N, 7) of a body on a hinge, with noise of 0.3 mm."""
    rng = np.random.default_rng(seed)
    ground, body = Rotation.random(2, rng)
    turn = Rotation.from_rotvec(angles[:, None] * [0, 0, 1])
    position = np.array([0.5, 0.3, 0.4 * seed]) + (ground * turn).apply([0.4, 0.1, 0.2])
    quaternion = (ground * turn * body).as_quat(canonical=True)
    return np.column_stack([position + 3e-4 * rng.normal(size=position.shape), quaternion])


ONE, OTHER = hinge(np.sin(1.5 * TIMES), 1), hinge(np.cos(1.1 * TIMES), 2)


def write(path: Path, header: str, rows: Iterable[Any]) -> Path:
    lines = [",".join(cell if isinstance(cell, str) else f"{cell:.6f}" for cell in row) for row in rows]
    path.write_text("\n".join([header, *lines]) + "\n")
    return path


def check(found: Recording, numbers: np.ndarray) -> None:
    np.testing.assert_allclose(found.poses[:, :3, 3], numbers[:, :3], atol=1e-6)
    turns = Rotation.from_quat(numbers[:, 3:]).as_matrix()
    np.testing.assert_allclose(found.poses[:, :3, :3], turns, atol=1e-5)


@pytest.mark.parametrize(
    ("first", "second", "body", "wanted"),
    [
        ("{}", "target_{}", "target", OTHER),
        ("{}", "goal_pos_{}", "goal", OTHER),
        ("tool1_{}", "tool10_{}", "tool1", ONE),
    ],
)
def test_the_chosen_body_of_a_table_is_read(
    tmp_path: Path, first: str, second: str, body: str, wanted: np.ndarray
) -> None:
    names = [first.format(name) for name in POSE.split(",")]
    names += [second.format(name).replace("pos_q", "q") for name in POSE.split(",")]
    rows = np.column_stack([TIMES, ONE, OTHER])
    check(load_recording(write(tmp_path / "a.csv", f"t,{','.join(names)}", rows), body=body), wanted)


@pytest.mark.parametrize("apart", [0.0, 0.004])
def test_rows_of_alternating_bodies_are_refused(tmp_path: Path, apart: float) -> None:
    both = [
        (time + k * apart, *pose[i]) for i, time in enumerate(TIMES) for k, pose in enumerate((ONE, OTHER))
    ]
    with pytest.raises(RecordingError, match=r"several bodies"):
        load_recording(write(tmp_path / "a.csv", f"t,{POSE}", both))
    with pytest.raises(RecordingError, match=r"the poses of several bodies alternate: keep the rows of one"):
        load_recording(write(tmp_path / "b.csv", POSE, [row[1:] for row in both]), dt=0.01)


@pytest.mark.parametrize("form", ["{}", "{}.0"])
def test_missing_frames_are_gaps(tmp_path: Path, form: str) -> None:
    kept = [(form.format(i), *ONE[i]) for i in range(NUMBER) if not 60 <= i < 90]
    found = load_recording(write(tmp_path / "a.csv", f"frame,{POSE}", kept), dt=1 / RATE)
    assert found.times[-1] == pytest.approx(TIMES[-1])


def test_a_motion_before_missing_rows_is_no_frozen_pose(tmp_path: Path) -> None:
    kept = np.delete(ONE, np.s_[60:90], axis=0)
    assert len(load_recording(write(tmp_path / "a.csv", POSE, kept), dt=1 / RATE).times) == len(kept)


@pytest.mark.parametrize("seed", range(4))
def test_a_body_that_comes_to_rest_in_rounded_numbers_is_kept(tmp_path: Path, seed: int) -> None:
    times = np.arange(600) / 120
    part = np.clip((times - 0.3) / 1.2, 0, 1)
    poses = hinge(0.85 * (10 * part**3 - 15 * part**4 + 6 * part**5), seed)
    still = np.argmax(part >= 1)
    poses[still:] = poses[still]
    rounded = np.column_stack([times, np.round(poses, 3)])
    assert len(load_recording(write(tmp_path / "a.csv", f"t,{POSE}", rounded)).times) == 600


def test_zeros_with_noise_between_distant_poses_are_lost(tmp_path: Path) -> None:
    poses = ONE.copy()
    poses[80:120, :3] = 3e-4 * np.random.default_rng(0).normal(size=(40, 3))
    found = load_recording(write(tmp_path / "a.csv", f"t,{POSE}", np.column_stack([TIMES, poses])))
    assert len(found.times) == NUMBER - 40


def test_a_rest_at_zero_is_kept(tmp_path: Path) -> None:
    times = np.arange(120) / 30
    rows = np.zeros((120, 8))
    rows[:, 0], rows[:, 7] = times, 1
    rows[:, 1] = 0.4 * np.clip((times - 1.4) / 0.25, 0, 1) - 0.06 * np.clip((times - 2) / 1.2, 0, 1)
    assert len(load_recording(write(tmp_path / "a.csv", f"t,{POSE}", rows)).times) == 120


def test_numbers_of_a_quaternion_are_in_the_order_of_the_file(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "t,x,y,z,q1,q2,q3,q0", np.column_stack([TIMES, ONE]))
    check(load_recording(path, quaternion="xyzw"), ONE)


def test_matrices_column_by_column_in_a_table_are_pointed_out(tmp_path: Path) -> None:
    turned = Rotation.from_quat(ONE[:, 3:]).as_matrix().swapaxes(1, 2).reshape(-1, 9)
    names = [f"c{i}" for i in range(9)]
    rows = np.column_stack([TIMES, ONE[:, :3], turned])
    path = write(tmp_path / "a.csv", f"t,x,y,z,{','.join(names)}", rows)
    found = load_recording(path, position="x,y,z", orientation=",".join(names))
    assert any("only if they are read column by column" in note for note in found.notes)


def test_whole_times_with_a_unit_are_no_frame_numbers(tmp_path: Path) -> None:
    turns = Rotation.from_quat(ONE[:, 3:]).as_matrix()
    rows = np.concatenate([turns, ONE[:, :3, None]], axis=2).reshape(NUMBER, 12)
    lines = [f"{20 * i} " + " ".join(f"{x:.8f}" for x in row) for i, row in enumerate(rows)]
    path = tmp_path / "a.txt"
    path.write_text("\n".join(lines) + "\n")
    assert load_recording(path, time_unit="ms").times[-1] == pytest.approx(TIMES[-1])

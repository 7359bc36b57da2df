"""Lost tracking that a file writes as numbers: left out, with rows and reason; a body at rest is not."""

import time
from pathlib import Path

import numpy as np
import pytest
from recording_files import HEADER, poses_of, write
from scipy.spatial.transform import Rotation

from reframe_jax.recordings.lost import find_lost_poses
from reframe_jax.recordings.reading import load_recording
from reframe_jax.recordings.recording import RecordingError

DATA = Path(__file__).parents[2] / "shared" / "data"
COUNT = 300


def hinge(rng: np.random.Generator, noise: float = 7e-5, count: int = COUNT) -> np.ndarray:
    """(count, 8) t, x, y, z, qx, qy, qz, qw of a body on a hinge, as it swings."""
    times = 0.02 * np.arange(count)
    axis = np.array([0.1, 0.2, 0.97]) / np.linalg.norm([0.1, 0.2, 0.97])
    turned = Rotation.from_rotvec(np.outer(0.5 + 1.2 * np.sin(1.3 * times), axis))
    turned = turned * Rotation.from_rotvec(noise * rng.normal(size=(count, 3)))
    places = [0.5, 0.3, 0.2] + turned.apply([0.4, 0.05, 0.1]) + noise * rng.normal(size=(count, 3))
    return np.column_stack([times, places, turned.as_quat()])


FILLS = {
    "origin": lambda rows, lost: rows.__setitem__((lost, slice(1, 4)), 0.0),
    "identity": lambda rows, lost: rows.__setitem__((lost, slice(1, 8)), [0, 0, 0, 0, 0, 0, 1]),
    "constant": lambda rows, lost: rows.__setitem__((lost, slice(1, 8)), [3, -2, 1, 0.5, 0.5, 0.5, 0.5]),
}


@pytest.mark.parametrize("kind", FILLS)
@pytest.mark.parametrize("length", [1, 2, 10, 40, 200])
@pytest.mark.parametrize("place", ["start", "middle", "end"])
def test_numbers_of_lost_tracking_are_left_out(
    tmp_path: Path, rng: np.random.Generator, kind: str, length: int, place: str
) -> None:
    if kind == "constant" and length == 1:
        pytest.skip("a single row that nothing repeats is an outlier")
    rows = hinge(rng)
    start = {"start": 0, "middle": 70, "end": COUNT - length}[place]
    lost = np.arange(start, start + length)
    FILLS[kind](rows, lost)
    recording = load_recording(write(tmp_path / "a.csv", HEADER, rows))
    kept = np.delete(rows, lost, axis=0)
    np.testing.assert_allclose(recording.poses, poses_of(kept), atol=1e-12)
    np.testing.assert_allclose(recording.times, kept[:, 0], atol=1e-12)
    (left_out,) = recording.left_out
    assert left_out.reason == kind
    np.testing.assert_array_equal(left_out.rows, lost + 2)  # lines, after a header
    assert recording.rows is not None
    np.testing.assert_array_equal(recording.rows, np.delete(np.arange(COUNT), lost) + 2)
    (note,) = recording.notes
    assert f"{start + 2}" in note
    assert "left out, as tracking was lost" in note


def test_jumps_are_named(tmp_path: Path, rng: np.random.Generator) -> None:
    rows = hinge(rng)
    FILLS["origin"](rows, np.arange(100, 140))
    (note,) = load_recording(write(tmp_path / "a.csv", HEADER, rows)).notes
    assert note.startswith(
        "lines 102-141 (40 rows) left out, as tracking was lost: the position is 0, 0, 0; "
    )
    assert note.endswith(" m at line 102 and back at line 142.")


def test_losses_here_and_there_are_left_out(rng: np.random.Generator) -> None:
    """Of a third of the rows, in runs of any length, with several numbers."""
    rows = hinge(rng)
    lost = np.flatnonzero(np.repeat(rng.random(COUNT // 3) < 0.33, 3))
    FILLS["origin"](rows, lost[lost < 150])
    FILLS["identity"](rows, lost[lost >= 150])
    np.testing.assert_array_equal(np.flatnonzero(find_lost_poses(poses_of(rows), rows[:, 0]) != ""), lost)
    single = hinge(rng)
    FILLS["constant"](single, np.arange(5, COUNT, 7))
    found = find_lost_poses(poses_of(single), single[:, 0])
    np.testing.assert_array_equal(np.flatnonzero(found != ""), np.arange(5, COUNT, 7))
    assert set(found) == {"", "constant"}


def add_noise(rng: np.random.Generator, rows: np.ndarray, where: np.ndarray, noise: float) -> None:
    """To some rows, as of filters and of gyroscopes that go on."""
    rows[where, 1:4] += noise * rng.normal(size=(len(where), 3))
    turns = Rotation.from_rotvec(noise * rng.normal(size=(len(where), 3)))
    rows[where, 4:] = (Rotation.from_quat(rows[where, 4:]) * turns).as_quat()


@pytest.mark.parametrize("kind", FILLS)
@pytest.mark.parametrize("noise", [1e-8, 1e-5, 1e-3])
@pytest.mark.parametrize("starts", [(70,), (40, 120, 230), (0, 150, COUNT - 25)])
def test_numbers_of_lost_tracking_with_noise_are_left_out(
    tmp_path: Path, rng: np.random.Generator, kind: str, noise: float, starts: tuple[int, ...]
) -> None:
    rows = hinge(rng)
    lost = np.concatenate([np.arange(start, start + 25) for start in starts])
    FILLS[kind](rows, lost)
    add_noise(rng, rows, lost, noise)
    recording = load_recording(write(tmp_path / "a.csv", HEADER, rows))
    (left_out,) = recording.left_out
    assert left_out.reason == kind
    np.testing.assert_array_equal(left_out.rows, lost + 2)
    (note,) = recording.notes
    words = {"origin": "position is close to 0, 0, 0", "identity": "pose is close to the identity"}
    assert words.get(kind, "pose is a constant distant from the others") in note


@pytest.mark.parametrize("kind", FILLS)
@pytest.mark.parametrize("noise", [1e-5, 1e-3])
def test_a_number_with_noise_is_lost_everywhere_also_beside_a_rest(
    rng: np.random.Generator, kind: str, noise: float
) -> None:
    rows = hinge(rng)
    rows[110:, 1:], rows[40:110, 1:] = rows[40:-70, 1:].copy(), rows[40, 1:].copy()  # a rest
    add_noise(rng, rows, np.arange(40, 110), 1e-4)
    lost = np.concatenate([np.arange(start, start + 20) for start in (30, 70, 150, 240)])
    FILLS[kind](rows, lost)
    add_noise(rng, rows, lost, noise)
    found = find_lost_poses(poses_of(rows), rows[:, 0])
    np.testing.assert_array_equal(np.flatnonzero(found != ""), lost)
    assert set(found[lost]) == {kind}


def test_numbers_far_away_do_not_make_the_path_lost(rng: np.random.Generator) -> None:
    """One coordinate is 999 while the others go on, in more than a tenth of the rows."""
    times = 0.02 * np.arange(COUNT)
    turned = Rotation.from_rotvec(np.outer(0.3 * np.sin(8 * times), [0, 0, 1]))
    rows = np.column_stack([times, turned.apply([0.4, 0.05, 0.1]), turned.as_quat()])
    add_noise(rng, rows, np.arange(COUNT), 1e-4)
    rows[100:140, 1] = 999
    found = find_lost_poses(poses_of(rows), times) != ""
    assert not np.delete(found, np.arange(100, 140)).any()


@pytest.mark.parametrize("noise", [1e-5, 1e-4, 1e-3])
def test_frozen_poses_with_noise_are_left_out(rng: np.random.Generator, noise: float) -> None:
    rows = hinge(rng)
    for start in (100, 200):
        rows[start : start + 25, 1:] = rows[start - 1, 1:]
        add_noise(rng, rows, np.arange(start, start + 25), noise)
    found = find_lost_poses(poses_of(rows), rows[:, 0])
    np.testing.assert_array_equal(np.flatnonzero(found != "") % 100, np.tile(np.arange(25), 2))
    assert set(found) == {"", "frozen"}


@pytest.mark.parametrize("noise", [0.0, 1e-5, 1e-4, 5e-4])
def test_frozen_poses_are_left_out_if_the_body_turned_back_meanwhile(
    rng: np.random.Generator, noise: float
) -> None:
    """The jump is less than three steps long, but no body starts with such a step."""
    rows, lost = hinge(rng, noise=1e-5), np.arange(46, 73)
    rows[lost, 1:] = rows[45, 1:]
    add_noise(rng, rows, lost, noise)
    found = find_lost_poses(poses_of(rows), rows[:, 0])
    np.testing.assert_array_equal(np.flatnonzero(found != ""), lost)
    assert set(found[lost]) == {"frozen"}


@pytest.mark.parametrize("noise", [0.0, 1e-5, 1e-3])
@pytest.mark.parametrize("step", [0.1, 0.2])
def test_a_fast_move_between_two_rests_is_not_lost(
    rng: np.random.Generator, noise: float, step: float
) -> None:
    """Of a robot that takes two to five samples from each place to the next."""
    times = step * np.arange(200)
    phase = np.clip((times % 2.0) / 0.45, 0, 1)
    moved = 10 * phase**3 - 15 * phase**4 + 6 * phase**5
    angle = times // 2.0 + moved
    turned = Rotation.from_rotvec(np.outer(0.7 * np.sin(2.2 * angle), [0, 0, 1.0]))
    rows = np.column_stack([times, turned.apply([0.4, 0.05, 0.1]), turned.as_quat()])
    add_noise(rng, rows, np.arange(len(rows)), noise)
    assert (find_lost_poses(poses_of(rows), times) == "").all()


@pytest.mark.parametrize("noise", [1e-6, 1e-4, 1e-3])
def test_bodies_that_rest_with_noise_are_not_lost(rng: np.random.Generator, noise: float) -> None:
    """On their path, for several times, and between touches that are written for a while."""
    rows = hinge(rng, 0)
    rested = np.insert(
        rows, np.repeat([60, 150, 222], 40), np.repeat(rows[[60, 150, 222]], 40, axis=0), axis=0
    )
    touched = np.repeat(rows[::20], 15, axis=0)
    for motion in (rested, touched):
        motion[:, 0] = 0.02 * np.arange(len(motion))
        add_noise(rng, motion, np.arange(len(motion)), noise)
        assert (find_lost_poses(poses_of(motion), motion[:, 0]) == "").all()


@pytest.mark.parametrize("noise", [1e-6, 1e-4, 1e-3])
@pytest.mark.parametrize("step", [0.01, 0.05])
def test_bodies_that_start_fast_after_a_rest_are_not_lost(
    rng: np.random.Generator, noise: float, step: float
) -> None:
    """From rest to 1.5 m/s within 0.25 s, and back to rest."""
    times = step * np.arange(300)
    phase = np.clip((times % 2.0 - 1) / 0.5, 0, 1)
    moved = 10 * phase**3 - 15 * phase**4 + 6 * phase**5
    angle = np.where(times % 4 < 2, moved, 1 - moved)
    turned = Rotation.from_rotvec(np.outer(angle, [0, 0, 1.0]))
    rows = np.column_stack([times, turned.apply([0.4, 0.05, 0.1]), turned.as_quat()])
    add_noise(rng, rows, np.arange(len(rows)), noise)
    assert (find_lost_poses(poses_of(rows), times) == "").all()


@pytest.mark.parametrize("rounding", [1e-4, 1e-3])
@pytest.mark.parametrize("step", [0.02, 0.05, 0.1])
def test_a_robot_that_comes_to_rest_for_good_is_not_lost(
    rng: np.random.Generator, rounding: float, step: float
) -> None:
    """From 0.5 m/s within 0.25 s, with rounded numbers, which then repeat."""
    times = step * np.arange(int(12 / step))
    rest = np.clip(times - 6, 0, 0.25)
    moved = np.minimum(times, 6) * 0.5 + 0.5 * rest - rest**2
    turned = Rotation.from_rotvec(np.outer(np.round(0.9 * moved, 4), [0, 0.6, 0.8]))
    places = np.round(
        [0.5, 0, 0.3] + 0.6 * np.cos(np.outer(moved, [1.0, 0.7, 0.4])), -int(np.log10(rounding))
    )
    rows = np.column_stack([times, places, turned.as_quat()])
    assert (rows[-5:, 1:] == rows[-1, 1:]).all()
    assert (find_lost_poses(poses_of(rows), times) == "").all()


@pytest.mark.parametrize("length", [4, 10, 40])
@pytest.mark.parametrize("start", [20, 100, COUNT])
def test_frozen_poses_are_left_out(rng: np.random.Generator, length: int, start: int) -> None:
    """While the body moves; the first of the equal poses is one."""
    rows = hinge(rng)
    start = min(start, COUNT - length)
    rows[start : start + length, 1:] = rows[start - 1, 1:]
    found = find_lost_poses(poses_of(rows), rows[:, 0])
    np.testing.assert_array_equal(np.flatnonzero(found != ""), np.arange(start, start + length))
    assert set(found[start : start + length]) == {"end" if start + length == COUNT else "frozen"}


@pytest.mark.parametrize("length", [4, 10, 40])
@pytest.mark.parametrize("fill", [*FILLS, "missing"])
def test_poses_that_freeze_before_others_are_missing(
    rng: np.random.Generator, length: int, fill: str
) -> None:
    """As of a headset that repeats the last pose for a while, and then writes another number, or none."""
    rows, stop = hinge(rng), 100 + length
    rows[100:stop, 1:] = rows[99, 1:]
    if fill == "missing":
        rows[stop : stop + 50, 1] = np.nan
    else:
        FILLS[fill](rows, np.arange(stop, stop + 50))
    found = find_lost_poses(poses_of(rows), rows[:, 0])
    np.testing.assert_array_equal(np.flatnonzero(found != ""), np.arange(100, stop + 50))
    assert set(found[100:stop]) == {"frozen"}
    assert set(found[stop : stop + 50]) == {fill}


def test_long_recordings_of_held_samples_take_no_longer_than_others(rng: np.random.Generator) -> None:
    rows = hinge(rng, count=200_000)
    rows[:, 1:] = np.repeat(rows[::2, 1:], 2, axis=0)
    start = time.perf_counter()
    assert (find_lost_poses(poses_of(rows), rows[:, 0]) == "").all()
    assert time.perf_counter() - start < 20  # s; 1 here


@pytest.mark.parametrize("noise", [2e-4, 1e-3, 2e-3])
def test_noise_does_not_hide_a_frozen_end(rng: np.random.Generator, noise: float) -> None:
    rows = hinge(rng, noise)
    rows[150:, 1:] = rows[149, 1:]
    np.testing.assert_array_equal(find_lost_poses(poses_of(rows)) != "", np.arange(COUNT) >= 150)


@pytest.mark.parametrize(("part", "columns"), [("position", slice(1, 4)), ("orientation", slice(4, 8))])
@pytest.mark.parametrize("start", [100, COUNT - 40])
def test_half_a_pose_that_is_frozen_is_none(
    tmp_path: Path, rng: np.random.Generator, part: str, columns: slice, start: int
) -> None:
    """As of a headset that loses its cameras and keeps its gyroscope."""
    rows = hinge(rng)
    rows[start : start + 40, columns] = rows[start - 1, columns]
    recording = load_recording(write(tmp_path / "a.csv", HEADER, rows))
    (left_out,) = recording.left_out
    np.testing.assert_array_equal(left_out.rows, np.arange(start, start + 40) + 2)
    assert f"tracking was lost: the {'last' if start > 100 else 'previous'} {part} " in recording.notes[0]
    rows[start : start + 40, 4:] = [0, 0, 0, 1]
    found = find_lost_poses(poses_of(rows), rows[:, 0]) != ""
    assert found[start : start + 40].all()
    assert found.sum() == 40


@pytest.mark.parametrize("where", [0, 100, COUNT])
@pytest.mark.parametrize("noise", [0.0, 7e-5])
def test_a_body_at_rest_is_not_lost(rng: np.random.Generator, where: int, noise: float) -> None:
    """The path stops and goes on from there: with exact repeats, as from the controller of a robot."""
    rows = hinge(rng, noise)
    row = min(where, COUNT - 1)
    if noise and where == COUNT:
        pytest.skip("exact repeats at the end of a noisy motion are a frozen pose")
    rested = np.insert(rows, [row] * 50, rows[row], axis=0)
    rested[:, 0] = 0.02 * np.arange(len(rested))
    assert (find_lost_poses(poses_of(rested), rested[:, 0]) == "").all()


def test_poses_relative_to_the_first_start_at_the_identity(rng: np.random.Generator) -> None:
    poses = poses_of(hinge(rng))
    own = np.linalg.inv(poses[0]) @ poses
    assert (find_lost_poses(own) == "").all()
    own[100:140] = np.eye(4)
    np.testing.assert_array_equal(np.flatnonzero(find_lost_poses(own) != ""), np.arange(100, 140))


def test_motions_that_keep_a_number_are_poses(rng: np.random.Generator) -> None:
    """A ball that turns about the origin, a drawer that does not turn, held samples, coarse numbers."""
    rows = hinge(rng)
    ball, drawer, held = rows.copy(), rows.copy(), rows.copy()
    ball[:, 1:4], drawer[:, 4:] = 0, [0, 0, 0, 1]
    held[:, 1:] = np.repeat(rows[::4, 1:], 4, axis=0)
    noisy = hinge(rng, 1e-3)
    noisy[:, 1:] = np.repeat(noisy[::5, 1:], 5, axis=0)
    coarse = np.column_stack([rows[:, :1], np.round(rows[:, 1:4], 2), rows[:, 4:]])
    quantized, spikes = drawer.copy(), drawer.copy()
    quantized[rng.random(COUNT) < 0.5, 4:] = Rotation.from_rotvec([0, 0, 1e-3]).as_quat()
    spikes[5::9, 4:] = Rotation.from_rotvec(1e-6 * rng.normal(size=(len(spikes[5::9]), 3))).as_quat()
    for motion in (ball, drawer, held, noisy, coarse, quantized, spikes):
        assert (find_lost_poses(poses_of(motion), motion[:, 0]) == "").all()


@pytest.mark.parametrize("every", [3, 4, 5])
def test_rows_that_are_written_twice_in_a_fast_part_are_no_constants(
    rng: np.random.Generator, every: int
) -> None:
    pace = np.full(COUNT, 0.01)
    pace[150:180] = 0.2
    angles = 0.5 * np.sin(np.cumsum(pace))
    turned = Rotation.from_rotvec(np.outer(angles, [0.1, 0.3, 0.95]))
    rows = np.column_stack([0.02 * np.arange(COUNT), turned.apply([0.4, 0.1, 0.2]), turned.as_quat()])
    add_noise(rng, rows, np.arange(COUNT), 1e-4)
    twice = np.arange(151, 180, every)
    rows[twice, 1:] = rows[twice - 1, 1:]
    found = find_lost_poses(poses_of(rows), rows[:, 0])
    assert not (found == "constant").any()


def test_touches_are_poses_and_zeros_between_them_are_not(rng: np.random.Generator) -> None:
    turned = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, (14, 3))) * Rotation.from_rotvec([np.pi, 0, 0])
    places = [0.25, -0.88, 0.04] - turned.apply([0.005, 0.095, 0.308])
    rows = np.column_stack([np.arange(14.0), places, turned.as_quat()])
    assert (find_lost_poses(poses_of(rows), rows[:, 0]) == "").all()
    rows[[3, 8], 1:] = [0, 0, 0, 0, 0, 0, 1]
    assert np.flatnonzero(find_lost_poses(poses_of(rows), rows[:, 0]) != "").tolist() == [3, 8]


def test_numbers_that_are_not_finite_are_no_poses(rng: np.random.Generator) -> None:
    poses = poses_of(hinge(rng))
    poses[7, 0, 3] = np.nan
    found = find_lost_poses(poses)
    assert (np.flatnonzero(found != "").tolist(), found[7]) == ([7], "missing")


def test_recordings_of_too_few_poses_are_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    rows = hinge(rng)
    FILLS["origin"](rows, np.arange(6, COUNT))
    with pytest.raises(
        RecordingError, match=r"only 6 of 300 poses are left; lines 8-301 .* tracking was lost"
    ):
        load_recording(write(tmp_path / "a.csv", HEADER, rows))


def test_jumps_that_stay_are_noted(tmp_path: Path, rng: np.random.Generator) -> None:
    rows = hinge(rng)
    flipped = rows.copy()
    flipped[100:103, 4:] = flipped[100:103, 4:][:, [3, 2, 1, 0]] * [1, 1, -1, -1]  # by half a turn
    (note,) = load_recording(write(tmp_path / "a.csv", HEADER, flipped)).notes
    assert note.startswith("the pose jumps 180 deg at line 102 and back at line 105; ")
    rows[100:103, 1:4] += [0.9, 0, 0]
    (note,) = load_recording(write(tmp_path / "a.csv", HEADER, rows)).notes
    assert note.startswith("the pose jumps 0.91 m at line 102 and back at line 105; ")
    rows[103:160, 1:4] += [0.9, 0, 0]  # while the body moves on
    (note,) = load_recording(write(tmp_path / "a.csv", HEADER, rows)).notes
    assert note.startswith("the pose jumps 0.91 m at line 102 and back at line 162; ")
    rows[160:, 1:4] += [0.9, 0, 0]
    (note,) = load_recording(write(tmp_path / "a.csv", HEADER, rows)).notes
    assert note.endswith(
        "at line 102; if tracking was lost there, or a marker slipped, cut the recording there."
    )


def test_jumps_of_a_few_steps_are_noted_and_fast_moves_are_not(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    rows = hinge(rng)
    assert not load_recording(write(tmp_path / "a.csv", HEADER, rows)).notes
    rows[100:, 1:4] += [0.06, 0, 0]  # five steps of the path
    (note,) = load_recording(write(tmp_path / "a.csv", HEADER, rows)).notes
    assert note.startswith("the pose jumps ")
    assert " mm at line 102; " in note
    rested = np.concatenate([np.repeat(rows[:1], 250, axis=0), rows[:50]])
    rested[:, 0] = rows[:, 0]
    add_noise(rng, rested, np.arange(COUNT), 1e-5)
    assert not load_recording(write(tmp_path / "a.csv", HEADER, rested)).notes


@pytest.mark.skipif(not DATA.is_dir(), reason="needs the small inputs in ../shared/data/cases")
@pytest.mark.parametrize(
    ("name", "lines"), [("lost_origin_40", (102, 141)), ("lost_identity_30", (102, 131))]
)
def test_the_cases(name: str, lines: tuple[int, int]) -> None:
    (left_out,) = load_recording(DATA / "cases" / f"{name}.csv").left_out
    np.testing.assert_array_equal(left_out.rows, np.arange(lines[0], lines[1] + 1))


def test_a_motion_that_starts_at_the_origin_is_not_lost_before_an_outlier():
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :3, 3] = np.outer(0.2 * np.sin(np.arange(40) / 8), [1, 0, 0]) + 1e-4 * rng.normal(size=(40, 3))
    poses[7, :3, 3] += 0.5
    assert (find_lost_poses(poses) == "").all()


@pytest.mark.parametrize("distance", [1e3, 1e30])
def test_a_distant_outlier_does_not_make_other_rows_lost(rng: np.random.Generator, distance: float) -> None:
    rows = hinge(rng)
    rows[100, 1] = distance
    with np.errstate(over="ignore"):
        assert not np.delete(find_lost_poses(poses_of(rows), rows[:, 0]) != "", 100).any()


def test_rows_at_a_great_distance_are_left_out_in_a_sixth_of_a_recording(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    rows = hinge(rng)
    rows[100:150, 1] = 999  # one coordinate is lost
    recording = load_recording(write(tmp_path / "a.csv", HEADER, rows))
    (left_out,) = recording.left_out
    assert left_out.reason == "far"
    np.testing.assert_array_equal(left_out.rows, np.arange(100, 150) + 2)

"""Recordings of cameras, markers and trackers, identified with nothing but the defaults."""

from pathlib import Path

import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.geometry.rotations import rotation_exp

DATA = Path(__file__).parent.parent.parent / "shared" / "data"

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="needs the real recordings, in ../shared/data")


def identify(name: str, **options) -> tuple[rf.Recording, rf.Identification]:
    recording = rf.load_recording(DATA / f"{name}.csv")
    return recording, rf.identify(recording.poses, times=recording.times, **options)


def fit_circle(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre and axis of the circle through points that a few outliers may spoil."""
    kept = points
    for _ in range(10):
        middle = np.median(kept, axis=0)
        normal = np.linalg.svd(kept - middle)[2][2]
        basis = np.linalg.svd(kept - middle)[2][:2]
        flat = (kept - middle) @ basis.T
        design = np.column_stack([2 * flat, np.ones(len(flat))])
        solution = np.linalg.lstsq(design, np.sum(flat**2, axis=1), rcond=None)[0]
        centre = middle + solution[:2] @ basis
        radius = np.sqrt(solution[2] + solution[:2] @ solution[:2])
        away = (points - centre) @ normal
        inside = points - centre - np.outer(away, normal)
        error = np.hypot(np.linalg.norm(inside, axis=1) - radius, away)
        kept = points[error < 4 * np.median(error)]
    return centre, normal


def angle_between(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), abs(a @ b))))


@pytest.mark.parametrize("number", [389, 391, 403])
def test_doors_turn_about_the_axis_of_their_circle(number: int) -> None:
    recording, found = identify(f"kitchen_door_{number}")
    assert found.name == "Revolute joint"
    centre, normal = fit_circle(recording.poses[:, :3, 3])
    # the angular types are tied for a hinge: take the ground's
    axis = rotation_exp(found.candidates.angular.rotvec[rf.AngularType.G])[:, 2]
    assert angle_between(np.asarray(axis), normal) < 3
    assert found.linear.frame_type in (rf.LinearType.GG, rf.LinearType.BG)
    offset = np.asarray(found.linear.position) - centre
    assert np.linalg.norm(np.cross(normal, offset)) < 0.015


@pytest.mark.parametrize("name", ["pouring", "grating_0", "wiping_1"])
def test_hands_that_move_fast_do_not_jump(name: str) -> None:
    assert np.all(identify(name)[1].counted)


def test_error_bars_of_half_a_recording_hold_the_other_half() -> None:
    """Slow errors are part of them: otherwise none of these would."""
    scores = []
    for name in ("kitchen_door_389", "kitchen_door_403", "champ_microwave_with_grasp"):
        recording = rf.load_recording(DATA / f"{name}.csv")
        middle = len(recording.times) // 2
        halves = [(recording.poses[part], recording.times[part]) for part in np.s_[:middle, middle:]]
        found = [rf.identify(poses, times=times) for poses, times in halves]
        for one, other, (poses, times) in zip(found, found[::-1], halves, strict=True):
            assert one.name == "Revolute joint"
            covariance = rf.covariance(one, poses, times=times)
            assert np.max(covariance.inflation) > 2
            assert "such as tracker drift" in one.explain(covariance)
            axis = np.asarray(one.angular.axes)[:, 2]
            its_axis = np.asarray(rotation_exp(other.candidates.angular.rotvec[int(one.angular.type_code)]))[
                :, 2
            ]
            its_axis = its_axis * np.sign(axis @ its_axis)
            origin = np.asarray(other.candidates.linear.position)[int(one.linear.type_code)]
            offset = origin - np.asarray(one.linear.position)
            offset = offset - np.asarray(one.linear.free_position) @ offset
            for error, matrix in (
                (np.cross(axis, its_axis), covariance.angular_axes),
                (offset, covariance.position),
            ):
                variances, directions = np.linalg.eigh(np.asarray(matrix, float))
                known = variances > 1e-6 * variances[-1]
                scores += [*np.abs(error @ directions)[known] / np.sqrt(variances[known])]
    assert len(scores) >= 20
    assert np.mean(np.array(scores) < 1.96) >= 0.8


@pytest.mark.parametrize("number", [394, 407])
def test_drawers_slide_along_their_line_although_their_orientation_wanders(number: int) -> None:
    recording, found = identify(f"kitchen_drawer_{number}")
    assert found.name == "Prismatic joint"
    # poses with an orientation unlike both of its neighbours are left out, and few others
    counted, rotation = np.asarray(found.counted), recording.poses[:, :3, :3]
    cosine = (np.einsum("kij,kij->k", rotation[1:], rotation[:-1]) - 1) / 2
    turned = np.arccos(np.clip(cosine, -1, 1))
    flipped = np.minimum(turned[1:], turned[:-1]) > np.radians(8)
    assert flipped.any()
    assert not counted[1:-1][flipped].any()
    assert np.sum(~counted) < 20
    positions = recording.poses[counted, :3, 3]
    line = np.linalg.svd(positions - positions.mean(axis=0))[2][0]
    assert angle_between(np.asarray(found.linear.axes)[:, 2], line) < 0.7


def test_a_slow_cabinet_is_a_hinge() -> None:
    _, found = identify("champ_microwave_with_grasp")
    assert found.name == "Revolute joint"


@pytest.mark.parametrize("name", ["contour_a_1", "contour_b_1"])
def test_a_tool_on_a_contour_has_one_point_at_every_scale(name: str) -> None:
    recording, default = identify(name)
    assert default.linear.frame_type == rf.LinearType.BB
    assert (int(default.angular.dof.sum()), int(default.linear.dof.sum())) == (3, 1)
    assert default.probability > 0.7
    # as many poses of each recording, so that both need the same programs
    poses, times = recording.poses[:160], recording.times[:160]
    found = [rf.identify(poses, times=times, scales=h) for h in (4, 8)]
    points = [np.asarray(each.candidates.linear.position)[0] for each in found]
    assert np.max(np.linalg.norm(points - np.mean(points, axis=0), axis=1)) < 3e-3


@pytest.mark.parametrize("name", ["pouring", "wiping_0", "grating_0"])
def test_free_motion_is_unconstrained(name: str) -> None:
    _, found = identify(name)
    assert found.name.startswith("Unconstrained")

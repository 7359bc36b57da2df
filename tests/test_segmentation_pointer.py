"""A pointer that pivots on eight points: eight spherical joints, with free motion between."""

import jax
import numpy as np
import pytest

import reframe_jax as rf
from benchmarks.pointer import PointerSimulation, simulate_pointer
from reframe_jax.simulation.motions import PoseErrors

POINTS = np.random.default_rng(2).uniform(-0.2, 0.2, (8, 3))


def pointer(sigma: float) -> PointerSimulation:
    """With the noise of an optical tracker; m."""
    return simulate_pointer(POINTS, jax.random.key(2), errors=PoseErrors(sigma=sigma, rotation_ratio=5.0))


def fitted_pivot(poses: np.ndarray) -> np.ndarray:
    """The point in the ground, m, that a point of the body keeps to: least squares over R tip + x = point."""
    rotation, position = poses[:, :3, :3], poses[:, :3, 3]
    design = np.concatenate([rotation.reshape(-1, 3), np.tile(-np.eye(3), (len(poses), 1))], axis=1)
    return np.linalg.lstsq(design, -position.reshape(-1), rcond=None)[0][3:]


def origin_in_ground(segment: rf.Segment, poses: np.ndarray) -> np.ndarray:
    assert segment.identification is not None
    linear = segment.identification.linear
    position = np.asarray(linear.position)
    if rf.LinearType(int(linear.type_code)) in (rf.LinearType.GG, rf.LinearType.BG):
        return position
    own = poses[segment.start : segment.stop]
    return np.mean(own[:, :3, :3] @ position + own[:, :3, 3], axis=0)


@pytest.mark.parametrize("sigma", [1e-4, 3e-4])
def test_each_point_is_a_spherical_joint(sigma: float) -> None:
    truth = pointer(sigma)
    poses, times = np.asarray(truth.poses), np.asarray(truth.times)
    found = rf.segment(poses, times=times)
    joints = [segment for segment in found.segments if segment.name == "Spherical joint"]
    assert len(joints) == len(POINTS)
    assert len(found.moving) == 2 * len(POINTS) + 1
    # one tip: the same frame in the body explains the motion about all of the points
    assert len({segment.label for segment in joints}) == 1
    for segment, (start, stop) in zip(joints, truth.dwells, strict=True):
        assert abs(times[segment.start] - times[start]) < 0.3
        assert abs(times[segment.stop - 1] - times[stop - 1]) < 0.3
        pivot = fitted_pivot(poses[start:stop])
        assert np.linalg.norm(origin_in_ground(segment, poses) - pivot) < 1e-3


def test_the_tip_dwells_at_the_points_and_moves_between() -> None:
    truth = pointer(1e-4)
    exact = np.asarray(truth.exact_poses)
    tip = exact[:, :3, :3] @ np.asarray(truth.tip) + exact[:, :3, 3]
    for (start, stop), point in zip(truth.dwells, POINTS, strict=True):
        assert np.allclose(tip[start:stop], point, atol=1e-6)
        assert np.linalg.norm(tip[stop + 5] - point) > 1e-4
    assert len(truth.times) == len(exact)
    noise = np.asarray(truth.poses)[:, :3, 3] - exact[:, :3, 3]
    assert np.std(noise) == pytest.approx(1e-4, rel=0.1)


def test_wrong_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match=r"points must have shape \(P, 3\)"):
        simulate_pointer(POINTS[0], jax.random.key(0))
    with pytest.raises(ValueError, match="must be positive"):
        simulate_pointer(POINTS, jax.random.key(0), dwell=0.0)

"""The axis of a hinge that a tracker sees: the plane of the positions tells it better than the rotations."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import reframe_jax as rf
from reframe_jax.geometry.transforms import make_pose

POSES, TILT = 121, np.radians(3.0)


def recorded(angle: float, wander: float, lever: float = 0.5, slide: float = 0.0) -> np.ndarray:
    """A body on a hinge along z, whose orientation is seen with an error that follows the angle."""
    rng, share = np.random.default_rng(7), (1 - np.cos(np.linspace(0, np.pi, POSES))) / 2
    turned = Rotation.from_rotvec(np.outer(angle * share, [0.0, 0.0, 1.0]))
    wrong = wander * np.stack([share, np.sin(2 * np.pi * share), 0.5 * share**2], axis=1)
    seen = Rotation.from_rotvec(wrong + rng.normal(0, 2e-3, (POSES, 3))) * turned
    position = lever * np.stack([np.cos(angle * share), np.sin(angle * share), slide * share], axis=1)
    return np.asarray(make_pose(seen.as_matrix(), position + rng.normal(0, 3e-4, (POSES, 3))))


def axes_of(poses: np.ndarray) -> tuple[rf.Identification, float, float]:
    """The identification, and how far its axis is from z in the ground and in the body, degrees."""
    found = rf.identify(poses, dt=0.05)
    turns = Rotation.from_rotvec(np.array(found.candidates.angular.rotvec)).as_matrix()[:, :, 2]
    z = np.array([0.0, 0.0, 1.0])
    mean = Rotation.from_matrix(poses[:, :3, :3]).mean().inv().apply(z)
    ground, body = (
        float(np.degrees(np.arccos(min(1.0, abs(a @ b))))) for a, b in zip(turns, (z, mean), strict=True)
    )
    return found, ground, body


def test_the_plane_of_the_positions_corrects_the_axis():
    """Errors of 3 degrees in the orientation tilt the axis of the rotations by about as much."""
    found, ground, body = axes_of(recorded(1.2, TILT))
    assert found.name == "Revolute joint"
    assert not found.refined
    assert ground < 0.4
    assert body < 1.5
    for rotvec in found.candidates.angular.rotvec:
        assert np.all(np.isfinite(rotvec))


def test_without_a_lever_the_rotations_decide():
    """Positions that stay in place have no plane."""
    _, far, _ = axes_of(recorded(1.2, TILT))
    _, near, _ = axes_of(recorded(1.2, TILT, lever=1e-4))
    assert far < 0.4 < 1 < near < 6


@pytest.mark.parametrize("slide", [0.3, 1.0])
def test_a_body_that_slides_along_its_axis_has_no_such_plane(slide):
    """A nut on a screw: the plane is not across the axis, and the rotations decide."""
    found, ground, _ = axes_of(recorded(1.2, 2e-3, slide=slide))
    assert found.angular.dof.sum() == 1
    assert ground < 0.3

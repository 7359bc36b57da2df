"""A tool that wipes a plane, seen by trackers whose errors depend on where it is and how it is turned."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import reframe_jax as rf

DT = 0.05
TIMES = DT * np.arange(200)
TRACKERS = {"robot": (3e-5, 3e-5, 5e-5, 1e-4), "motion capture": (2e-4, 1e-3, 2e-4, 2e-3)}
"""White and slow errors of positions (m) and orientations (rad)."""


def wiping(seed, tracker, spin):
    """Circles on a plane, which drift; poses (200, 4, 4), and the normal of the plane."""
    rng = np.random.default_rng(seed)
    normal, *along = np.linalg.qr(rng.normal(size=(3, 3)))[0].T
    phase, drift = 2 * np.pi * rng.uniform(0.3, 0.8) * TIMES, rng.uniform(0.04, 0.1, size=2)
    waves = [np.sin(2 * np.pi * 0.15 * TIMES + rng.uniform(0, 6)) for _ in range(2)]
    place = 0.1 * np.outer(np.cos(phase), along[0]) + 0.1 * np.outer(np.sin(phase), along[1])
    place += drift[0] * np.outer(waves[0], along[0]) + drift[1] * np.outer(waves[1], along[1])
    angle = spin * np.sin(2 * np.pi * 0.25 * TIMES + rng.uniform(0, 6))
    turned = Rotation.from_rotvec(np.outer(angle, normal))
    position = place + turned.apply(rng.normal(0, 0.08, 3))
    white, white_turn, slow, slow_turn = TRACKERS[tracker]
    seen = np.concatenate([position / 0.3, turned.as_rotvec()], axis=1)

    def field():  # smooth in the pose, of size one
        waves = np.cos(seen @ rng.normal(size=(6, 12)) + rng.uniform(0, 6, 12))
        return waves @ rng.normal(size=(12, 3)) / 6**0.5

    position = position + slow * field() + white * rng.normal(size=(200, 3))
    noise = slow_turn * field() + white_turn * rng.normal(size=(200, 3))
    poses = np.tile(np.eye(4), (200, 1, 1))
    poses[:, :3, 3] = position
    poses[:, :3, :3] = (Rotation.from_rotvec(noise) * turned * Rotation.from_rotvec([0.5, 1, 0])).as_matrix()
    return poses, normal


def identify(windows):
    """One by one: most tests of single windows share their program."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *(rf.identify(poses, dt=DT) for poses in windows))


@pytest.mark.parametrize("tracker", TRACKERS)
@pytest.mark.parametrize(
    ("spin", "name"), [(0.4, "Plane-plane contact"), (0.0, "Unnamed: 0 rotations, 2 translations")]
)
def test_it_stays_in_the_plane(tracker, spin, name):
    """No origin is far enough away to make it a hinge, or to hide in noise how far it went."""
    made = [wiping(seed, tracker, spin) for seed in range(12)]
    found = identify([poses for poses, _ in made])
    right = found.name == name
    assert np.sum(right) >= 11
    assert np.all(found.probability[~right] < 0.7)
    in_ground = np.isin(found.linear.type_code, [rf.LinearType.GB, rf.LinearType.GG])
    axes = Rotation.from_rotvec(np.array(found.linear.rotvec)).as_matrix()[:, :, 0]
    cosine = np.abs(np.sum(axes * np.array([normal for _, normal in made]), axis=1))
    assert np.degrees(np.arccos(np.minimum(cosine, 1)))[in_ground & right].max(initial=0) < 1


@pytest.mark.parametrize("tilt", [0.01, 0.02])
def test_errors_of_orientation_that_follow_the_path_are_no_pivot_far_away(tilt):
    """A tilt by so many rad for each metre of path is what a pivot 100 or 50 m away would do."""
    poses = []
    for seed in range(12):
        made, normal = wiping(seed, "motion capture", 0.4)
        path = made[:, :3, 3] - made[:, :3, 3].mean(axis=0)
        lean = Rotation.from_rotvec(tilt * np.cross(normal, path))
        made[:, :3, :3] = lean.as_matrix() @ made[:, :3, :3]
        poses.append(made)
    found = identify(poses)
    names = list(found.name)
    assert names.count("Plane-plane contact") >= 11, names
    assert set(found.status_code.tolist()) == {rf.Status.OK}

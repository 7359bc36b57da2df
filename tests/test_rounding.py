"""A coordinate that rounding made constant is known no better than the others."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import reframe_jax as rf
from reframe_jax.motion.noise import unit_of_rounding
from reframe_jax.simulation import synthetic

LEVEL = Rotation.from_rotvec([np.pi / 2, 0, 0]).as_matrix()  # the paper's planar motions turn about y


def level_windows(noise):
    """Poses (8, 51, 4, 4) of E, whose plane is level."""
    simulate = jax.jit(jax.vmap(lambda key: synthetic.simulate("E", key, noise=noise).poses))
    poses = np.array(simulate(jax.random.split(jax.random.key(4), 8)))
    poses[:, :, :3] = LEVEL @ poses[:, :, :3]
    return poses


def test_trackers_that_measure_in_a_plane_only():
    """What never changes says nothing about the noise of the rest."""
    poses, rng = level_windows(0.0), np.random.default_rng(2)
    turn = poses[:, :, :3, :3] @ LEVEL.T
    yaw = np.arctan2(turn[..., 1, 0], turn[..., 0, 0]) + 3e-3 * rng.normal(size=(8, 51))
    poses[:, :, :3, :3] = Rotation.from_euler("z", yaw.reshape(-1, 1)).as_matrix().reshape(8, 51, 3, 3)
    poses[:, :, :2, 3] += 1e-3 * rng.normal(size=(8, 51, 2))
    poses[:, :, 2, 3] = 0.3
    found = rf.identify(poses, dt=0.1)
    np.testing.assert_allclose(np.median(found.noise.rotation), 3e-3, rtol=0.3)
    np.testing.assert_allclose(np.median(found.noise.position), 1e-3, rtol=0.3)
    assert np.mean(found.name == rf.CONSTRAINTS["E"].name) > 0.8
    assert not np.any(np.asarray(found.warnings))


@pytest.mark.parametrize("distance", [1e3, 1e4])
def test_heights_that_passed_through_float32_far_away(distance):
    poses = level_windows(1e-5)
    poses[:, :, 2, 3] += distance
    poses = poses.astype(np.float32).astype(np.float64)
    found = rf.identify(poses, dt=0.1)
    assert set(found.name) == {rf.CONSTRAINTS["E"].name}
    assert np.all(np.asarray(found.noise.position) > 1e-9 * distance)


def test_heights_that_are_not_measured_beside_orientations_that_are():
    poses = level_windows(1e-4)
    poses[:, :, 2, 3] = 0.0
    found = rf.identify(poses, dt=0.1)
    assert set(found.name) == {rf.CONSTRAINTS["E"].name}


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_positions_that_are_not_measured_at_all(noise):
    """A sensor of orientation alone turns about itself, wherever its positions say that it is."""
    poses, rng = level_windows(0.0), np.random.default_rng(3)
    errors = Rotation.from_rotvec(noise * rng.normal(size=(8 * 51, 3))).as_matrix()
    poses[:, :, :3, :3] = poses[:, :, :3, :3] @ errors.reshape(8, 51, 3, 3)
    poses[:, :, :3, 3] = np.linspace(0.0, 1.4, 8)[:, None, None]
    found = rf.identify(poses, dt=0.1)
    assert set(found.name) == {"Revolute joint"}
    assert not np.any(found.status)
    turns = np.sin(np.linspace(0, 5, 51)[:, None] * [1.0, 1.7, 2.3]) * rng.uniform(0.5, 1.0, (8, 1, 3))
    poses[:, :, :3, :3] = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(8, 51, 3, 3)
    assert np.mean(rf.identify(poses, dt=0.1).name == "Spherical joint") > 0.8


@pytest.mark.parametrize("label", "EFIJ")
def test_planes_parallel_to_the_ground_in_millimetres(label):
    """Exact motion, turned until its plane is level, written in whole millimetres."""
    simulate = jax.jit(jax.vmap(lambda key: synthetic.simulate(label, key).poses))
    poses = np.array(simulate(jax.random.split(jax.random.key(4), 32)))
    poses[:, :, :3] = LEVEL @ poses[:, :, :3]
    rng = np.random.default_rng(0)
    shake = Rotation.from_rotvec(1e-3 * rng.normal(size=(32 * 51, 3))).as_matrix().reshape(32, 51, 3, 3)
    poses[:, :, :3, :3] = shake @ poses[:, :, :3, :3]
    poses[:, :, :3, 3] = np.round(poses[:, :, :3, 3], 3)
    assert np.all(np.ptp(poses[:, :, 2, 3], axis=1) == 0)
    found = rf.identify(poses, dt=0.1)
    right = found.name == rf.CONSTRAINTS[label].name
    assert np.mean(right) > 0.9
    assert np.all(right[np.asarray(found.probability) > 0.9])


def test_the_unit_of_rounding():
    rng = np.random.default_rng(1)
    path = np.cumsum(rng.normal(size=(3, 40, 1)), axis=1)
    windows = [
        np.round(path, 2),
        path,
        np.round(path, 2) * np.array([1, 1, 0])[:, None, None],
        0.01 * np.arange(40.0)[None, :, None] * np.array([1, 0, 0])[:, None, None],  # even motion
        np.zeros((3, 40, 1)),
        np.concatenate([path[:2], np.round(path[2:] / 3) * 0.1]),  # mostly repeats
    ]
    counted = jnp.ones((40, len(windows)), bool)
    unit = jax.jit(unit_of_rounding)(jnp.asarray(np.concatenate(windows, axis=2)), counted)
    np.testing.assert_allclose(unit, [0.01, 0, 0.01, 0, 0, 0.1], rtol=1e-9, atol=1e-15)

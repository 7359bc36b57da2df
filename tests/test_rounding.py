"""A coordinate that rounding made constant is known no better than the others."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import reframe_jax as rf
from reframe_jax.identification.cautions import Caution
from reframe_jax.motion.noise import unit_of_rounding
from reframe_jax.simulation import synthetic


@pytest.mark.parametrize("label", "EFIJ")
def test_planes_parallel_to_the_ground_in_millimetres(label):
    """Exact motion, turned until its plane is level, written in whole millimetres."""
    simulate = jax.jit(jax.vmap(lambda key: synthetic.simulate(label, key).poses))
    poses = np.array(simulate(jax.random.split(jax.random.key(4), 8)))
    level = Rotation.from_rotvec([np.pi / 2, 0, 0]).as_matrix()  # the paper's planar motions turn about y
    poses[:, :, :3] = level @ poses[:, :, :3]
    rng = np.random.default_rng(0)
    shake = Rotation.from_rotvec(1e-3 * rng.normal(size=(8 * 51, 3))).as_matrix().reshape(8, 51, 3, 3)
    poses[:, :, :3, :3] = shake @ poses[:, :, :3, :3]
    poses[:, :, :3, 3] = np.round(poses[:, :, :3, 3], 3)
    assert np.all(np.ptp(poses[:, :, 2, 3], axis=1) == 0)
    found = rf.identify(poses, dt=0.1)
    assert np.mean(found.name == rf.CONSTRAINTS[label].name) > 0.8
    assert np.all(np.asarray(found.warnings) & Caution.ROUNDED > 0)


def test_the_unit_of_rounding():
    rng = np.random.default_rng(1)
    path = np.cumsum(rng.normal(size=(3, 40, 1)), axis=1)
    windows = [
        np.round(path, 2),
        path,
        np.round(path, 2) * np.array([1, 1, 0])[:, None, None],
        0.01 * np.arange(40.0)[None, :, None] * np.array([1, 0, 0])[:, None, None],  # even motion
        np.zeros((3, 40, 1)),
    ]
    counted = jnp.ones((40, len(windows)), bool)
    unit = unit_of_rounding(jnp.asarray(np.concatenate(windows, axis=2)), counted)
    np.testing.assert_allclose(unit, [0.01, 0, 0.01, 0, 0], rtol=1e-9, atol=1e-15)

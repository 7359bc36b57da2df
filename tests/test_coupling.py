"""Families of frames in which the axes turn as the origin moves: a nut on a screw."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import reframe_jax as rf
from reframe_jax.identification.cautions import Caution
from reframe_jax.simulation import synthetic

PITCH = 0.1  # m/rad


@pytest.fixture(scope="module")
def nuts():
    """Poses (8, 51, 4, 4) of bodies on screws of random axes, with noise."""
    rng, windows = np.random.default_rng(0), []
    t = 0.1 * np.arange(51)
    for _ in range(8):
        angle = sum(
            rng.uniform(0.2, 0.8) * np.sin(2 * np.pi * rng.uniform(0.1, 0.5) * t + rng.uniform(0, 6))
            for _ in range(3)
        )
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        point, start = rng.uniform(-0.3, 0.3, (2, 3))
        turn = Rotation.from_rotvec(angle[:, None] * axis)
        poses = np.tile(np.eye(4), (51, 1, 1))
        poses[:, :3, :3] = (Rotation.from_rotvec(3e-4 * rng.normal(size=(51, 3))) * turn).as_matrix()
        poses[:, :3, 3] = point + turn.apply(start - point) + PITCH * angle[:, None] * axis
        poses[:, :3, 3] += 1e-4 * rng.normal(size=(51, 3))
        windows.append(poses)
    return np.stack(windows)


def test_a_nut_on_a_screw_has_an_origin_for_every_axis(nuts):
    """The search is kept from the axis of the screw, which tells its origin."""
    found = rf.identify(nuts, dt=0.1, bounds=0.02)
    assert "Screw joint" not in found.name
    in_one_body = np.isin(found.linear.type_code, [rf.LinearType.BB, rf.LinearType.GG])
    assert np.sum(in_one_body) >= 6
    said = np.asarray(found.warnings) & Caution.COUPLED > 0
    assert np.all(said[in_one_body])
    coupled = np.asarray(found.linear.coupled_position)
    rank = np.trace(coupled, axis1=1, axis2=2) + np.trace(
        np.asarray(found.linear.free_position), axis1=1, axis2=2
    )
    np.testing.assert_allclose(rank[in_one_body], 3, atol=1e-9)
    np.testing.assert_allclose(coupled @ coupled, coupled, atol=1e-9)
    np.testing.assert_allclose(coupled @ np.asarray(found.linear.free_position), 0, atol=1e-6)
    first = found[int(np.flatnonzero(in_one_body)[0])]
    assert "if the axes turn along" in rf.to_table(first)
    assert any("Other axes with other origins" in warning for warning in first.warnings)


def test_the_axis_of_a_screw_tells_its_origin(nuts):
    found = rf.identify(nuts, dt=0.1)
    assert set(found.name) == {"Screw joint"}
    assert not np.any(np.asarray(found.linear.coupled_position))
    assert not np.any(np.asarray(found.warnings))


def test_a_screw_without_noise_is_no_hinge_with_errors_of_scale():
    rng, windows = np.random.default_rng(5), []
    t = np.linspace(0, 4, 51)
    for rotation in Rotation.random(16, rng):
        angle = 1.3 * np.sin(t + rng.uniform(0, 6)) + 0.6 * np.sin(9 / 4 * t)
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        point, lever = rng.uniform(-0.3, 0.3, 3), 0.2 * rng.normal(size=3)
        turn = Rotation.from_rotvec(angle[:, None] * axis)
        poses = np.tile(np.eye(4), (51, 1, 1))
        poses[:, :3, :3] = (turn * rotation).as_matrix()
        poses[:, :3, 3] = point + turn.apply(lever) + PITCH * angle[:, None] * axis
        windows.append(poses)
    found = rf.identify(np.stack(windows), dt=0.1)
    assert set(found.name) == {"Screw joint"}
    np.testing.assert_allclose(found.pitch, PITCH, rtol=1e-9)


@pytest.mark.parametrize("label", "ADGK")
def test_what_the_motion_determines_is_not_called_coupled(label):
    simulate = jax.jit(jax.vmap(lambda key: synthetic.simulate(label, key, noise=1e-4).poses))
    found = rf.identify(np.asarray(simulate(jax.random.split(jax.random.key(4), 8))), dt=0.1)
    assert not np.any(np.asarray(found.linear.coupled_position))
    assert not np.any(np.asarray(found.warnings))

"""A single axis of rotation: found where there is one, and noise that tilts it removed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from reframe_jax.geometry import rotations
from reframe_jax.motion.single_axis import find_single_axis, keep_axis

POSES, NOISE = 81, 0.01
TIMES = np.linspace(0, 4, POSES)
find, keep = jax.jit(find_single_axis), jax.jit(keep_axis)
exp = jax.jit(jax.vmap(rotations.rotation_exp))


@pytest.fixture(scope="module")
def turning():
    """(3, 3, K+1, 3): about one axis, about one by no more than the noise, and about two."""
    rng = np.random.default_rng(8)
    start = np.asarray(exp(jnp.asarray(rng.normal(size=(1, 3)))))[0]
    axis = np.array([0.6, 0.0, 0.8])
    one = np.asarray(exp(jnp.asarray(np.sin(TIMES)[:, None] * axis)))
    little = np.asarray(exp(jnp.asarray(NOISE * np.sin(TIMES)[:, None] * axis)))
    two = np.asarray(exp(jnp.asarray(0.2 * np.cos(TIMES)[:, None] * np.array([0.8, 0, -0.6])))) @ one
    noise = np.asarray(exp(jnp.asarray(NOISE * rng.normal(size=(3 * POSES, 3))))).reshape(3, POSES, 3, 3)
    measured = noise @ np.stack([one, little, two]) @ start
    return np.moveaxis(measured, (0, 1), (-1, -2)), axis, start.T @ axis


def test_axis_is_found_where_there_is_one(turning):
    rotation, in_ground, in_body = turning
    found = find(rotation, np.ones((POSES, 3), bool), np.full(3, NOISE))
    assert np.asarray(found.found).tolist() == [True, False, False]
    # a few standard errors of a mean over 81 rotations that turn by 1 rad
    for axis, truth in ((found.in_ground, in_ground), (found.in_body, in_body)):
        assert np.linalg.norm(np.cross(np.asarray(axis)[:, 0], truth)) < 8 * NOISE / np.sqrt(POSES)


def test_the_axis_is_kept_and_the_angle_with_it(turning):
    """Afterwards R y = x; the rotations are turned by no more than their noise, and others not at all."""
    rotation, _, _ = turning
    axis = find(rotation, np.ones((POSES, 3), bool), np.full(3, NOISE))
    kept = np.asarray(keep(rotation, axis))
    place = np.einsum("ijk,j->ik", kept[..., 0], np.asarray(axis.in_body)[:, 0])
    np.testing.assert_allclose(place, np.asarray(axis.in_ground)[:, :1] + 0 * place, atol=1e-12)
    product = np.einsum("ijk,ilk->jlk", kept[..., 0], kept[..., 0])
    np.testing.assert_allclose(product, np.eye(3)[:, :, None] + 0 * product, atol=1e-12)
    np.testing.assert_array_equal(kept[..., 1:], rotation[..., 1:])
    turned = np.linalg.norm(kept[..., 0] - rotation[..., 0], axis=(0, 1)) / np.sqrt(2)
    assert 0.8 * NOISE < np.sqrt(np.mean(turned**2) / 2) < 1.2 * NOISE


def test_poses_that_do_not_count_have_no_say(turning):
    rotation, in_ground, _ = turning
    spoiled = np.array(rotation)
    spoiled[:, :, 40] = np.eye(3)[::-1, :, None]
    counted = np.ones((POSES, 3), bool)
    counted[40] = False
    found = find(spoiled, counted, np.full(3, NOISE))
    assert bool(found.found[0])
    assert np.linalg.norm(np.cross(np.asarray(found.in_ground)[:, 0], in_ground)) < 8 * NOISE / np.sqrt(POSES)


def test_derivative_is_finite_where_no_axis_is(turning):
    """A window that hardly turns has no axis, and three that are equal: nothing may divide by their gap."""
    rotation, _, _ = turning

    def total(rotation):
        axis = find_single_axis(rotation, jnp.ones((POSES, 3), bool), jnp.full(3, NOISE))
        return jnp.sum(keep_axis(rotation, axis) ** 3) + jnp.sum(axis.in_ground**3)

    still = np.broadcast_to(np.eye(3)[:, :, None], (3, 3, POSES))
    both = jnp.asarray(np.concatenate([rotation[..., :2], still[..., None]], axis=-1))
    assert np.all(np.isfinite(jax.jit(jax.grad(total))(both)))

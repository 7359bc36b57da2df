"""A single axis of rotation: found where there is one, and noise that tilts it removed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from reframe_jax.geometry import rotations
from reframe_jax.motion.single_axis import find_single_axis, keep_axis

POSES, NOISE = 81, 0.01
TIMES = np.linspace(0, 4, POSES)
STILL = np.zeros((3, POSES, 3))  # a position that says nothing
SIZES = np.full(3, 1e-3), np.full(3, NOISE)  # of the noise, m and rad
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
    found = find(rotation, STILL, np.ones((POSES, 3), bool), SIZES)
    assert np.asarray(found.found).tolist() == [True, False, False]
    # a few standard errors of a mean over 81 rotations that turn by 1 rad
    for axis, truth in ((found.in_ground, in_ground), (found.in_body, in_body)):
        assert np.linalg.norm(np.cross(np.asarray(axis)[:, 0], truth)) < 8 * NOISE / np.sqrt(POSES)


def test_the_axis_is_kept_and_the_angle_with_it(turning):
    """Afterwards R y = x; the rotations are turned by no more than their noise, and others not at all."""
    rotation, _, _ = turning
    axis = find(rotation, STILL, np.ones((POSES, 3), bool), SIZES)
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
    found = find(spoiled, STILL, counted, SIZES)
    assert bool(found.found[0])
    assert np.linalg.norm(np.cross(np.asarray(found.in_ground)[:, 0], in_ground)) < 8 * NOISE / np.sqrt(POSES)


def test_derivative_is_finite_where_no_axis_is(turning):
    """A window that hardly turns has no axis, and three that are equal: nothing may divide by their gap."""
    rotation, _, _ = turning

    def total(rotation):
        axis = find_single_axis(rotation, STILL, jnp.ones((POSES, 3), bool), SIZES)
        return jnp.sum(keep_axis(rotation, axis) ** 3) + jnp.sum(axis.in_ground**3)

    still = np.broadcast_to(np.eye(3)[:, :, None], (3, 3, POSES))
    both = jnp.asarray(np.concatenate([rotation[..., :2], still[..., None]], axis=-1))
    assert np.all(np.isfinite(jax.jit(jax.grad(total))(both)))


def in_the_plane(turning, slide=0.0, sizes=(1e-3, NOISE)):
    """Positions half a metre from the axis, with noise; the body slides along it by so much a radian."""
    axis = turning[1]
    side = np.array([0.8, 0.0, -0.6])
    angle = np.sin(TIMES)[:, None]
    path = 0.5 * (np.cos(angle) * side + np.sin(angle) * np.cross(axis, side)) + slide * angle * axis
    noise = np.random.default_rng(9).normal(0, sizes[0], (POSES, 3))
    position = np.repeat(np.moveaxis(path + noise, 0, 1)[..., None], 3, axis=-1)
    return find(turning[0], position, np.ones((POSES, 3), bool), tuple(np.full(3, size) for size in sizes))


def test_the_plane_of_the_positions_measures_the_axis_too(turning):
    """Half a metre away, errors of a millimetre are a fifth of those of the rotations, 0.01 rad."""
    _, in_ground, in_body = turning
    alone = find(turning[0], STILL, np.ones((POSES, 3), bool), SIZES)
    found = in_the_plane(turning)
    assert np.asarray(found.planar).tolist() == [True, False, False]
    off = [np.linalg.norm(np.cross(np.asarray(each.in_ground)[:, 0], in_ground)) for each in (alone, found)]
    assert off[1] < 0.5 * off[0]
    assert off[1] < 4 * 1e-3 / (0.1 * np.sqrt(POSES))
    assert np.linalg.norm(np.cross(np.asarray(found.in_body)[:, 0], in_body)) < 8 * NOISE / np.sqrt(POSES)


def test_the_axis_has_the_least_error_over_noise(turning):
    """No other axis has a smaller sum of squares, of the rotations' errors and of the positions'."""
    found = in_the_plane(turning)
    alone = find(turning[0], STILL, np.ones((POSES, 3), bool), SIZES)
    assert np.asarray(alone.stiffness)[0] > 0
    sharp = in_the_plane(turning, sizes=(1e-6, NOISE))
    blunt = in_the_plane(turning, sizes=(0.3, NOISE))
    start, middle, end = (np.asarray(each.in_ground)[:, 0] for each in (blunt, found, sharp))
    np.testing.assert_allclose(start, np.asarray(alone.in_ground)[:, 0], atol=1e-3)
    assert 0 < np.linalg.norm(middle - start) < 1.2 * np.linalg.norm(end - start)


def test_a_body_that_slides_along_its_axis_has_no_plane(turning):
    assert not np.any(np.asarray(in_the_plane(turning, slide=0.05).planar))

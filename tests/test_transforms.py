"""SE(3) against SciPy's matrix exponential, its series, and its own axioms."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from algebra import bracket
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from reframe_jax.geometry.transforms import make_pose, pose_exp

exp = jax.jit(pose_exp)


ANGLES = (0.0, 1e-9, 1e-4, 0.3, 0.999, 1.0, 1.001, 2.5, np.pi - 1e-4)


def twists():
    rng = np.random.default_rng(5)
    axes = rng.normal(size=(len(ANGLES), 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    return np.concatenate([np.array(ANGLES)[:, None] * axes, rng.normal(size=(len(ANGLES), 3))], axis=-1)


TWISTS = twists()


def test_exp_against_scipy():
    expected = np.stack([expm(bracket(x)) for x in TWISTS])
    np.testing.assert_allclose(exp(jnp.asarray(TWISTS)), expected, atol=4e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 3e-3, 0.03, 0.3, 1.0, 3.0])
def test_translation_in_single_precision(angle):
    """No loss of digits at any angle, against 50 digits on the same rounded twist."""
    mp.mp.dps = 50
    twist = np.array([0.6 * angle, 0, 0.8 * angle, 1, -1, 0.5], dtype=np.float32)
    pose = exp(jnp.asarray(twist))
    assert pose.dtype == np.float32
    exact = mp.expm(mp.matrix(bracket(twist.astype(float)).tolist()))
    np.testing.assert_allclose(pose, np.array(exact.tolist(), dtype=float), atol=2.5e-7)


def test_make_pose(rng):
    rotation, position = rng.normal(size=(2, 5, 3, 3)), rng.normal(size=(2, 5, 3))
    for dtype in (np.float32, np.float64):
        pose = make_pose(jnp.asarray(rotation, dtype=dtype), jnp.asarray(position, dtype=dtype))
        assert pose.shape == (2, 5, 4, 4)
        assert pose.dtype == dtype
        np.testing.assert_array_equal(pose[..., :3, :3], rotation.astype(dtype))
        np.testing.assert_array_equal(pose[..., :3, 3], position.astype(dtype))


def test_derivatives_of_exp():
    """Both modes of automatic differentiation agree with differences of SciPy's exponential."""
    rates = np.asarray(jax.jit(jax.vmap(jax.jacfwd(pose_exp)))(jnp.asarray(TWISTS)))
    reverse = jax.jit(jax.vmap(jax.jacrev(pose_exp)))(jnp.asarray(TWISTS))
    np.testing.assert_allclose(reverse, rates, atol=4e-15)
    for x, rate in zip(TWISTS, rates, strict=True):
        for i, step in enumerate(1e-5 * np.eye(6)):
            change = (expm(bracket(x + step)) - expm(bracket(x - step))) / 2e-5
            np.testing.assert_allclose(rate[..., i], change, atol=1e-9)


def test_leading_axes(rng):
    x = jnp.asarray(rng.normal(size=(2, 3, 6)))
    rows = np.stack([exp(x[index]) for index in np.ndindex(2, 3)]).reshape(2, 3, 4, 4)
    np.testing.assert_allclose(exp(x), rows, atol=2e-15)


def random_twists():
    return st.tuples(*[st.floats(-1.7, 1.7)] * 3, *[st.floats(-3, 3)] * 3).map(np.array)


@settings(max_examples=60)
@given(random_twists())
def test_exp_agrees_with_the_group(a):
    np.testing.assert_allclose(exp(-a) @ exp(a), np.eye(4), atol=1e-14)
    np.testing.assert_allclose(exp(a / 2) @ exp(a / 2), exp(a), atol=1e-14)

"""Derivatives of an identification with respect to the poses, against finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.simulation import synthetic

DT = 0.1
STEP = 1e-5


def window(label: str, noise: float = 1e-4) -> np.ndarray:
    frame = rf.ConstraintFrame.named(label, linear_type=rf.LinearType.BG if label == "A" else None)
    return np.asarray(synthetic.simulate(frame, jax.random.key(3), noise=noise).poses)


def shaken(poses: jax.Array, change: jax.Array) -> jax.Array:
    """Poses with every position moved and every orientation turned by (K+1, 6)."""
    turned = poses[:, :3, :3] @ rotation_exp(change[:, 3:])
    return poses.at[:, :3, :3].set(turned).at[:, :3, 3].add(change[:, :3])


@pytest.mark.parametrize("label", ["A", "K"])
def test_the_origin_follows_the_poses(label: str, rng: np.random.Generator) -> None:
    poses = jnp.asarray(window(label))
    direction = jnp.asarray(rng.normal(size=(len(poses), 6)))

    def origin(amount: jax.Array) -> jax.Array:
        found = rf.identify(shaken(poses, amount * direction), dt=DT)
        axis = found.angular.axes[:, 2] if label == "A" else found.linear.axes[:, 0]
        return jnp.concatenate([found.linear.position, axis])

    value, slope = jax.jit(lambda a: jax.jvp(origin, (a,), (jnp.ones(()),)))(jnp.zeros(()))
    step = jnp.asarray(STEP * 1e-2)
    both = [jax.jit(origin)(s) for s in (step, -step)]
    expected = (both[0] - both[1]) / (2 * step)
    assert np.all(np.isfinite(value))
    # a fit that has not converged to the last digit makes differences inexact
    np.testing.assert_allclose(slope, expected, rtol=0.02, atol=0.05 * float(np.max(np.abs(expected))))


def test_forward_and_reverse_agree(rng: np.random.Generator) -> None:
    poses = jnp.asarray(window("K"))
    direction = jnp.asarray(rng.normal(size=(len(poses), 6)))
    zero = jnp.zeros_like(direction)

    def height(change: jax.Array) -> jax.Array:
        return jnp.sum(rf.identify(shaken(poses, change), dt=DT).linear.position)

    gradient = jax.jit(jax.grad(height))(zero)
    _, slope = jax.jit(lambda d: jax.jvp(height, (zero,), (d,)))(direction)
    assert np.all(np.isfinite(gradient))
    np.testing.assert_allclose(jnp.sum(gradient * direction), slope, rtol=1e-6)


def test_a_failed_window_gives_no_nan_to_its_neighbours() -> None:
    good = window("K")
    bad = np.full_like(good, np.nan)

    def total(poses: jax.Array) -> jax.Array:
        return jnp.sum(rf.identify(poses, dt=DT).linear.position[0])

    gradient = jax.jit(jax.grad(total))(jnp.asarray(np.stack([good, bad])))
    assert np.all(np.isfinite(gradient[0]))

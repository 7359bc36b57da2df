"""Hand-like motions: the speeds they promise, constraints that hold, and errors of the sizes asked for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.motions import random_constraint, random_motion
from reframe_jax import CONSTRAINTS, AngularType, LinearType
from reframe_jax.motion import kinematics
from reframe_jax.simulation import synthetic
from reframe_jax.simulation.motions import PoseErrors, disturb

KEYS = jax.random.split(jax.random.key(0), 64)
STEPS, DT = 40, 0.05
STILL = jnp.tile(jnp.eye(4), (4001, 1, 1))


def speeds(name: str, times: np.ndarray, duration: float = 5.0) -> np.ndarray:
    """Angular and linear velocities (64, times, 2, 3) of an excitation."""

    def of_key(key: jax.Array) -> jax.Array:
        velocity = synthetic.EXCITATIONS[name](key, duration)
        return jax.vmap(lambda t: jnp.stack(velocity(t)))(jnp.asarray(times))

    return np.asarray(jax.jit(jax.vmap(of_key))(KEYS))


def test_hands_move_at_the_speeds_promised():
    rms = np.sqrt(np.mean(speeds("hand", np.arange(0, 2000, 0.37)) ** 2, axis=1))
    for part, (low, high) in zip(np.moveaxis(rms, 1, 0), ((0.1, 1.0), (0.02, 0.3)), strict=True):
        assert part.min() > 0.9 * low
        assert part.max() < 1.1 * high
        assert part.max() > 5 * part.min()


@pytest.mark.parametrize(("name", "slowest", "fastest"), [("sine", 1.0, 4.0), ("slow", 0.2, 0.6)])
def test_one_sine_an_axis_has_the_amplitude_and_rate_promised(name, slowest, fastest):
    times = np.arange(0, 200, 0.02)
    velocity = speeds(name, times)
    amplitude = np.abs(velocity).max(axis=1)
    crossings = np.sum(np.diff(np.sign(velocity), axis=1) != 0, axis=1)
    rate = np.pi * crossings / 200
    assert (amplitude[:, 0] > 0.34).all()
    assert (amplitude[:, 0] < 0.86).all()
    np.testing.assert_array_less(np.abs(amplitude[:, 1] - 0.15), 0.0626)
    assert (rate > slowest - 0.02).all()
    assert (rate < fastest + 0.02).all()


def test_a_reach_comes_back_and_rests_at_both_ends():
    duration = 4.0
    times = np.linspace(0, duration, 2001)
    velocity = speeds("reach", times, duration)
    still = (times <= 0.05 * duration) | (times >= 0.95 * duration)
    assert (velocity[:, still] == 0).all()
    path = np.cumsum(velocity, axis=1) * (times[1] - times[0])
    np.testing.assert_allclose(path[:, -1], 0, atol=1e-3)
    farthest = np.abs(path).max(axis=1)
    for part, (low, high) in zip(np.moveaxis(farthest, 1, 0), ((0.3, 1.2), (0.08, 0.35)), strict=True):
        assert part.min() > 0.99 * low
        assert part.max() < 1.01 * high


@pytest.mark.parametrize("label", list(CONSTRAINTS))
def test_random_motions_obey_their_constraint(label):
    motion = random_motion(label, jax.random.key(3), samples=STEPS, dt=DT)
    frame = motion.truth
    rates = kinematics.angular_velocities(motion.poses, DT)[int(frame.angular_type)]
    maps = kinematics.linear_velocity_maps(motion.poses, DT)[int(frame.linear_type)]
    velocity = np.asarray(maps[..., 0] + maps[..., 1:] @ frame.position) @ np.asarray(frame.linear_axes)
    turning = np.asarray(rates) @ np.asarray(frame.angular_axes)
    for samples, dof in ((turning, frame.angular_dof), (velocity, frame.linear_dof)):
        rms = np.sqrt(np.mean(samples**2, axis=0))
        assert (rms[np.array(dof) == 0] < 1e-5).all()
        assert (rms[np.array(dof) == 1] > 1e-2).all()


def test_a_key_gives_one_motion_at_every_rate_and_error():
    def positions(steps: int, errors: PoseErrors) -> np.ndarray:
        motion = random_motion("C", jax.random.key(1), samples=steps, dt=2.0 / steps, errors=errors)
        return np.asarray(motion.exact_poses)

    few, many = positions(STEPS, PoseErrors()), positions(2 * STEPS, PoseErrors(sigma=1e-3))
    np.testing.assert_allclose(many[::2], few, atol=1e-7)


def test_motions_are_compiled_once_per_number_of_samples():
    jax.block_until_ready(random_motion("A", jax.random.key(0), samples=23, dt=0.1, errors=PoseErrors(1e-3)))
    before = synthetic._simulate._cache_size(), disturb._cache_size()
    errors = PoseErrors(1e-4, rotation_ratio=7.0, outliers=0.01)
    for label, dt in (("A", 0.01), ("H", 0.05), ("L", 0.3)):
        random_motion(label, jax.random.key(5), samples=23, dt=dt, errors=errors)
    assert (synthetic._simulate._cache_size(), disturb._cache_size()) == before


def test_motions_are_batched_over_keys_and_errors():
    sigma = jnp.asarray([0.0, 1e-3])

    def measured(key: jax.Array, sigma: jax.Array) -> jax.Array:
        return random_motion("K", key, samples=STEPS, dt=DT, errors=PoseErrors(sigma)).poses

    batch = jax.vmap(measured)(KEYS[:2], sigma)
    for i in range(2):
        np.testing.assert_allclose(batch[i], measured(KEYS[i], sigma[i]), atol=1e-12)


def test_random_geometry_covers_its_range():
    for kind in LinearType:
        frame, start = jax.vmap(lambda key, kind=kind: random_constraint("A", key, linear_type=kind))(KEYS)
        origin = frame.position
        if kind.position_body == AngularType.G:  # from the body, in its axes
            origin = jnp.einsum("nji,nj->ni", start[:, :3, :3], frame.position - start[:, :3, 3])
        assert float(jnp.abs(origin).max()) <= 0.5
        assert float(jnp.abs(origin).max()) > 0.45
        assert float(jnp.abs(jnp.mean(start[:, :3, :3], axis=0)).max()) < 0.35
        assert frame.linear_type == kind


def angles_and_shifts(errors: PoseErrors, start: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    first = jnp.eye(4) if start is None else jnp.asarray(start)
    poses = np.asarray(disturb(first @ STILL, jax.random.key(2), errors, 0.1))
    turned = poses[:, :3, :3] @ np.asarray(first)[:3, :3].T
    return Rotation.from_matrix(turned).as_rotvec(), poses[:, :3, 3] - np.asarray(first)[:3, 3]


def test_white_noise_has_the_sizes_asked_for():
    start = np.eye(4)
    start[:3, :3] = Rotation.from_rotvec([0.3, 2.5, -1.0]).as_matrix()
    turns, shifts = angles_and_shifts(PoseErrors(2e-3, rotation_ratio=5.0), start)
    np.testing.assert_allclose(shifts.std(axis=0), 2e-3, rtol=0.05)
    np.testing.assert_allclose(turns.std(axis=0), 1e-2, rtol=0.05)
    assert np.abs(np.mean(shifts[1:] * shifts[:-1])) < 0.05 * 4e-6


def test_outliers_are_as_many_as_asked_for():
    turns, shifts = angles_and_shifts(PoseErrors(outliers=0.01, jump=0.05))
    jumped = np.linalg.norm(shifts, axis=1) > 0
    assert 0.006 < jumped.mean() < 0.014
    np.testing.assert_array_equal(jumped, np.linalg.norm(turns, axis=1) > 1e-12)
    assert 0.03 < shifts[jumped].std() < 0.07


def test_slow_errors_are_correlated_for_as_long_as_asked():
    _, shifts = angles_and_shifts(PoseErrors(slow=1e-3, slow_time=0.8))
    np.testing.assert_allclose(shifts.std(), 1e-3, rtol=0.15)
    correlation = np.mean(shifts[8:] * shifts[:-8]) / np.mean(shifts**2)
    assert abs(correlation - np.exp(-1)) < 0.1


def test_rounding_leaves_the_digits_asked_for():
    errors = PoseErrors(1e-3, rounding=1e-4)
    poses = np.asarray(disturb(STILL[:100], jax.random.key(2), errors, 0.1))
    exact = np.asarray(disturb(STILL[:100], jax.random.key(2), PoseErrors(1e-3), 0.1))
    digits = poses[:, :3, 3] / 1e-4
    np.testing.assert_allclose(digits, np.round(digits), atol=1e-9)
    np.testing.assert_allclose(poses[:, :3, 3], exact[:, :3, 3], atol=0.51e-4)
    turn = Rotation.from_matrix(poses[:, :3, :3] @ exact[:, :3, :3].swapaxes(1, 2)).magnitude()
    assert 0 < turn.max() < 3e-4
    np.testing.assert_allclose(
        poses[:, :3, :3] @ poses[:, :3, :3].swapaxes(1, 2), np.tile(np.eye(3), (100, 1, 1)), atol=1e-12
    )

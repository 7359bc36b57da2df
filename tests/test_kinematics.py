"""Twists and velocity maps against loops in NumPy, and against motions whose answer is known."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from algebra import bracket, hat, unbracket
from scipy.integrate import solve_ivp
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.geometry import transforms
from reframe_jax.motion import kinematics, paths
from reframe_jax.motion.kinematics import (
    angular_velocities,
    linear_velocity_maps,
)
from reframe_jax.motion.windows import sliding_windows


@partial(jax.jit, static_argnums=2)
def velocities(poses, dt, discretization):
    """Both kinds at once; the tests share shapes, (9, 4, 4) and (8,), so that few are compiled."""
    return linear_velocity_maps(poses, dt, discretization), angular_velocities(poses, dt, discretization)


def maps_of(poses, dt, discretization="chord"):
    return np.asarray(velocities(poses, dt, discretization)[0])


def rates_of(poses, dt, discretization="chord"):
    return np.asarray(velocities(poses, dt, discretization)[1])


def twists_of(poses, dt):
    """Body and spatial twists (w, v), (..., K, 6) each: the motion of the two origins."""
    maps, rates = (np.asarray(part) for part in velocities(poses, dt, "left"))
    pairs = (AngularType.B, LinearType.BB), (AngularType.G, LinearType.GG)
    return [np.concatenate([rates[..., w, :, :], maps[..., v, :, :, 0]], axis=-1) for w, v in pairs]


def random_poses(rng, *shape, dtype=np.float64):
    x = rng.normal(size=(*shape, 6)) * np.array([0.8, 0.8, 0.8, 0.3, 0.3, 0.3])
    return np.asarray(jax.jit(transforms.pose_exp)(jnp.asarray(x, dtype=dtype)))


def irregular(rng, *shape):
    return rng.uniform(0.03, 0.08, size=shape)


class TestTwists:
    def test_constant_twists(self, rng):
        """Poses that follow a constant twist return it, in the body and in the ground."""
        twist, start = rng.normal(size=6), random_poses(rng)
        dt = irregular(rng, 8)
        time = np.concatenate([[0], np.cumsum(dt)])
        body = np.stack([start @ expm(bracket(twist) * t) for t in time])
        ground = np.stack([expm(bracket(twist) * t) @ start for t in time])
        np.testing.assert_allclose(twists_of(body, dt)[0], np.tile(twist, (8, 1)), atol=1e-13)
        np.testing.assert_allclose(twists_of(ground, dt)[1], np.tile(twist, (8, 1)), atol=1e-13)
        # so do both discretisations of the maps that no frame is turned by
        for discretization in ("chord", "left"):
            found = maps_of(body, dt, discretization)[LinearType.BB]
            np.testing.assert_allclose(found[..., 0], np.tile(twist[3:], (8, 1)), atol=1e-12)
            np.testing.assert_allclose(found[..., 1:], np.tile(hat(twist[:3]), (8, 1, 1)), atol=1e-12)
            rates = rates_of(ground, dt, discretization)[AngularType.G]
            np.testing.assert_allclose(rates, np.tile(twist[:3], (8, 1)), atol=1e-12)

    def test_spatial_is_the_adjoint_of_body(self, rng):
        poses, dt = random_poses(rng, 9), irregular(rng, 8)
        body, spatial = (np.asarray(x) for x in twists_of(poses, dt))
        for k in range(8):
            carried = poses[k] @ bracket(body[k]) @ np.linalg.inv(poses[k])
            np.testing.assert_allclose(spatial[k], unbracket(carried), atol=1e-12)
            step = logm(poses[k + 1] @ np.linalg.inv(poses[k])) / dt[k]
            np.testing.assert_allclose(spatial[k], unbracket(step.real), atol=1e-11)


def maps_in_a_loop(poses, dt, discretization):
    """GB and BG of both discretisations, and BB and GG of the left one: one sample at a time."""
    steps = len(poses) - 1
    maps = np.full((4, steps, 3, 4), np.nan)
    for k in range(steps):
        now, after = poses[k], poses[k + 1]
        body = unbracket(logm(np.linalg.inv(now) @ after).real / dt[k])
        ground = unbracket(now @ bracket(body) @ np.linalg.inv(now))
        if discretization == "left":
            in_body = np.column_stack([body[3:], hat(body[:3])])
            in_ground = np.column_stack([ground[3:], hat(ground[:3])])
            maps[LinearType.BB, k], maps[LinearType.GG, k] = in_body, in_ground
            maps[LinearType.GB, k] = now[:3, :3] @ in_body
            maps[LinearType.BG, k] = now[:3, :3].T @ in_ground
        else:
            for column, p in enumerate(np.concatenate([np.zeros((1, 3)), np.eye(3)])):
                point = np.append(p, 1)
                tip = ((after - now) @ point)[:3] / dt[k]
                # the ground point, seen from the body, moves the other way
                seen = -(np.linalg.inv(after) @ point - np.linalg.inv(now) @ point)[:3] / dt[k]
                maps[LinearType.GB, k, :, column] = tip
                maps[LinearType.BG, k, :, column] = seen
            for kind in (LinearType.GB, LinearType.BG):
                maps[kind, k, :, 1:] -= maps[kind, k, :, :1]
    return maps


class TestMaps:
    @pytest.mark.parametrize("discretization", ["chord", "left"])
    def test_against_a_loop(self, discretization, rng):
        poses, dt = random_poses(rng, 9), irregular(rng, 8)
        expected = maps_in_a_loop(poses, dt, discretization)
        found = np.asarray(maps_of(poses, dt, discretization))
        known = ~np.isnan(expected)
        assert known.sum() == (2 if discretization == "chord" else 4) * 8 * 12
        np.testing.assert_allclose(found[known], expected[known], atol=1e-11)

    def test_chords_are_the_path_of_the_origin(self, rng):
        poses, dt, p = random_poses(rng, 9), irregular(rng, 8), rng.normal(size=3)
        found = np.asarray(maps_of(poses, dt))
        velocity = found[..., 0] + found[..., 1:] @ p
        tip = poses[:, :3, :3] @ p + poses[:, :3, 3]
        np.testing.assert_allclose(velocity[LinearType.GB], np.diff(tip, axis=0) / dt[:, None], atol=1e-12)
        seen = np.swapaxes(poses[:, :3, :3], 1, 2) @ (p - poses[:, :3, 3])[..., None]
        path = -np.diff(seen[..., 0], axis=0) / dt[:, None]
        np.testing.assert_allclose(velocity[LinearType.BG], path, atol=1e-12)

    @pytest.mark.parametrize("discretization", ["chord", "left"])
    def test_the_order_of_types_and_their_axes(self, discretization):
        """A turntable about z at (1, 0, 0), the body starting at the origin: every map by hand."""
        speed, pivot, dt = 0.4, np.array([1.0, 0, 0]), 1e-4
        time = np.arange(9) * dt
        c, s, zero, one = np.cos(speed * time), np.sin(speed * time), 0 * time, 1 + 0 * time
        rotation = np.moveaxis(np.array([[c, -s, zero], [s, c, zero], [zero, zero, one]]), -1, 0)
        poses = np.tile(np.eye(4), (9, 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = rotation, pivot - rotation @ pivot
        # turned a quarter about z, the ground's x is the body's -y
        quarter = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        found = np.asarray(maps_of(poses @ quarter, np.full(8, dt), discretization))[:, 0]
        turn = speed * hat([0, 0, 1])
        velocity = -turn @ pivot  # of the body's origin, in the ground
        into_body = quarter[:3, :3].T
        expected = {
            LinearType.BB: (into_body @ velocity, turn),
            LinearType.GB: (velocity, turn @ quarter[:3, :3]),
            LinearType.GG: (velocity, turn),
            LinearType.BG: (into_body @ velocity, into_body @ turn),
        }
        for kind, (a, b) in expected.items():
            np.testing.assert_allclose(found[kind], np.column_stack([a, b]), atol=1e-4)

    @pytest.mark.parametrize("discretization", ["chord", "left"])
    def test_leading_axes(self, discretization, rng):
        poses, dt = random_poses(rng, 2, 3, 9), irregular(rng, 2, 3, 8)
        maps, rates = velocities(poses, dt, discretization)
        assert maps.shape == (2, 3, 4, 8, 3, 4)
        assert rates.shape == (2, 3, 2, 8, 3)
        for index in np.ndindex(2, 3):
            single = velocities(poses[index], dt[index], discretization)
            np.testing.assert_allclose(maps[index], single[0], rtol=1e-11, atol=1e-11)
            np.testing.assert_allclose(rates[index], single[1], rtol=1e-11, atol=1e-11)
        # the rotational part of a map that nothing turns is the angular velocity
        turns = np.asarray(maps[..., 1:])
        both = turns[:, :, LinearType.GG], turns[:, :, LinearType.BB]
        for kind, turn in enumerate(both):
            expected = np.stack([turn[..., 2, 1], turn[..., 0, 2], turn[..., 1, 0]], axis=-1)
            np.testing.assert_array_equal(rates[:, :, kind], expected)

    @pytest.mark.parametrize("dt", [(), (8,), (3, 8), (1, 8)])
    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_dtype_follows_the_poses(self, dtype, dt):
        poses = jax.ShapeDtypeStruct((3, 9, 4, 4), dtype)
        for time in (np.float32, np.float64):
            for discretization in ("chord", "left"):
                maps, rates = jax.eval_shape(
                    lambda poses, dt, d=discretization: velocities(poses, dt, d),
                    poses,
                    jax.ShapeDtypeStruct(dt, time),
                )
                assert (maps.shape, maps.dtype) == ((3, 4, 8, 3, 4), dtype)
                assert (rates.shape, rates.dtype) == ((3, 2, 8, 3), dtype)

    def test_single_precision(self):
        """Differencing poses of size 1 at 0.05 s costs 1/dt roundings, and no more."""
        time = sample_times(80, "even")
        poses, dt = knife_edge(time), np.diff(time)
        exact, rounded = maps_of(poses, dt), maps_of(poses.astype(np.float32), dt)
        assert rounded.dtype == np.float32
        np.testing.assert_allclose(rounded, exact, atol=3 * np.finfo(np.float32).eps / 0.05)

    def test_sample_times(self, rng):
        """A scalar, one per step and one per step of every window say the same."""
        poses = random_poses(rng, 3, 9)
        expected = np.stack(twists_of(poses, np.full((3, 8), 0.05)))
        for dt in (0.05, np.full(8, 0.05), np.full((1, 8), 0.05)):
            np.testing.assert_allclose(twists_of(poses, dt), expected, rtol=1e-13)
        np.testing.assert_allclose(twists_of(poses, 0.1), expected / 2, rtol=1e-13)

    @pytest.mark.parametrize("steps", [1, 4])
    def test_windows_shorter_than_the_stencil(self, steps, rng):
        found = maps_of(random_poses(rng, steps + 1), 0.05)
        assert found.shape == (4, steps, 3, 4)
        assert np.all(np.isfinite(found))

    def test_unknown_discretization(self, rng):
        poses = random_poses(rng, 6)
        for function in (linear_velocity_maps, angular_velocities):
            with pytest.raises(ValueError, match=r"'chord' or 'left', not 'midpoint'"):
                function(poses, 0.05, "midpoint")

    def test_derivatives_at_rest(self):
        """A body that does not move is no singularity: its velocities still answer to its poses."""
        poses, dt = jnp.broadcast_to(jnp.eye(4), (9, 4, 4)), np.full(8, 0.1)

        def forward(poses):  # velocity of the body's origin in the third step, of every type
            return jnp.sum(linear_velocity_maps(poses, dt)[:, 2, 0, 0])

        slope = np.asarray(jax.jit(jax.grad(forward))(poses))
        assert np.all(np.isfinite(slope))
        expected = np.zeros(9)
        expected[2:4] = -40, 40
        np.testing.assert_allclose(slope[:, 0, 3], expected, atol=1e-12)


# A motion that is not integrable: the point p of the body never moves along the body's z.

CONSTRAINED = np.array([0.1, 0.3, 0.1])


def omega(t):
    x, y, z = 0.4 + 0.9 * np.sin(1.7 * t), 0.7 * np.cos(2.3 * t + 0.5), 0.8 * np.sin(1.1 * t + 1)
    return np.array([x, y, z])


def velocity_of_point(t):
    return np.array([0.3 * np.sin(1.9 * t + 0.2), 0.1 + 0.25 * np.cos(1.3 * t), 0.0])


def knife_edge(time):
    """Poses of that motion at the given times, integrated to rounding."""

    def rate(t, state):
        w = omega(t)
        rotation, v = state[:9].reshape(3, 3), velocity_of_point(t) - np.cross(w, CONSTRAINED)
        return np.concatenate([(rotation @ hat(w)).ravel(), rotation @ v])

    start = np.concatenate([np.eye(3).ravel(), [0.2, 0.1, 0.3]])
    span = (0, time[-1])
    path = solve_ivp(rate, span, start, method="DOP853", rtol=1e-13, atol=1e-14, t_eval=time).y.T
    poses = np.tile(np.eye(4), (len(time), 1, 1))
    left, _, right = np.linalg.svd(path[:, :9].reshape(-1, 3, 3))
    poses[:, :3, :3], poses[:, :3, 3] = left @ right, path[:, 9:]
    return poses


def sample_times(steps, kind):
    x = np.linspace(0, 1, steps + 1)
    if kind == "drifting":
        x = x + 0.08 * np.sin(2 * np.pi * x)
    if kind == "bursts":  # four samples in a row, then a step six times as long
        x = np.cumsum(np.where(np.arange(steps + 1) % 5 == 4, 6, 1))
        x = (x - x[0]) / (x[-1] - x[0])
    if kind == "jittering":
        x[1:-1] += np.random.default_rng(3).uniform(-0.3, 0.3, steps - 1) / steps
    return 4 * x


def residual(poses, dt, kind, discretization):
    """RMS velocity of the point along the axis in which it cannot move."""
    found = np.asarray(maps_of(poses, dt, discretization))[kind]
    return np.sqrt(np.mean((found[..., 0] + found[..., 1:] @ CONSTRAINED)[:, 2] ** 2))


class TestDiscretization:
    @pytest.mark.parametrize(
        ("times", "discretization", "order", "at_80"),
        [
            ("even", "left", 2, 2e-4),
            ("even", "chord", 6, 1e-10),
            ("drifting", "chord", 6, 1e-9),
            ("jittering", "chord", 3, 2e-7),
            ("bursts", "chord", 3, 5e-6),
        ],
    )
    def test_residual_of_a_nonholonomic_motion(self, times, discretization, order, at_80):
        """How fast the constrained velocity falls to zero as the sampling gets finer."""
        errors = []
        for steps in (20, 80):
            time = sample_times(steps, times)
            poses, dt = knife_edge(time), np.diff(time)
            errors.append(residual(poses, dt, LinearType.BB, discretization))
            # the inverse motion has the same constraint in the ground, with the same error
            inverse = np.linalg.inv(poses)
            mirrored = residual(inverse, dt, LinearType.GG, discretization)
            assert mirrored == pytest.approx(errors[-1], rel=1e-3, abs=1e-13)
        assert np.log2(errors[0] / errors[1]) / 2 > order - 0.25
        assert errors[1] < at_80

    def test_chord_is_the_mean_of_the_twist(self):
        """BB and GG stand for the velocity averaged over the step, free components too."""
        time = sample_times(80, "even")
        poses, dt = knife_edge(time), np.diff(time)
        nodes, weights = np.polynomial.legendre.leggauss(5)
        within = time[:-1, None] + dt[:, None] / 2 * (1 + nodes)
        mean = np.einsum("kni,n->ki", np.array([[omega(t) for t in row] for row in within]), weights / 2)
        rates = np.asarray(rates_of(poses, dt))
        np.testing.assert_allclose(rates[AngularType.B], mean, atol=3e-9)
        plain = np.asarray(rates_of(poses, dt, "left"))
        assert np.max(np.abs(plain[AngularType.B] - mean)) > 1e-5

    def test_ground_and_body_change_places(self, rng):
        """Swapping the bodies swaps GG with BB and BG with GB, and turns the sign."""
        poses, dt = random_poses(rng, 9), irregular(rng, 8)
        found, mirrored = np.asarray(maps_of(poses, dt)), np.asarray(maps_of(np.linalg.inv(poses), dt))
        pairs = ((LinearType.BB, LinearType.GG), (LinearType.GB, LinearType.BG))
        for one, other in pairs:
            np.testing.assert_allclose(found[one], -mirrored[other], rtol=1e-9, atol=1e-10)
            np.testing.assert_allclose(found[other], -mirrored[one], rtol=1e-9, atol=1e-10)

    @pytest.mark.parametrize("steps", [1, 2, 4, 5, 9, 20])
    def test_derivative_weights(self, steps, rng):
        """Exact for polynomials of one degree less than there are nodes."""
        dt = irregular(rng, 2, steps)
        middle = np.cumsum(dt, axis=-1) - dt / 2
        count = min(steps, paths._STENCIL)
        shape = rng.normal(size=count)
        values, expected = np.polyval(shape, middle), np.polyval(np.polyder(shape), middle)
        even = jnp.asarray([True, False])
        weights = jax.jit(paths._derivative_weights)(jnp.asarray(dt), even, np.array([steps]))
        assert weights.shape == (2 * count - 1, steps, 2)
        found = jax.jit(paths._derivative)(
            weights, jnp.broadcast_to(jnp.asarray(values.T), (3, 2, 2, steps, 2))
        )
        np.testing.assert_allclose(found[..., 0], np.broadcast_to(expected[0], (3, 2, 2, steps)), atol=2e-10)

    def test_derivatives_across_very_different_steps_use_few_nodes(self, rng):
        dt = np.where(np.arange(20) % 4 == 3, 0.4, 0.05)[None]
        middle = np.cumsum(dt, axis=-1) - dt / 2
        weights = jax.jit(paths._derivative_weights)(jnp.asarray(dt), jnp.asarray([False]), np.array([20]))
        weights = np.asarray(weights)[..., 0]
        found = paths._derivative(
            jnp.asarray(weights[..., None]), jnp.broadcast_to(jnp.asarray(middle.T**2), (3, 2, 2, 20, 1))
        )
        np.testing.assert_allclose(found[..., 0], np.broadcast_to(2 * middle[0], (3, 2, 2, 20)), atol=1e-10)
        assert np.all(np.sum(weights != 0, axis=0) <= 5)

    def test_short_steps_do_not_amplify_the_noise_of_a_long_one(self):
        """Poses that arrive in bursts have velocities with the noise of a pose over a tiny step."""
        dt = np.where(np.arange(20) % 10 == 9, 0.4, 1e-4)
        weights = jax.jit(paths._derivative_weights)
        weights = np.asarray(weights(jnp.asarray(dt[None]), jnp.asarray([False]), np.array([20])))
        noise = np.array([1 / dt[9 + k] for k in range(-6, 7)])
        assert np.all(np.abs(weights[:, 9, 0] * noise * dt[9] ** 2) < 1)


class TestSlidingWindows:
    def test_view(self, rng):
        poses = rng.normal(size=(20, 4, 4))
        windows = sliding_windows(poses, 6, stride=3)
        assert windows.shape == (5, 6, 4, 4)
        assert np.shares_memory(windows, poses)
        assert not windows.flags.writeable
        for i, window in enumerate(windows):
            np.testing.assert_array_equal(window, poses[3 * i : 3 * i + 6])

    def test_times_and_edges(self):
        times = np.arange(5.0)
        assert sliding_windows(times, 5).shape == (1, 5)
        assert sliding_windows(times, 1).shape == (5, 1)
        np.testing.assert_array_equal(sliding_windows(times, 2, stride=2), [[0, 1], [2, 3]])

    @pytest.mark.parametrize(
        ("length", "stride", "message"),
        [
            (6, 1, "A window of 6 samples does not fit a recording of 5."),
            (0, 1, "at least 1, not 0 and 1"),
            (3, 0, "at least 1, not 3 and 0"),
        ],
    )
    def test_errors(self, length, stride, message):
        with pytest.raises(ValueError, match=message):
            sliding_windows(np.arange(5.0), length, stride)


@pytest.mark.parametrize("gap", [4, 20, 60])
def test_a_gap_in_the_recording_does_not_amplify_noise(gap, rng):
    """Noisy rotation about one axis, with one step much longer than the others: rates stay what they are."""
    steps = np.full(60, 0.1)
    steps[30] *= gap
    angle = 0.8 * np.sin(0.7 * np.concatenate([[0], np.cumsum(steps)]))
    noise = Rotation.from_rotvec(1e-3 * rng.normal(size=(61, 3)))
    poses = np.tile(np.eye(4), (61, 1, 1))
    poses[:, :3, :3] = (Rotation.from_rotvec(np.outer(angle, [0, 0, 1])) * noise).as_matrix()
    rates = jax.jit(kinematics.angular_velocities)(jnp.asarray(poses), jnp.asarray(steps))[0]
    expected = np.diff(angle) / steps
    np.testing.assert_allclose(rates[:, 2], expected, atol=0.08)
    np.testing.assert_allclose(rates[:, :2], 0, atol=0.08)

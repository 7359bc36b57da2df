"""The covariance of an identification: against its errors, against finite differences, and its form."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax as rf
from benchmarks import uncertainty_cost
from benchmarks.uncertainty import INTERVAL, standard_scores
from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.identification.results import PoseNoise
from reframe_jax.simulation.metrics import dof_correct, types_correct
from reframe_jax.simulation.motions import PoseErrors, disturb, random_motion

SAMPLES, DT, SIGMA = 50, 0.1, 2e-4
NOISE = PoseNoise(jnp.asarray(SIGMA), jnp.asarray(3 * SIGMA))
WINDOWS, CHUNK = 96, 32


def assert_same(one, other):
    """Equal covariances of one window, entry by entry in units of the standard deviations."""
    scale = np.sqrt(np.diag(one.matrix))
    scale = np.where(scale > 0, scale, 1)
    np.testing.assert_allclose(
        one.matrix / np.outer(scale, scale), other.matrix / np.outer(scale, scale), atol=1e-3
    )
    np.testing.assert_allclose(one.inflation, other.inflation, rtol=1e-3)
    assert one.determined == other.determined


@pytest.fixture(scope="module")
def recordings():
    """Simulations of a few constraints, and what was found."""
    made = {}
    for label in "AEHK":

        def of_key(key, label=label):
            errors = PoseErrors(sigma=SIGMA)
            return random_motion(label, key, samples=SAMPLES, dt=DT, excitation="exciting", errors=errors)

        made[label] = jax.vmap(of_key)(jax.random.split(jax.random.key(5), WINDOWS))
    poses = np.concatenate([np.asarray(each.poses) for each in made.values()])
    found = rf.identify(poses, dt=DT)
    parts = {}
    for i, (label, each) in enumerate(made.items()):
        rows = slice(i * WINDOWS, (i + 1) * WINDOWS)
        parts[label] = each, np.asarray(each.poses), found[rows]
    return parts


@pytest.mark.parametrize("errors", ["white", "measured"])
@pytest.mark.parametrize("label", "AEHK")
def test_intervals_hold_the_truth(recordings, label, errors):
    simulation, poses, found = recordings[label]
    right = np.asarray(types_correct(found, simulation.truth) & dof_correct(found, simulation.truth))
    assert right.mean() > 0.9
    noise = NOISE if errors == "white" else None
    sure = rf.covariance(found, poses, dt=DT, noise=noise, errors=errors)
    scores = standard_scores(found, sure, simulation.truth, np.asarray(simulation.exact_poses[:, 0]))
    for name, score in scores.items():
        score = score[right]
        known = np.isfinite(score)
        assert known.any(axis=1).all(), name
        # 96 windows with one to three directions each; what is left over can only widen them
        covered = np.mean(np.abs(score[known]) < INTERVAL)
        assert 0.90 < covered <= (0.99 if errors == "white" else 1), name


def test_matches_the_derivative_of_the_estimate(recordings):
    """Differences of identify under a small error of every pose, one after the other."""
    simulation, _, _ = recordings["K"]
    # so exact that the noise subtracted from the moments, a median that one pose may move, does not matter
    exact, error = simulation.exact_poses[0], PoseErrors(sigma=SIGMA / 10)
    poses = np.asarray(disturb(exact, jax.random.key(2), error, DT))[None]
    found = rf.identify(poses, dt=DT)
    size, count = 1e-7, 6 * (SAMPLES + 1)
    changes = size * np.eye(count).reshape(count, SAMPLES + 1, 6)
    turned = np.asarray(rotation_exp(jnp.asarray(changes[..., :3]))) @ poses[0][None, :, :3, :3]
    moved = np.tile(poses[0], (count, 1, 1, 1))
    moved[..., :3, :3], moved[..., :3, 3] = turned, poses[0][None, :, :3, 3] + changes[..., 3:]
    there = rf.identify(moved, dt=DT)
    assert np.all(np.asarray(there.refined) == np.asarray(found.refined[0]))
    slope = (np.asarray(there.linear.position) - np.asarray(found.linear.position[0])).T / size
    noise = np.tile(np.repeat([3 * error.sigma, error.sigma], 3), SAMPLES + 1)
    expected = (slope * noise**2) @ slope.T
    known = PoseNoise(jnp.asarray(error.sigma), jnp.asarray(3 * error.sigma))
    sure = rf.covariance(found[0], poses[0], dt=DT, noise=known, errors="white")
    np.testing.assert_allclose(sure.position, expected, rtol=0.1, atol=0.03 * np.max(expected))


def test_noise_does_not_shift_the_likeliest_frame(recordings):
    """At 3 mm and 0.5 degrees levers are as often too short as too long, and no bias is claimed."""
    simulation, _, _ = recordings["K"]
    disturbed = jax.vmap(lambda pose, key: disturb(pose, key, PoseErrors(sigma=3e-3), DT))
    poses = np.asarray(disturbed(simulation.exact_poses, jax.random.split(jax.random.key(2), WINDOWS)))
    found = rf.identify(poses, dt=DT)
    sure = rf.covariance(found, poses, dt=DT)
    right = np.asarray(types_correct(found, simulation.truth) & dof_correct(found, simulation.truth))
    right = right & np.asarray(sure.first_order & found.refined)
    assert right.mean() > 0.6
    assert np.all(sure.bias[right] == 0)
    lengths = (np.linalg.norm(x[right], axis=1) for x in (found.linear.position, simulation.truth.position))
    longer = np.mean(np.subtract(*lengths) > 0)
    assert 0.3 < longer < 0.7
    scores = standard_scores(found, sure, simulation.truth, np.asarray(simulation.exact_poses[:, 0]))
    assert 0.90 < np.mean(np.abs(scores["position"][right]) < INTERVAL) < 0.99


def test_too_much_noise_is_said(recordings):
    simulation, poses, found = recordings["K"]
    assert np.all(rf.covariance(found, poses, dt=DT).first_order)
    disturbed = jax.vmap(lambda pose, key: disturb(pose, key, PoseErrors(sigma=1.5e-2), DT))
    poses = np.asarray(disturbed(simulation.exact_poses, jax.random.split(jax.random.key(2), WINDOWS)))
    sure = rf.covariance(rf.identify(poses, dt=DT), poses, dt=DT)
    assert np.mean(sure.first_order) < 0.1


@pytest.mark.parametrize("label", "AEHK")
def test_a_bootstrap_agrees(recordings, label):
    _, poses, found = recordings[label]
    poses, found = poses[:CHUNK], found[:CHUNK]  # a larger batch is filled up to 256
    usual = rf.covariance(found, poses, dt=DT, errors="white")
    second = rf.covariance(found, poses, dt=DT, method="bootstrap")
    parts = {label: ("linear_axes", "position") for label in "EHK"} | {"A": ("angular_axes", "position")}
    for part in parts[label]:
        sizes = [np.sqrt(np.trace(getattr(each, part), axis1=1, axis2=2)) for each in (usual, second)]
        assert 0.75 < np.median(sizes[1] / sizes[0]) < 1.25
    assert np.all(second.bias == 0)
    np.testing.assert_allclose(second.linear_rms, usual.linear_rms)
    free = np.einsum("nij,njk->nik", found.linear.free_position, second.position)
    assert np.max(np.abs(free)) < 1e-9 * np.max(second.position)


def test_ties_are_those_of_the_difference_of_norms(recordings):
    """A hinge is one in every type; at 3 mm, other constraints still belong to one, though norms are near."""
    made = {}
    for label, (simulation, _, _) in recordings.items():
        disturbed = jax.vmap(lambda pose, key: disturb(pose, key, PoseErrors(sigma=3e-3), DT))
        made[label] = disturbed(simulation.exact_poses, jax.random.split(jax.random.key(4), WINDOWS))
    poses = np.concatenate([np.asarray(each) for each in made.values()])
    found = rf.identify(poses, dt=DT)
    sure = rf.covariance(found, poses, dt=DT)
    own = np.take_along_axis(np.asarray(sure.type_probability), found.linear.type_code[:, None], axis=1)
    np.testing.assert_allclose(own, 0.5, atol=1e-6)
    ties = np.asarray(sure.tied).reshape(-1, WINDOWS, 4)
    before = np.asarray(found.linear.tied).reshape(-1, WINDOWS, 4)
    for i, label in enumerate(made):
        true = rf.constraint(label).linear_type
        if true is None:
            assert np.mean(ties[i]) > 0.97
        else:
            assert np.mean(ties[i, :, true]) > 0.97
            assert np.mean(ties[i].sum(axis=1)) < 1.2 < np.mean(before[i].sum(axis=1))


def test_free_directions_have_no_variance(recordings):
    _, poses, found = recordings["A"]
    sure = rf.covariance(found, poses, dt=DT)
    assert np.all(np.trace(found.linear.free_position, axis1=1, axis2=2) == pytest.approx(1))
    along = np.einsum("nij,njk->nik", found.linear.free_position, sure.position)
    assert np.max(np.abs(along)) < 1e-9 * np.max(sure.position)
    # a revolute joint leaves the orientation of the linear frame open, and turns about the angular axis
    assert np.all(np.asarray(sure.linear_axes) == 0)
    axis = np.asarray(found.angular.axes)[:, :, 2:]
    assert np.max(np.abs(sure.angular_axes @ axis)) < 1e-9 * np.max(sure.angular_axes)
    assert np.all(sure.determined)


def test_what_the_motion_leaves_open_has_an_error_farther_than_any_search(recordings):
    """The point on the axis of a hinge, if the class did not leave it free."""
    _, poses, found = recordings["A"]
    poses, found = poses[:16], found[:16]
    closed = replace(found, linear=replace(found.linear, free_position=0 * found.linear.free_position))
    sure, usual = rf.covariance(closed, poses, dt=DT), rf.covariance(found, poses, dt=DT)
    assert np.all(usual.determined)
    # rounding may curve the objective a little along the axis
    left_open = ~np.asarray(sure.determined)
    assert left_open.sum() >= 4
    along = np.einsum("nij,nij->n", np.asarray(found.linear.free_position), np.asarray(sure.position))
    np.testing.assert_allclose(along[left_open], 100.0**2, rtol=0.01)
    total, across = (np.trace(each.position, axis1=1, axis2=2) for each in (sure, usual))
    assert np.all((total - along)[left_open] < 1.2 * across[left_open] + 1e-6)


def test_anything_computed_from_the_estimate(recordings):
    _, poses, found = recordings["K"]
    sure = rf.covariance(found[:3], poses[:3], dt=DT)
    np.testing.assert_allclose(sure.of(lambda one: one.linear.position, found[:3]), sure.position, atol=0)
    height = sure.of(lambda one: 2.0 * one.linear.position[2], found[:3])
    np.testing.assert_allclose(height[:, 0, 0], 4 * sure.position[:, 2, 2])
    normal = sure[0].of(lambda one: one.linear.axes[:, 0], found[0])
    axis = np.asarray(found[0].linear.axes)[:, 0]
    across = np.cross(np.eye(3), axis)
    np.testing.assert_allclose(normal, across @ sure[0].linear_axes @ across.T, atol=1e-15)


def test_one_window_is_as_in_a_batch(recordings):
    _, poses, found = recordings["H"]
    batch = rf.covariance(found[:2], poses[:2], dt=DT)
    times = DT * np.arange(SAMPLES + 1)
    single = rf.covariance(found[1], poses[1], times=times)
    assert_same(batch[1], single)


def test_long_recordings_are_padded():
    errors = PoseErrors(sigma=SIGMA)
    long = random_motion("K", jax.random.key(2), samples=99, dt=DT, excitation="exciting", errors=errors)
    poses = np.asarray(long.poses)
    found = rf.identify(poses[None], dt=DT)
    single = rf.covariance(found[0], poses, dt=DT)
    assert_same(rf.covariance(found, poses[None], dt=DT)[0], single)


def test_slow_errors_inflate(recordings):
    simulation, _, _ = recordings["A"]
    errors = PoseErrors(sigma=1e-4, slow=1e-3)
    disturbed = jax.vmap(lambda pose, key: disturb(pose, key, errors, DT))
    poses = np.asarray(disturbed(simulation.exact_poses, jax.random.split(jax.random.key(1), WINDOWS)))
    found = rf.identify(poses, dt=DT)
    measured = rf.covariance(found, poses, dt=DT)
    white = rf.covariance(found, poses, dt=DT, errors="white")
    assert np.all(np.asarray(white.inflation) == 1)
    assert np.median(measured.inflation[:, 0]) > 1.5
    ratio = measured.angular_axes / np.where(white.angular_axes == 0, 1, white.angular_axes)
    expected = np.broadcast_to(np.square(measured.inflation[:, :1, None]), ratio.shape)
    known = np.abs(white.angular_axes) > 1e-3 * np.max(np.abs(white.angular_axes))
    np.testing.assert_allclose(ratio[known], expected[known], rtol=1e-5)


def test_failed_windows_have_none(recordings):
    _, poses, found = recordings["K"]
    broken = poses[:2].copy()
    broken[1, 3, 0, 3] = np.nan
    sure = rf.covariance(rf.identify(broken, dt=DT), broken, dt=DT)
    assert np.all(np.isnan(sure.matrix[1]))
    assert not sure.determined[1]
    assert_same(sure[0], rf.covariance(found[:2], poses[:2], dt=DT)[0])


def test_what_is_refused(recordings):
    _, poses, found = recordings["K"]
    with pytest.raises(ValueError, match=r"of shape \(51, 4, 4\), not \(96, 51, 4, 4\)"):
        rf.covariance(found[0], poses, dt=DT)
    with pytest.raises(ValueError, match="either times"):
        rf.covariance(found[0], poses[0])
    with pytest.raises(ValueError, match="dt must have the shape"):
        rf.covariance(found[0], poses[0], dt=[DT, DT])
    with pytest.raises(ValueError, match="'derivative' or 'bootstrap'"):
        rf.covariance(found[0], poses[0], dt=DT, method="jackknife")
    with pytest.raises(ValueError, match="no model of the noise"):
        rf.covariance(found[0], poses[0], dt=DT, method="bootstrap", noise=NOISE)
    with pytest.raises(ValueError, match="'measured' or 'white'"):
        rf.covariance(found[0], poses[0], dt=DT, errors="red")
    other = replace(found[0], linear=replace(found[0].linear, norm=2 * found[0].linear.norm))
    with pytest.raises(ValueError, match="geometric mean"):
        rf.covariance(other, poses[0], dt=DT)


def test_the_benchmark_of_its_cost(tmp_path, capsys):
    """In miniature: a table with a row for every constraint and length, and the same figures in a file."""
    file = tmp_path / "cost.json"
    options = "--constraints K --samples 50 --windows 32 --repeats 2 --json"
    assert uncertainty_cost.main([*options.split(), str(file)]) == 0
    (row,) = json.loads(file.read_text())["rows"]
    assert (row["constraint"], row["samples"]) == ("K", 50)
    assert row["coverage"] > 0.8
    assert min(row["identify"], row["covariance"], row["ratio"], row["one covariance"]) > 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in lines if line.startswith("K ")] == [["K", "50"]]


def test_motion_that_does_not_turn_at_all_has_one_in_single_precision():
    """The velocities about its axes are too small for float32, and so is their mean."""
    times = np.linspace(0, 5, 51)
    poses = np.tile(np.eye(4), (51, 1, 1))
    poses[:, 0, 3] = np.sin(times)
    with jax.enable_x64(False):
        found = rf.identify(poses, times=times)
        assert np.any(found.angular.rms == 0)
        assert rf.covariance(found, poses, times=times).matrix.shape == (15, 15)

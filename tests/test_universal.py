"""Universal joints, whose two axes are fixed in one body each, and what is no such joint."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import reframe_jax as rf
from reframe_jax.export.columns import to_columns
from reframe_jax.identification import universal
from reframe_jax.identification.evidence import IN_BODY, reduce_windows
from reframe_jax.joints.fitting import fit_joint
from reframe_jax.storage.results import load_results

COUNT, DT = 101, 0.06
TIMES = DT * np.arange(COUNT)
CENTRE = np.array([0.4, -0.3, 0.9])


def signal(rng, size):
    """A random sum of slow sines of the RMS ``size``."""
    rates, phases = 2 * np.pi * 0.25 * np.exp(rng.normal(0, 0.4, 4)), rng.uniform(0, 2 * np.pi, 4)
    weights = rng.normal(size=4)
    return size * np.sin(np.outer(TIMES, rates) + phases) @ weights / np.linalg.norm(weights) * 2**0.5


def about_point(rng, rotation, noise):
    """Poses of a body that turns about a point, with noise in m and three times as much in rad."""
    lever = np.array([0.1, 0.05, -0.08])
    rotation = Rotation.from_rotvec(3 * noise * rng.normal(size=(COUNT, 3))) * rotation
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    poses[:, :3, :3] = rotation.as_matrix()
    poses[:, :3, 3] = CENTRE - rotation.apply(lever) + noise * rng.normal(size=(COUNT, 3))
    return poses


def on_universal(seed, noise=1e-4, skew=0.0, sizes=(0.5, 0.4)):
    """Poses on a universal joint, and its axes in {g} and {b}."""
    rng = np.random.default_rng(seed)
    first, second = np.array([1.0, 0, 0]), np.array([np.sin(skew), np.cos(skew), 0])
    outer, inner = Rotation.from_rotvec(rng.normal(size=3)), Rotation.from_rotvec(rng.normal(size=3))
    turns = [np.outer(signal(rng, size), axis) for size, axis in zip(sizes, (first, second), strict=True)]
    rotation = outer * Rotation.from_rotvec(turns[0]) * Rotation.from_rotvec(turns[1]) * inner
    return about_point(rng, rotation, noise), (outer.apply(first), inner.inv().apply(second))


def in_socket(seed, noise=1e-4):
    """Poses of a ball in its socket."""
    rng = np.random.default_rng(seed)
    turn = np.stack([signal(rng, size) for size in (0.5, 0.4, 0.3)], axis=1)
    return about_point(rng, Rotation.from_rotvec(rng.normal(size=3)) * Rotation.from_rotvec(turn), noise)


@pytest.fixture(scope="module")
def joints():
    """24 universal joints, every third of them skewed, and their identification."""
    made = [on_universal(seed, skew=0.3 * (seed % 3 == 0)) for seed in range(24)]
    poses = np.stack([poses for poses, _ in made])
    return poses, np.array([axes for _, axes in made]), rf.identify(poses, dt=DT)


def test_their_name_and_axes(joints):
    _, axes, found = joints
    assert set(found.name) == {"Universal joint"}
    assert np.min(found.probability) > 0.85
    np.testing.assert_array_equal(np.sum(found.angular.dof, axis=1), 3)  # to a frame, a ball in its socket
    cosine = np.abs(np.sum(np.asarray(found.universal_axes) * axes, axis=-1))
    assert np.degrees(np.arccos(np.minimum(cosine, 1))).max() < 0.3


def test_a_ball_in_its_socket_is_none():
    found = rf.identify(np.stack([in_socket(seed) for seed in range(24)]), dt=DT)
    assert set(found.name) == {"Spherical joint"}
    assert np.max(found.universal_probability) < 0.2
    assert np.all(np.isnan(found.universal_axes))
    spherical = np.sum(np.asarray(found.class_probability)[:, :, 3, 0], axis=1)
    np.testing.assert_allclose(found.probability, spherical * (1 - found.universal_probability), rtol=1e-12)


def test_whose_second_axis_hardly_turned():
    """The third direction is then still to a frame, which finds two rotations."""
    poses, _ = on_universal(1, noise=3e-4, sizes=(0.1, 0.02))
    found = rf.identify(poses, dt=DT)
    assert (found.name, int(np.sum(found.angular.dof))) == ("Universal joint", 2)
    assert np.all(np.isfinite(found.universal_axes))
    both = np.sum(np.asarray(found.class_probability)[:, 2:, 0], axis=0)
    assert found.probability == pytest.approx(both[0] + float(found.universal_probability) * both[1])


def test_what_does_not_turn_about_a_point_is_none():
    rng = np.random.default_rng(0)
    poses = in_socket(1)
    poses[:, :2, 3] += np.stack([signal(rng, 0.1) for _ in range(2)], axis=1)
    found = rf.identify(poses, dt=DT)
    assert found.universal_probability == 0
    assert np.all(np.isnan(found.universal_axes))


def test_one_window_and_a_batch_say_the_same(joints):
    poses, _, batch = joints
    found = rf.identify(poses[3], dt=DT)
    np.testing.assert_allclose(found.universal_probability, batch.universal_probability[3], rtol=1e-4)
    cosine = np.sum(np.asarray(found.universal_axes * batch.universal_axes[3]), axis=-1)
    np.testing.assert_allclose(np.abs(cosine), 1, atol=1e-9)


def test_exact_and_single_precision():
    poses, axes = on_universal(4, noise=0.0)
    for given, error in ((poses, 1e-6), (poses.astype(np.float32), 1e-2)):
        found = rf.identify(given, dt=DT)
        assert found.name == "Universal joint"
        cosine = np.abs(np.sum(np.asarray(found.universal_axes) * axes, axis=-1))
        assert np.sqrt(2 * np.maximum(1 - cosine, 0)).max() < error


def test_the_covariance_of_all_entries_follows_from_the_moments():
    """Also of those products that the moments hold as sums only."""
    poses = in_socket(2)
    reduce = jax.jit(reduce_windows, static_argnums=(4, 5))
    evidence = reduce(jnp.asarray(poses)[None], jnp.full(COUNT - 1, DT), None, None, "single", "chord")
    mean = evidence.mean_paths[:, 1:, :, 0]
    found = universal._covariance(universal._pairs(evidence.linear_spread[..., IN_BODY]), mean)
    moved = poses[:, :3, :3] - poses[:, :3, :3].mean(axis=0)
    expected = np.einsum("kia,kjb->iajb", moved, moved) / COUNT
    np.testing.assert_allclose(found[..., 0], expected, atol=1e-12)
    np.testing.assert_allclose(mean[..., 0], poses[:, :3, :3].mean(axis=0), atol=1e-12)


def test_reports_say_it(joints):
    _, _, batch = joints
    found = batch[0]
    ground, body = np.asarray(found.universal_axes)
    assert "in the ground and" in rf.to_table(found).split("Turns   about ")[1]
    assert "It turns about the directions" in found.explain()
    (record,) = json.loads(rf.to_json(found))["recordings"][0]["windows"]
    assert record["universal_axes"] == {"ground": ground.tolist(), "body": body.tolist()}
    assert record["universal_probability"] == float(found.universal_probability)
    columns = to_columns(batch)
    np.testing.assert_array_equal(columns["universal_ground_y"], batch.universal_axes[:, 0, 1])
    socket = json.loads(rf.to_json(rf.identify(in_socket(1), dt=DT)))["recordings"][0]["windows"][0]
    assert socket["universal_axes"] is None


def test_the_joint_has_two_hinges(joints):
    poses, axes, batch = joints
    joint = batch[1].to_joint(poses[1])
    assert (joint.type, joint.name) == ("universal", "Universal joint")
    assert [part.kind for part in joint.parts] == ["hinge", "hinge"]
    assert joint.rotation_error < 2e-3
    assert abs(joint.parts[0].axis @ axes[1, 0]) > 0.9999
    frame = batch[1].constraint_frame
    assert fit_joint(frame, poses[1]).type == "spherical"
    with pytest.raises(ValueError, match="two unit vectors"):
        fit_joint(frame, poses[1], universal=np.ones((2, 3)))
    slides = dataclasses.replace(frame, linear_dof=(0, 0, 1))
    with pytest.raises(ValueError, match="about a point"):
        fit_joint(slides, poses[1], universal=axes[1])


def test_results_are_stored(joints, tmp_path):
    poses, _, batch = joints
    loaded = load_results(rf.identify_many(poses[:4], tmp_path / "out", dt=DT))
    assert list(loaded.name) == ["Universal joint"] * 4
    np.testing.assert_allclose(loaded.universal_axes, batch.universal_axes[:4], atol=1e-9)

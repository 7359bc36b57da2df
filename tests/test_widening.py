"""Origins beyond the box of the search: it is widened where the motion says so, and only there."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.constraints.types import AngularType
from reframe_jax.identification.cautions import Caution
from reframe_jax.simulation import metrics, motions, synthetic
from reframe_jax.solvers import Box

SEEDS = 8


@functools.cache
def windows(label, distance, excitation="exciting", noise=1e-4):
    """Poses (8, 51, 4, 4) of a body whose origin starts so far, in m, from that of the frame; and frames."""

    def one(key):
        geometry_key, away_key, motion_key = jax.random.split(key, 3)
        drawn, start = motions.random_constraint(label, geometry_key)
        away = jax.random.normal(away_key, (3,))
        away = distance * away / jnp.linalg.norm(away)
        kind = drawn.linear_type
        in_ground = kind is not None and kind.position_body == AngularType.G
        position = start[:3, :3] @ away + start[:3, 3] if in_ground else away
        frame = rf.ConstraintFrame.named(
            label, linear_type=kind, rotvec=drawn.linear_rotvec, position=position
        )
        simulated = synthetic.simulate(frame, motion_key, noise=noise, start=start, excitation=excitation)
        return simulated.poses, frame

    poses, frames = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(11), SEEDS))
    return np.asarray(poses), frames


def says(found, caution):
    return np.asarray(found.warnings) & caution > 0


@pytest.mark.parametrize("distance", [1.5, 4.0])
@pytest.mark.parametrize("label", "EK")
def test_far_origins_are_found_and_said_to_be_far(label, distance):
    poses, truth = windows(label, distance)
    found = rf.identify(poses, dt=0.1)
    assert set(found.name) == {rf.CONSTRAINTS[label].name}
    # along free directions the nearest origin may well be near
    assert np.any(says(found, Caution.FAR_ORIGIN))
    if label == "K":  # of which no direction is free
        assert np.all(says(found, Caution.FAR_ORIGIN))
        assert np.all(np.asarray(metrics.geometry_errors(found, truth).position) < 0.05)


@pytest.mark.parametrize("label", "AEFIJ")
def test_far_origins_of_planar_motion_are_found_although_nothing_points_there(label):
    """Half of these have an optimum inside the first box: of a body in a plane, or along a contour."""
    poses, _ = windows(label, 8.0, "hand", 1e-5)
    assert set(rf.identify(poses, dt=0.1).name) == {rf.CONSTRAINTS[label].name}


@pytest.mark.parametrize("label", "DG")
def test_windows_that_need_no_widening_are_searched_as_with_bounds(label):
    poses, _ = windows(label, 0.4)
    found = rf.identify(poses, dt=0.1)
    assert not np.any(says(found, Caution.FAR_ORIGIN))
    assert np.all(found.status_code == rf.Status.OK)
    for x, y in zip(
        jax.tree.leaves(found), jax.tree.leaves(rf.identify(poses, dt=0.1, bounds=1.0)), strict=True
    ):
        np.testing.assert_array_equal(x, y)


def test_bounds_that_were_given_are_kept_and_judged_where_the_search_ended():
    poses, _ = windows("K", 4.0)
    found = rf.identify(poses, dt=0.1, bounds=1.0)
    assert np.all(found.status_code == rf.Status.ON_BOUNDS)
    assert not np.any(says(found, Caution.FAR_ORIGIN))


@pytest.mark.parametrize("bounds", [1e-3, 1e-9])
def test_a_tiny_box_that_excludes_the_origin_is_noticed(bounds):
    poses, _ = windows("K", 0.4)
    found = rf.identify(poses, dt=0.1, bounds=bounds)
    assert np.all(found.status_code == rf.Status.ON_BOUNDS)


def test_one_window_says_in_words_what_a_batch_says_in_codes():
    poses, _ = windows("K", 4.0)
    found = rf.identify(poses[0], dt=0.1)
    assert found.name == "Pin-plane contact"
    (warning,) = found.warnings
    assert "more than 1 m away" in warning
    assert warning in rf.to_table(found).splitlines()
    assert warning in rf.to_json(found)
    batch = rf.identify(poses, dt=0.1)
    assert batch.warnings[0] == found.warning_codes == Caution.FAR_ORIGIN
    assert batch[0].warnings == found.warnings


def test_a_box_of_every_problem_has_its_own_faces():
    box = Box(jnp.array([[-1.0, -2.0]] * 3), jnp.array([[1.0, 2.0]] * 3))
    points = jnp.array([[1.0, 0.0, -1.0], [1.0, 0.0, -2.0]])
    np.testing.assert_array_equal(box.at_face(points), [[True, False, True], [False, False, True]])

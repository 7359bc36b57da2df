"""A frame between two bodies: which part hangs on which, and the velocities that follow."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.constraints.frame import (
    Frame,
    assemble_frame,
    body_twist,
    fixed_on_body,
    frame_arrays,
    ground_twist,
    locate,
    locate_on_host,
    move_frame,
    place_frame,
)
from reframe_jax.geometry import transforms

POSE = transforms.pose_exp(jnp.asarray([0.4, -0.9, 0.7, 1.0, -2.0, 3.0]))
ROTATION, POSITION = POSE[:3, :3], POSE[:3, 3]
LETTERS = {"G": False, "B": True}


def frame_of(label: str, rng: np.random.Generator) -> rf.ConstraintFrame:
    return rf.ConstraintFrame.named(label, rotvec=rng.normal(size=3), position=rng.normal(size=3))


def test_letters_say_what_hangs_on_what() -> None:
    for angular in rf.AngularType:
        for linear in rf.LinearType:
            expected = [LETTERS[letter] for letter in (angular.name, *linear.name)]
            frame = replace(rf.ConstraintFrame.named("K"), angular_type=angular, linear_type=linear)
            assert list(fixed_on_body(frame)) == expected
            assert frame_arrays(frame).on_body.tolist() == expected


@pytest.mark.parametrize("label", ["K", "L", "G", "H"])  # GB, BG, BB, GG
def test_both_twists_are_one(label: str, rng: np.random.Generator) -> None:
    """In the axes of {b} and of {g}, from the frame's own axes and from its place."""
    frame = frame_arrays(frame_of(label, rng))
    velocities = jnp.asarray(rng.normal(size=6))
    in_ground = ground_twist(locate(frame, ROTATION, POSITION), velocities)
    in_body = body_twist(frame, ROTATION, POSITION, velocities)
    turned = np.concatenate([ROTATION @ in_body[:3], ROTATION @ in_body[3:]])
    np.testing.assert_allclose(turned, in_ground, atol=1e-14)


def test_frames_of_a_batch_may_differ_in_type(rng: np.random.Generator) -> None:
    frames = [frame_of(label, rng) for label in "KL"]
    together = assemble_frame(
        (
            jnp.asarray([int(frame.angular_type) for frame in frames]),
            jnp.asarray([int(frame.linear_type) for frame in frames]),
        ),
        (
            jnp.stack([frame.angular_axes for frame in frames]),
            jnp.stack([frame.linear_axes for frame in frames]),
        ),
        jnp.stack([frame.position for frame in frames]),
        (
            np.array([frame.angular_dof for frame in frames]),
            np.array([frame.linear_dof for frame in frames]),
        ),
    )
    expected: Frame = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(frame_arrays, frames))
    for got, want in zip(jax.tree.leaves(together), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(got, want)


@pytest.mark.parametrize("label", ["K", "L"])
def test_a_frame_is_where_it_was_placed_or_moved_to(label: str, rng: np.random.Generator) -> None:
    axes = transforms.pose_exp(jnp.asarray(rng.normal(size=6)))[:3, :3]
    origin, shift = jnp.asarray(rng.normal(size=(2, 3)))
    put = place_frame(frame_of(label, rng), axes, origin, ROTATION, POSITION)
    there = locate(frame_arrays(put), ROTATION, POSITION)
    for found in (there.angular_axes, there.linear_axes):
        np.testing.assert_allclose(found, axes, atol=1e-14)
    np.testing.assert_allclose(POSITION + there.lever, origin, atol=1e-14)
    moved = locate(frame_arrays(move_frame(put, axes, shift, ROTATION)), ROTATION, POSITION)
    np.testing.assert_allclose(moved.linear_axes, axes @ axes, atol=1e-14)
    np.testing.assert_allclose(moved.angular_axes, axes @ axes, atol=1e-14)
    np.testing.assert_allclose(POSITION + moved.lever, origin + shift, atol=1e-14)


def test_drawings_are_precise_far_away(rng: np.random.Generator) -> None:
    """A million metres from the origin, where JAX is set to single precision."""
    frame = frame_of("K", rng)
    poses = np.tile(np.asarray(POSE), (3, 1, 1))
    poses[:, 0, 3] += 1e6
    expected = np.asarray(ROTATION @ frame.position)
    with jax.enable_x64(False):
        there = locate_on_host(frame, poses)
    assert isinstance(there.lever, np.ndarray)
    assert there.lever.dtype == np.float64
    np.testing.assert_allclose(there.lever, np.tile(expected, (3, 1)), atol=1e-14)
    np.testing.assert_allclose(there.path, poses[:, :3, 3] + expected, rtol=1e-15)

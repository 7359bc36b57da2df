"""Cramér-Rao bounds: known figures, and the same information with the poses eliminated in another way."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.bounds import cramer_rao
from benchmarks.motions import random_motion
from reframe_jax import CONSTRAINTS, AngularType, ConstraintFrame, LinearType
from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.simulation.synthetic import Simulation

STEPS, DT = 20, 0.1
RATIO = 4.0
IN_GROUND, ON_BODY = np.zeros(3), np.array([-0.5, 0.0, 0.0])


def hinge(angle_range: float) -> jax.Array:
    """The body 0.5 m from a hinge along y, swung there and back in 101 samples: (1, 101, 4, 4)."""
    angles = np.radians(angle_range) / 2 * np.sin(2 * np.pi * np.linspace(0, 1, 101))
    poses = np.tile(np.eye(4), (101, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(angles[:, None] * [0, 1, 0]).as_matrix()
    poses[:, :3, 3] = poses[:, :3, 0] * 0.5
    return jnp.asarray(poses)[None]


@pytest.mark.parametrize(
    ("angle_range", "turn", "line", "axis"),
    [(60, 3e-3, 0.57, 0.054), (60, 17e-3, 1.6, 0.18), (20, 3e-3, 1.7, 0.16)],
)
def test_known_figures_of_a_hinge(angle_range, turn, line, axis):
    frame = ConstraintFrame.named("A", linear_type=LinearType.BG, position=IN_GROUND)
    bound = cramer_rao(frame, hinge(angle_range), 1e-3, turn / 1e-3)
    np.testing.assert_allclose(1e3 * bound.position[0, int(LinearType.BG)], line, rtol=0.03)
    np.testing.assert_allclose(np.degrees(bound.angular[0, int(AngularType.G)]), axis, rtol=0.03)


def test_the_bound_does_not_depend_on_the_type_that_a_hinge_is_written_in():
    types = {
        LinearType.BG: IN_GROUND,
        LinearType.GB: ON_BODY,
        LinearType.BB: ON_BODY,
        LinearType.GG: IN_GROUND,
    }
    bounds = [
        cramer_rao(ConstraintFrame.named("A", linear_type=kind, position=at), hinge(60), 1e-3, RATIO)
        for kind, at in types.items()
    ]
    for bound in bounds[1:]:
        np.testing.assert_allclose(bound.position, bounds[0].position, rtol=1e-6)
        np.testing.assert_allclose(bound.angular, bounds[0].angular, rtol=1e-6)


@pytest.mark.parametrize("height", [0.0, 0.3])
def test_the_poses_of_a_hinge_can_be_unknowns_instead(height):
    poses = hinge(60)[0, ::5].at[:, 1, 3].add(height)
    on_body = jnp.asarray(ON_BODY) - jnp.array([0, height, 0])  # the point (0, 0, 0) of the ground
    angles = jnp.arctan2(poses[:, 0, 2], poses[:, 0, 0])

    def measured(unknown: jax.Array) -> jax.Array:
        """Errors (21, 6) in units of their deviation, from axes, two points and the angles."""
        tilt, tilt_body, at, at_body = (unknown[i : i + 3] for i in (0, 3, 6, 9))
        swing = jax.vmap(lambda a: rotation_exp(jnp.array([0.0, 1.0, 0.0]) * a))(angles + unknown[12:])
        turn = rotation_exp(tilt)[None] @ swing @ rotation_exp(tilt_body).T[None]
        shift = at[None] - turn @ (on_body + at_body)
        error = turn @ poses[:, :3, :3].mT
        rotvec = jnp.stack([error[:, 2, 1], error[:, 0, 2], error[:, 1, 0]], axis=-1) / RATIO
        return jnp.concatenate([rotvec, shift - poses[:, :3, 3]], axis=-1)

    derivative = np.asarray(jax.jacfwd(measured)(jnp.zeros(12 + len(poses)))).reshape(6 * len(poses), -1)
    covariance = np.linalg.pinv(derivative.T @ derivative, rcond=1e-11)
    frame = ConstraintFrame.named("A", linear_type=LinearType.GG, position=IN_GROUND)
    bound = cramer_rao(frame, poses[None], 1.0, RATIO)
    np.testing.assert_allclose(bound.angular[0, 0], np.sqrt(covariance[0, 0] + covariance[2, 2]), rtol=1e-6)
    # the point of the axis nearest to the body moves with the tilt
    shift = np.zeros((2, 12 + len(poses)))
    shift[[0, 1], [6, 8]] = 1
    shift[:, :3] = np.cross(np.eye(3), [0, height, 0]).T[[0, 2]]
    variance = np.trace(shift @ covariance @ shift.T)
    np.testing.assert_allclose(bound.position[0, int(LinearType.GG)], np.sqrt(variance), rtol=1e-6)


def test_pairs_of_poses_have_the_whole_banded_covariance():
    motion = random_motion("G", jax.random.key(4), samples=STEPS, dt=DT, excitation="exciting")
    poses, frame = np.asarray(motion.exact_poses), motion.truth

    def slip(rotvec: np.ndarray, origin: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Movement of the point along the normal, step by step, (STEPS,)."""
        normal = np.asarray(frame.linear_axes) @ Rotation.from_rotvec(rotvec).as_matrix()[:, 2]
        turn = Rotation.from_rotvec(noise[:, :3]).as_matrix() @ poses[:, :3, :3]
        at = poses[:, :3, 3] + noise[:, 3:] + turn @ (np.asarray(frame.position) + origin)
        mean = (turn[1:] + turn[:-1]) / 2
        return np.sum((mean @ normal) * np.diff(at, axis=0), axis=1)

    def central(function, size):
        steps = 1e-5 * np.eye(size)
        return np.stack([(function(s) - function(-s)) / 2e-5 for s in steps], axis=-1)

    still, calm = np.zeros(3), np.zeros((STEPS + 1, 6))
    by_noise = central(lambda e: slip(still, still, e.reshape(-1, 6)), 6 * (STEPS + 1))
    variance = np.tile(np.repeat([RATIO**2, 1.0], 3), STEPS + 1)
    by_frame = np.concatenate(
        [central(lambda r: slip(r, still, calm), 3), central(lambda p: slip(still, p, calm), 3)], axis=1
    )
    information = by_frame.T @ np.linalg.solve((by_noise * variance) @ by_noise.T, by_frame)
    covariance = np.linalg.pinv(information, rcond=1e-9)
    bound = cramer_rao(frame_of_one(frame), motion.exact_poses[None], 1.0, RATIO)
    np.testing.assert_allclose(bound.linear[0, 0], np.sqrt(covariance[0, 0] + covariance[1, 1]), rtol=1e-4)
    # the point nearest to the body's origin lies elsewhere along the normal
    axes, away = (
        np.asarray(frame.linear_axes),
        -(np.asarray(frame.linear_axes).T @ np.asarray(frame.position)),
    )
    shift = np.zeros((2, 6))
    shift[:, :3] = np.cross(np.eye(3), [0, 0, away[2]]).T[:2]
    shift[:, 3:] = axes.T[:2]
    np.testing.assert_allclose(
        bound.position[0, 0], np.sqrt(np.trace(shift @ covariance @ shift.T)), rtol=1e-4
    )


def two_motions(label: str) -> Simulation:
    motion = partial(random_motion, label, samples=STEPS, dt=DT, excitation="exciting")
    return jax.vmap(motion)(jax.random.split(jax.random.key(1), 2))


def frame_of_one(frame: ConstraintFrame) -> ConstraintFrame:
    return jax.tree.map(lambda leaf: leaf[None], frame)


@pytest.mark.parametrize("label", list(CONSTRAINTS))
def test_every_class_has_a_bound_for_what_is_unique(label):
    motion = two_motions(label)
    bound = cramer_rao(motion.truth, motion.exact_poses, jnp.array([1e-3, 2e-6]), RATIO)
    entry, kind = CONSTRAINTS[label], int(motion.truth.linear_type)
    for values, unique in (
        (bound.angular[:, int(motion.truth.angular_type)], entry.angular_axis is not None),
        (bound.linear[:, kind], entry.linear_axis is not None),
        (bound.position[:, kind], any(entry.position)),
    ):
        if unique:
            assert np.isfinite(values).all()
            assert (values > 0).all()
            assert values[1] < 0.1 * values[0]
        else:
            assert np.isnan(values).all()


def test_what_the_motion_leaves_open_has_no_bound():
    slide = np.tile(np.eye(4), (1, 21, 1, 1))
    slide[0, :, 0, 3] = np.linspace(0, 1, 21)
    bound = cramer_rao(ConstraintFrame.named("C"), jnp.asarray(slide), 1e-3, RATIO)
    assert np.isinf(bound.position).all()
    assert np.isfinite(bound.linear).all()


def test_other_classes_and_single_precision_are_refused():
    frame = ConstraintFrame.named("A")
    with pytest.raises(TypeError, match="float64 poses, not float32"):
        cramer_rao(frame, hinge(60).astype(jnp.float32), 1e-3, RATIO)
    turned = ConstraintFrame(
        frame.angular_type, (1, 0, 0), frame.linear_type, (1, 1, 0), *jax.tree.leaves(frame)
    )
    with pytest.raises(ValueError, match="twelve constraints"):
        cramer_rao(turned, hinge(60), 1e-3, RATIO)

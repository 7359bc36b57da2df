"""Screws, universal joints, far origins and repeatable errors: names and geometry, from one batch."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import reframe_jax as rf
from reframe_jax.export.columns import to_columns
from reframe_jax.identification.cautions import Caution
from reframe_jax.joints.fitting import fit_joint

POSES, DT, NOISE = 51, 0.1, 1e-4
TIMES = DT * np.arange(POSES)
PITCHES = (0.02, -0.02, 0.1, 0.005, -0.1, 0.05, 0.16, -0.01)
SCREWS, UNIVERSAL, DISTANT, REPEATABLE = slice(0, 8), slice(8, 16), slice(16, 24), slice(24, 36)
DISTANCE = 4.0  # m, of the far origins from the body


def signal(rng, size):
    """A sum of slow sines (51,) of the RMS ``size``."""
    rates, phases = rng.uniform(0.1, 0.5, (4, 1)), rng.uniform(0, 6, (4, 1))
    made = np.sum(rng.uniform(0.5, 1, (4, 1)) * np.sin(2 * np.pi * rates * TIMES + phases), axis=0)
    return size * made / np.std(made)


def with_noise(rng, rotation, position, noise=NOISE):
    """Poses (51, 4, 4) with noise in m, and three times as much in rad."""
    poses = np.tile(np.eye(4), (POSES, 1, 1))
    poses[:, :3, :3] = (Rotation.from_rotvec(3 * noise * rng.normal(size=(POSES, 3))) * rotation).as_matrix()
    poses[:, :3, 3] = position + noise * rng.normal(size=(POSES, 3))
    return poses


def on_screw(rng, pitch):
    """Poses of a nut, and its axis."""
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    point, start = rng.uniform(-0.3, 0.3, (2, 3))
    angle = signal(rng, 0.8)
    turn = Rotation.from_rotvec(angle[:, None] * axis)
    position = point + turn.apply(start - point) + pitch * angle[:, None] * axis
    return with_noise(rng, turn * Rotation.random(random_state=rng), position), axis


def on_universal(rng, second=0.4, noise=NOISE):
    """Poses on a universal joint, and its axes in the ground and in the body."""
    outer, inner = Rotation.random(random_state=rng), Rotation.random(random_state=rng)
    turns = [np.outer(signal(rng, size), axis) for size, axis in ((0.5, [1, 0, 0]), (second, [0, 1, 0]))]
    rotation = outer * Rotation.from_rotvec(turns[0]) * Rotation.from_rotvec(turns[1]) * inner
    poses = with_noise(rng, rotation, -rotation.apply([0.1, 0.05, -0.08]), noise)
    return poses, (outer.apply([1, 0, 0]), inner.inv().apply([0, 1, 0]))


def on_wide_universal(rng):
    """Poses on a universal joint that turns by more than half a turn about each axis."""
    part = TIMES / TIMES[-1]
    step = 10 * part**3 - 15 * part**4 + 6 * part**5
    angles = []
    for sign in (1, rng.choice([-1, 1])):
        rate, phase = rng.uniform(1, 3), rng.uniform(0, 6)
        angles.append(3.3 * sign * step + 0.33 * np.sin(2 * np.pi * rate * part + phase))
    turns = [np.outer(angle, axis) for angle, axis in zip(angles, ([1, 0, 0], [0, 1, 0]), strict=True)]
    rotation = Rotation.from_rotvec(turns[0]) * Rotation.from_rotvec(turns[1])
    return with_noise(rng, rotation, -rotation.apply([0.1, 0.05, -0.08]))


def on_distant_plane(rng):
    """Poses of a body of which a point stays on a plane, and that point in the body."""
    tip = rng.normal(size=3)
    tip *= DISTANCE / np.linalg.norm(tip)
    rotation = Rotation.from_rotvec(np.stack([signal(rng, 0.3) for _ in range(3)], axis=1))
    plane = np.stack([signal(rng, 0.2), signal(rng, 0.2), 0 * TIMES], axis=1)
    return with_noise(rng, rotation, plane - rotation.apply(tip)), tip


def on_inaccurate_hinge(rng):
    """Poses on a hinge, with errors of 0.5 mm and 2.5 mrad that depend on the angle only."""
    axis, start = Rotation.random(random_state=rng).apply([0, 0, 1]), rng.uniform(-0.3, 0.3, 3)
    angle = signal(rng, 0.5)
    shift, turned = np.einsum(
        "fk,afi->aki", [angle, angle**2 - np.mean(angle**2)], rng.normal(size=(2, 2, 3))
    )
    turn = Rotation.from_rotvec(angle[:, None] * axis)
    poses = np.tile(np.eye(4), (POSES, 1, 1))
    poses[:, :3, :3] = (Rotation.from_rotvec(2.5e-3 * turned / np.std(turned)) * turn).as_matrix()
    poses[:, :3, 3] = turn.apply(start) + 5e-4 * shift / np.std(shift) + 1e-6 * rng.normal(size=(POSES, 3))
    return poses, axis


@pytest.fixture(scope="module")
def made():
    """Poses (36, 51, 4, 4) of screws, universal joints, far points and inaccurate hinges; their truth."""
    rng = np.random.default_rng(4)
    each = [on_screw(rng, pitch) for pitch in PITCHES]
    each += [on_universal(rng) for _ in range(8)]
    each += [on_distant_plane(rng) for _ in range(8)]
    each += [on_inaccurate_hinge(rng) for _ in range(12)]
    return np.stack([poses for poses, _ in each]), [truth for _, truth in each]


@pytest.fixture(scope="module")
def found(made):
    return jax.device_get(rf.identify(made[0], dt=DT))


def test_a_nut_on_a_screw_is_named_with_its_pitch_and_axis(made, found):
    screws, axes = found[SCREWS], made[1][SCREWS]
    assert set(screws.name) == {"Screw joint"}
    assert np.all(screws.probability > 0.5)
    np.testing.assert_allclose(screws.pitch, PITCHES, atol=5e-4)
    assert np.all(np.isnan(np.delete(found.pitch, np.r_[SCREWS, REPEATABLE])))
    for one, poses, axis in zip((screws[i] for i in range(8)), made[0][SCREWS], axes, strict=True):
        along = Rotation.from_rotvec(np.array(one.linear.rotvec)).as_matrix()[:, 2]
        if one.linear.frame_type.orientation_body == rf.AngularType.B:
            along = np.mean(poses[:, :3, :3] @ along, axis=0)
        assert np.linalg.norm(np.cross(along, axis)) < 1e-3
        assert one.entry is rf.constraint("screw")


def test_all_turns_of_a_long_screw_are_counted():
    """1,500 turns in 8,000 poses, of which a subsample would miss turns."""
    angle = np.linspace(0, 2 * np.pi * 1500, 8000)
    poses = np.tile(np.eye(4), (len(angle), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.outer(angle, [0, 0, 1])).as_matrix()
    poses[:, 2, 3] = 1e-3 * angle
    frame = rf.ConstraintFrame.named("C", linear_type=rf.LinearType.GB)
    axes = {"angular_rotvec": np.zeros(3), "linear_rotvec": np.zeros(3), "position": np.zeros(3)}
    frame = replace(frame, angular_dof=(0, 0, 1), linear_dof=(0, 0, 1), **axes)
    joint = fit_joint(frame, poses, pitch=1e-3)
    assert joint.position_error < 1e-6
    np.testing.assert_allclose(joint.range, (0, angle[-1]), atol=1e-3)


def test_outputs_give_the_pitch(found):
    one = found[1]
    lines = one.explain().splitlines()
    assert lines[0].startswith("The body moves like a nut on a screw")
    assert lines[2].startswith("The axis passes through")
    assert "mm along the axis; the thread is left-handed." in lines[3]
    assert "mm per turn, left-handed" in rf.to_table(one)
    (window,) = json.loads(rf.to_json(one))["recordings"][0]["windows"]
    assert (window["name"], window["label"], window["pitch"]) == ("Screw joint", "screw", float(one.pitch))
    np.testing.assert_array_equal(to_columns(found)["pitch_m_rad"], found.pitch)


def test_axes_of_coupled_joints_are_not_separate(found, made):
    one = found[1]
    assert one.linear.free_probability[2] > 0.9
    assert jax.jit(lambda of: of.probability)(one) == pytest.approx(one.probability)
    poses = np.asarray(made[0][1])
    with pytest.raises(ValueError, match="No motions of separate axes for this result: Screw joint"):
        rf.next_motion(one, poses, times=DT * np.arange(len(poses)))
    with pytest.raises(ValueError, match="Screw joint couples its axes"):
        rf.to_task_frame(one, poses[-1])


def test_universal_joints_with_large_rotations_are_named():
    rng = np.random.default_rng(0)
    found = rf.identify(np.stack([on_wide_universal(rng) for _ in range(36)]), dt=DT)
    assert np.mean(found.name == "Universal joint") >= 0.9


def test_universal_joints_are_named_if_one_rotation_is_small():
    """The angle between nearly parallel axes changes less than the noise; such axes describe no joint."""
    rng = np.random.default_rng(1)
    poses = np.stack([on_universal(rng, second=0.05, noise=1e-3)[0] for _ in range(36)])
    assert np.mean(rf.identify(poses, dt=DT).name == "Universal joint") >= 0.9
    ground, body = np.moveaxis(rf.identify(poses, dt=DT, assume="universal joint").universal_axes, 1, 0)
    assert np.all(np.abs(np.einsum("ni,nij,nj->n", ground, poses[:, :, :3, :3].mean(axis=1), body)) < 0.5)


def test_a_universal_joint_is_named_with_its_axes(made, found):
    joints, axes = found[UNIVERSAL], np.array(made[1][UNIVERSAL])
    right = joints.name == "Universal joint"
    assert np.mean(right) >= 0.5
    joints, axes = joints[right], axes[right]
    np.testing.assert_array_equal(np.sum(joints.angular.dof, axis=1), 2)
    cosine = np.abs(np.sum(joints.universal_axes * axes, axis=-1))
    assert np.degrees(np.arccos(np.minimum(cosine, 1))).max() < 1
    assert np.all(np.isnan(found[DISTANT].universal_axes))
    one = joints[0]
    table = rf.to_table(one)
    assert "Turns   about" in table
    assert "Angular frame" not in table
    (window,) = json.loads(rf.to_json(one))["recordings"][0]["windows"]
    np.testing.assert_array_equal(window["universal_axes"]["body"], one.universal_axes[1])
    assert one.explain().splitlines()[-1].startswith("It turns about the directions")


def test_far_origins_are_found(made, found):
    distant, tips = found[DISTANT], np.array(made[1][DISTANT])
    assert set(distant.name) == {"Pin-plane contact"}
    assert np.all(distant.status_code == rf.Status.OK)
    assert np.linalg.norm(distant.linear.position - tips, axis=1).max() < 0.05


def test_an_assumed_joint_is_reported_and_bounds_that_exclude_its_origin_are_noticed(made):
    found = rf.identify(made[0], dt=DT, assume="K", bounds=1.0)
    assert set(found.name) == {"Pin-plane contact"}
    assert np.all((found.probability >= 0) & (found.probability < 0.1))  # no window is of this kind
    assert np.all(found.warning_codes & Caution.IMPROBABLE_ASSUMED)
    assert not np.any(found.warning_codes & Caution.IMPROBABLE)  # it asks for another recording
    assert np.all(found.status_code[DISTANT] == rf.Status.ON_BOUNDS)
    one = found[DISTANT][0]
    assert rf.Status.ON_BOUNDS.message in one.warnings
    assert rf.Status.ON_BOUNDS.message in one.explain()


def test_most_hinges_are_named_right_if_their_errors_depend_on_the_angle_only(found):
    names = found.name[REPEATABLE]
    assert np.sum(names == "Revolute joint") >= 6, names  # 9 of 12; without a limit of the variances 2

"""Bodies on a screw: their name, pitch and axis, and what is no screw."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import reframe_jax as rf
from reframe_jax.export.columns import to_columns
from reframe_jax.export.json import to_record
from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.identification.cautions import Caution
from reframe_jax.simulation import synthetic
from reframe_jax.simulation.excitations import EXCITATIONS
from reframe_jax.simulation.motions import PoseErrors, random_motion
from reframe_jax.storage.results import load_results

axes_of = jax.jit(rotation_exp)
DT, TIMES = 0.1, 0.1 * np.arange(51)
WINDOWS = 8


class Nuts:
    """Poses (8, 51, 4, 4) of bodies that turn about random axes, and the axes and points on them."""

    def __init__(self, pitch, noise=1e-4, ratio=3.0, span=2.0, shape=None, slide=None, seed=0):
        """Slide in proportion to the turn, whose range is the span in rad, or in a way of their own."""
        rng = np.random.default_rng(seed)
        self.axes = rng.normal(size=(WINDOWS, 3))
        self.axes /= np.linalg.norm(self.axes, axis=1, keepdims=True)
        self.points, starts = rng.uniform(-0.3, 0.3, (2, WINDOWS, 3))
        windows = []
        for axis, point, start in zip(self.axes, self.points, starts, strict=True):
            angle = span * unit_motion(rng, shape)
            along = pitch * angle if slide is None else slide * unit_motion(rng, shape)
            turn = Rotation.from_rotvec(angle[:, None] * axis)
            wrong = Rotation.from_rotvec(ratio * noise * rng.normal(size=(51, 3)))
            poses = np.tile(np.eye(4), (51, 1, 1))
            poses[:, :3, :3] = (wrong * turn * Rotation.random(random_state=rng)).as_matrix()
            poses[:, :3, 3] = point + turn.apply(start - point) + along[:, None] * axis
            poses[:, :3, 3] += noise * rng.normal(size=(51, 3))
            windows.append(poses)
        self.poses = np.stack(windows)

    def errors(self, found):
        """Angle of the axis, degrees, and distances of the origins in the ground from it, m."""
        axis = axes_of(found.candidates.angular.rotvec)[:, rf.AngularType.G, :, 2]
        angle = np.degrees(np.arcsin(np.minimum(1, np.linalg.norm(np.cross(axis, self.axes), axis=1))))
        origin = np.asarray(found.candidates.linear.position)[:, [rf.LinearType.GG, rf.LinearType.BG]]
        away = np.cross(origin - self.points[:, None], self.axes[:, None])
        return angle, np.linalg.norm(away, axis=-1).max(axis=1)


def unit_motion(rng, shape):
    """A motion (51,) of range 1: of a few slow sines, or of a shape."""
    if shape is not None:
        return shape
    sines = (
        rng.uniform(0.2, 0.8) * np.sin(2 * np.pi * rng.uniform(0.05, 0.2) * TIMES + rng.uniform(0, 6))
        for _ in range(3)
    )
    motion = sum(sines)
    return (motion - motion[0]) / np.ptp(motion)


@pytest.mark.parametrize(
    ("pitch", "noise", "ratio", "span"),
    [
        (0.00016, 1e-6, 3.0, 2.0),  # 1 mm a turn
        (-0.01, 1e-4, 1.0, 1.0),
        (0.1, 1e-4, 3.0, 10.0),
        (0.16, 1e-3, 10.0, 2.0),  # 1 m a turn
        (-0.1, 1e-3, 20.0, 5.0),
        (0.05, 0.0, 3.0, 2.0),
    ],
)
def test_a_nut_on_a_screw_is_named_with_its_pitch_and_its_axis(pitch, noise, ratio, span):
    nuts = Nuts(pitch, noise, ratio, span)
    found = rf.identify(nuts.poses, dt=DT)
    assert set(found.name) == {"Screw joint"}
    assert np.all(found.probability > 0.5)
    # the deviation of a slope from 51 slides, and of the angle times the pitch
    turned = 0.2 * span
    deviation = np.hypot(1, ratio * pitch) * noise / turned / 51**0.5
    tilt = ratio * noise / min(turned, 1) / 51**0.5
    np.testing.assert_allclose(found.pitch, pitch, atol=4 * deviation + tilt / 2 + 1e-12)
    angle, away = nuts.errors(found)
    assert np.all(np.radians(angle) < 4 * tilt + 1e-9)
    assert np.all(away < 8 * noise / min(turned, 1) * np.hypot(1, ratio * 0.3) / 7 + 1e-9)


def test_what_a_screw_says_of_itself():
    nuts = Nuts(-0.02)
    found = rf.identify(nuts.poses, dt=DT)
    assert not np.any(np.asarray(found.warning_codes) & Caution.COUPLED)
    assert not np.any(found.linear.coupled_position)
    assert not np.any(found.linear.has_twin)
    for one, axis in zip((found[i] for i in range(WINDOWS)), nuts.axes, strict=True):
        kind = one.linear.frame_type
        turns_about = axes_of(one.candidates.angular.rotvec)[:, :, 2]
        shared = turns_about[int(kind.orientation_body)]
        np.testing.assert_allclose(np.abs(shared @ np.asarray(one.linear.axes)[:, 2]), 1, atol=1e-9)
        body = turns_about[int(kind.position_body)]
        np.testing.assert_allclose(one.linear.free_position, np.outer(body, body), atol=1e-9)
        assert abs(float(one.linear.position @ body)) < 0.5
        assert kind in (rf.LinearType.GB, rf.LinearType.BG)
        assert one.entry is rf.constraint("screw")
        assert np.linalg.norm(np.cross(turns_about[0], axis)) < 1e-2
    first = found[0]
    lines = first.explain().splitlines()
    assert lines[0].startswith("The body moves like a nut on a screw")
    assert lines[1].startswith("The axis passes through")
    assert lines[2].endswith("A full turn takes it 126 mm along; the thread is left-handed.")
    assert "mm a turn, left-handed" in rf.to_table(first)
    record = to_record(found)["windows"][0]
    assert (record["name"], record["label"]) == ("Screw joint", "screw")
    assert record["pitch"] == float(first.pitch)
    assert record["screw_probability"] == float(first.screw_probability)
    columns = to_columns(found)
    np.testing.assert_array_equal(columns["pitch_m_rad"], found.pitch)
    np.testing.assert_array_equal(columns["screw_probability"], found.screw_probability)


def test_the_probability_is_shared_with_the_cylinder_joint():
    found = rf.identify(Nuts(0.1).poses, dt=DT)
    classes = np.sum(np.asarray(found.class_probability)[:, :, 1, 1], axis=1)
    np.testing.assert_allclose(found.probability, classes * found.screw_probability, rtol=1e-12)


def test_a_motion_at_constant_speed_does_not_tell_a_screw_from_a_cylinder_joint():
    nuts = Nuts(0.1, shape=TIMES / 5)
    found = rf.identify(nuts.poses, dt=DT)
    assert set(found.name) <= {"Screw joint", "Cylinder joint"}
    assert np.all(np.abs(found.screw_probability - 0.5) < 0.1)
    assert np.all(np.abs(found.probability - 0.5) < 0.1)
    angle, away = nuts.errors(found)
    assert np.all(angle < 0.1)
    assert np.all(away < 1e-3)


@pytest.mark.parametrize("excitation", EXCITATIONS)
def test_a_cylinder_joint_stays_one(excitation):
    simulate = jax.jit(
        jax.vmap(lambda key: synthetic.simulate("C", key, noise=1e-4, excitation=excitation).poses)
    )
    found = rf.identify(np.asarray(simulate(jax.random.split(jax.random.key(4), WINDOWS))), dt=DT)
    assert set(found.name) == {"Cylinder joint"}
    assert np.all(np.isnan(found.pitch))
    assert np.all(found.screw_probability < 0.1)


@pytest.mark.parametrize("noise", [1e-5, 1e-3])
def test_bodies_that_slide_on_their_own_or_not_at_all_are_on_no_screw(noise):
    cylinder = rf.identify(Nuts(None, noise, slide=0.2).poses, dt=DT)
    hinge = rf.identify(Nuts(0.0, noise).poses, dt=DT)
    drawer = rf.identify(Nuts(None, noise, span=0.0, slide=0.2).poses, dt=DT)
    for found, name in ((cylinder, "Cylinder"), (hinge, "Revolute"), (drawer, "Prismatic")):
        assert set(found.name) == {f"{name} joint"}
        assert np.all(np.isnan(found.pitch))


def test_the_probability_of_a_screw_says_how_often_it_is_one():
    """A slide that hardly shows: of one noise and more, or of what a tilt of the axis would make of it."""
    poses, true = [], []
    for seed in range(8):
        size = 2e-4 * 1.7**seed
        poses += [Nuts(size, span=2.0, seed=seed).poses, Nuts(None, slide=2 * size, seed=seed).poses]
        true += [True] * WINDOWS + [False] * WINDOWS
    found = rf.identify(np.concatenate(poses), dt=DT)
    helical = np.sum(np.asarray(found.class_probability)[:, :, 1, 1], axis=1) * found.screw_probability
    true = np.asarray(true)
    sure = helical > 0.8
    assert np.sum(sure) >= 8
    assert np.mean(true[sure]) > 0.9
    assert np.mean(true[helical < 0.1]) < 0.5


def test_single_windows_and_batches_agree():
    nuts = Nuts(0.03)
    batch = rf.identify(nuts.poses, dt=DT)
    one = rf.identify(nuts.poses[3], dt=DT)
    assert one.name == "Screw joint"
    np.testing.assert_allclose(one.pitch, batch.pitch[3], rtol=1e-6)
    np.testing.assert_allclose(one.linear.position, batch.linear.position[3], atol=1e-6)
    np.testing.assert_allclose(one.probability, batch.probability[3], rtol=1e-5)


def test_windows_of_other_kinds_are_not_touched_by_a_screw_beside_them():
    hinges = Nuts(0.0).poses
    mixed = hinges.copy()
    mixed[:4] = Nuts(0.1).poses[:4]
    alone, beside = (rf.identify(poses, dt=DT) for poses in (hinges, mixed))
    assert set(beside.name[:4]) == {"Screw joint"}
    for a, b in zip(jax.tree.leaves(alone[4:]), jax.tree.leaves(beside[4:]), strict=True):
        np.testing.assert_array_equal(a, b)


def test_screws_in_single_precision():
    nuts = Nuts(0.05, 1e-3)
    found = rf.identify(nuts.poses.astype(np.float32), dt=np.float32(DT))
    assert found.pitch.dtype == np.float32
    assert set(found.name) == {"Screw joint"}
    np.testing.assert_allclose(found.pitch, 0.05, atol=2e-3)
    _, away = nuts.errors(found)
    assert np.all(away < 5e-3)


def test_a_screw_is_simulated():
    still = PoseErrors(sigma=1e-4)
    motion = random_motion("screw", jax.random.key(1), samples=50, dt=DT, errors=still, pitch=-0.03)
    found = rf.identify(np.asarray(motion.poses), dt=DT)
    assert found.name == "Screw joint"
    np.testing.assert_allclose(found.pitch, -0.03, atol=2e-4)
    by_default = synthetic.simulate("screw", jax.random.key(2)).poses
    np.testing.assert_allclose(rf.identify(np.asarray(by_default), dt=DT).pitch, 0.05, atol=1e-6)
    assert motion.truth.linear_dof == (1, 0, 0)


def test_results_of_earlier_versions_have_no_pitch(tmp_path, monkeypatch):
    from reframe_jax.storage import parts

    pytest.importorskip("pyarrow")
    folder = rf.identify_many(Nuts(0.03).poses, tmp_path / "out", dt=DT, progress=None)
    np.testing.assert_allclose(load_results(folder).pitch, 0.03, atol=1e-3)
    whole = parts.Run.read

    def without(self, *arguments, **options):
        columns = whole(self, *arguments, **options)
        return {
            name: column for name, column in columns.items() if "pitch" not in name and "screw" not in name
        }

    monkeypatch.setattr(parts.Run, "read", without)
    found = load_results(folder)
    assert np.all(np.isnan(found.pitch))
    assert not np.any(found.screw_probability)
    assert set(found.name) == {"Cylinder joint"}


@pytest.mark.parametrize("noise", [5e-5, 3e-4])
def test_a_hinge_whose_axis_is_tilted_by_slow_errors_is_no_screw(noise):
    """The turn is measured about a tilted axis, along which the body seems to slide in proportion to it."""
    nuts = Nuts(0.0, noise, ratio=10.0, span=1.0)
    rng, poses = np.random.default_rng(5), nuts.poses.copy()
    for window, axis in zip(poses, nuts.axes, strict=True):
        side = np.cross(axis, rng.normal(size=3))
        turns = Rotation.from_matrix(window[:, :3, :3] @ window[0, :3, :3].T).as_rotvec() @ axis
        lean = Rotation.from_rotvec(60 * noise * turns[:, None] * side / np.linalg.norm(side))
        window[:, :3, :3] = lean.as_matrix() @ window[:, :3, :3]
    found = rf.identify(poses, dt=DT)
    assert list(found.name).count("Revolute joint") >= 7, found.name
    assert np.all(np.isnan(found.pitch[found.name == "Revolute joint"]))
    assert np.all(found.probability[found.name != "Revolute joint"] < 0.8)
    # the plane in which the body moves tells the axis better than its rotations do, along the longer side
    angle, _ = nuts.errors(found)
    assert np.all(np.radians(angle) < 50 * noise)


def test_a_body_that_slides_across_its_axis_is_on_no_hinge():
    """A plane-plane contact in slow motion: noise tilts the axis, along which the body seems to slide."""
    errors = PoseErrors(sigma=1e-5, rotation_ratio=15.0)

    def simulate(key):
        return random_motion("D", key, samples=50, dt=DT, excitation="slow", errors=errors).poses

    poses = jax.jit(jax.vmap(simulate))(jax.random.split(jax.random.key(3), 96))
    found = rf.identify(np.asarray(poses), dt=DT)
    hinges = (found.name == "Revolute joint") & (found.probability > 0.5)
    assert np.sum(hinges) <= 1
    assert np.sum(found.name == "Plane-plane contact") > 70

"""The main job on windows whose truth is known, and what a batch promises."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import reframe_jax as rf
from benchmarks.motions import random_motion
from reframe_jax.compilation import PROGRAMS
from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.identification.cautions import Caution
from reframe_jax.simulation import metrics, synthetic
from reframe_jax.simulation.motions import PoseErrors, disturb
from reframe_jax.solvers import Solution

NOISES = np.logspace(-6, -4, 5)
SEEDS = 20
# its generator's poses leave the constraint, from sample to sample, by more than the noise
PAPER = {"discretization": "left", "scales": 1, "thresholds": rf.Thresholds()}


@functools.cache
def windows(label, *, exact=True, excitation="exciting"):
    """Poses (noises, seeds, 51, 4, 4) of one constraint."""
    frame = rf.ConstraintFrame.named(label)

    def one(key, noise):
        return synthetic.simulate(frame, key, noise=noise, exact=exact, excitation=excitation).poses

    over_seeds = jax.vmap(one, in_axes=(0, None))
    keys = jax.random.split(jax.random.key(7), SEEDS)
    return jax.vmap(over_seeds, in_axes=(None, 0))(keys, jnp.asarray(NOISES)), frame


def slope(errors):
    return np.polyfit(np.log10(NOISES), np.log10(np.median(errors, axis=1)), 1)[0]


@pytest.mark.parametrize("label", rf.CONSTRAINTS)
def test_the_twelve_constraints_are_identified_with_errors_proportional_to_noise(label):
    poses, truth = windows(label)
    found = rf.identify(poses, dt=0.1)
    assert np.all(metrics.types_correct(found, truth))
    assert np.all(metrics.dof_correct(found, truth))
    assert set(found.name.ravel()) == {rf.CONSTRAINTS[label].name}
    entry = rf.CONSTRAINTS[label]
    errors = metrics.geometry_errors(found, truth)
    unique = {
        "angular": (entry.angular_axis is not None, np.radians(2e-3)),
        "linear": (entry.linear_axis is not None, np.radians(2e-3)),
        "position": (any(entry.position), 1e-5),
    }
    for name, (determined, limit) in unique.items():
        error = np.asarray(getattr(errors, name))
        if not determined:
            assert np.all(np.isnan(error)), name
            continue
        assert np.median(error[0]) <= limit, name
        assert abs(slope(error) - 1) <= 0.1, name
    # what the table leaves open is reported as open
    free = np.round(np.trace(found.linear.free_position, axis1=-2, axis2=-1))
    assert np.all(free == 3 - sum(entry.position))
    tied = np.sum(np.asarray(found.linear.tied), axis=-1)
    assert np.all(tied == (4 if entry.linear_type is None else 1))


@pytest.mark.parametrize(
    ("label", "excitation"),
    [*((label, "paper") for label in "ABCDHKL"), *((label, "exciting") for label in "ABCDEFGHIJKL")],
)
def test_the_papers_generator_in_the_left_discretization_has_no_plateau(label, excitation):
    poses, truth = windows(label, exact=False, excitation=excitation)
    found = rf.identify(poses, dt=0.1, **PAPER)
    errors = metrics.geometry_errors(found, truth)
    assert np.all(metrics.types_correct(found, truth))
    assert np.all(metrics.dof_correct(found, truth))
    entry = rf.CONSTRAINTS[label]
    determined = (entry.angular_axis is not None, entry.linear_axis is not None, any(entry.position))
    for error, known in zip((errors.angular, errors.linear, errors.position), determined, strict=True):
        if known:
            assert abs(slope(np.asarray(error)) - 1) <= 0.1
        else:
            assert np.all(np.isnan(error))


@pytest.mark.parametrize("label", "BHKL")
def test_thresholds_keep_the_best_type_and_describe_the_free_axes(label):
    """In the first second, some free axes stay below a threshold of 0.3 rad/s."""
    short = synthetic.simulate(label, jax.random.key(0), duration=5.0, dt=0.02, excitation="exciting")
    poses = np.stack([short.exact_poses[k : k + 51] for k in range(0, 200, 10)])
    options = PAPER | {"thresholds": rf.Thresholds(angular=0.3)}
    found = jax.device_get(rf.identify(poses, dt=0.02, **options))
    assert np.array_equal(found.linear.type_code, np.argmin(found.linear.norms, axis=-1))
    assert np.array_equal(found.angular.type_code, np.argmin(found.angular.norms, axis=-1))
    turns, shifts = found.angular.dof.sum(axis=-1), found.linear.dof.sum(axis=-1)
    for k, name in enumerate(found.name):
        assert (name == "Unconstrained") == (turns[k] == shifts[k] == 3)
        if name.startswith("Unnamed"):
            assert name.endswith(str(found[k].linear.frame_type))
            assert f"{turns[k]} rotation" in name
            assert f"{shifts[k]} translation" in name
    if label in "HKL":
        free = np.trace(found.linear.free_position, axis1=-2, axis2=-1)
        assert np.all(free[turns == 2] == 0)
    # every origin is valid if all translations are free, also if a rotation is not
    loose = rf.identify(poses, dt=0.02, **PAPER | {"thresholds": rf.Thresholds(angular=0.3, linear=0.0)})
    assert np.all(np.sum(loose.linear.dof, axis=-1) == 3)
    np.testing.assert_allclose(np.trace(loose.linear.free_position, axis1=-2, axis2=-1), 3)
    # amplitudes are those of the whole recording, in metres: a slide of 0.15 m/s at 1 rad/s
    if label == "B":
        assert np.all(found.linear.amplitude[:, 2] > 0.01)
    if label in "HKL":
        assert any(turns == 2)
        assert all(name.startswith("Unnamed") for name in found.name[turns == 2])


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("label", "ABCDEFIJ")
def test_smooth_motion_without_noise_gets_its_name_at_a_high_rate(label, dtype):
    """Rounding is all that a hinge shows at its origin, or a rotation along its own axis."""
    motion = random_motion(label, jax.random.key(0), samples=200, dt=0.02, excitation="sine")
    found = rf.identify(np.asarray(motion.exact_poses, dtype), dt=0.02)
    assert found.name == rf.CONSTRAINTS[label].name
    assert found.probability > 0.9


@pytest.mark.parametrize("label", "EF")
def test_motion_that_is_a_pure_rotation_is_reported_as_a_revolute_joint_with_all_types_tied(label):
    poses, _ = windows(label, exact=False, excitation="paper")
    found = rf.identify(poses, dt=0.1, **PAPER)
    assert set(found.name.ravel()) == {"Revolute joint"}
    assert np.all(found.linear.tied)
    assert np.all(found.linear.free_rotation)


def test_a_point_with_one_axis_less_is_found_and_described():
    """The paper's motion of G turns about a second point that moves along one axis only."""
    poses, _ = windows("G", exact=False, excitation="paper")
    found = rf.identify(poses, dt=0.1, **PAPER)
    assert set(found.name.ravel()) == {"Unnamed: 3 rotations, 1 translation in BB"}


@pytest.mark.parametrize("label", "IJ")
def test_types_that_the_papers_motion_cannot_tell_apart_are_reported_as_tied(label):
    poses, truth = windows(label, exact=False, excitation="paper")
    found = rf.identify(poses, dt=0.1, **PAPER)
    assert np.mean(metrics.types_correct(found, truth, ties=True)) > 0.9
    assert np.mean(np.sum(np.asarray(found.linear.tied), axis=-1) > 1) > 0.9


@pytest.fixture(scope="module")
def mixed():
    """One window of each constraint, (12, 51, 4, 4)."""
    return jnp.stack([windows(label)[0][2, 0] for label in rf.CONSTRAINTS])


def same(a, b, rtol=1e-4, atol=1e-5):
    """Equal but for rounding, which free directions amplify, and most of all axes of which none is unique."""
    for (path, x), y in zip(jax.tree.leaves_with_path(a), jax.tree.leaves(b), strict=True):
        limit = 100 * atol if path[-1].name == "rotvec" else atol
        np.testing.assert_allclose(np.asarray(x), np.asarray(y), rtol=rtol, atol=limit, err_msg=str(path))
    for x, y in zip(frames(a), frames(b), strict=True):
        unique = np.ptp(np.asarray(x.dof), axis=-1) > 0
        np.testing.assert_allclose(
            np.asarray(x.rotvec)[unique], np.asarray(y.rotvec)[unique], rtol=rtol, atol=atol
        )


def frames(found):
    """All of an identification."""
    return found.angular, found.linear, found.candidates.angular, found.candidates.linear


def test_norm_of_single_steps_is_the_geometric_mean_of_rms(mixed):
    found = rf.identify(mixed, dt=0.1, scales=1, bounds=1.0)  # the program of test_global.py
    for frame in (found.angular, found.linear):
        np.testing.assert_allclose(frame.norm, np.prod(np.asarray(frame.rms), axis=-1) ** (1 / 3), rtol=1e-9)
        norms = np.asarray(frame.norms)
        np.testing.assert_array_equal(frame.norm, norms[np.arange(12), np.asarray(frame.type_code)])
        assert np.all(np.diff(np.asarray(frame.rms), axis=-1) >= 0)
        np.testing.assert_allclose(np.linalg.det(np.asarray(frame.axes)), 1, rtol=1e-9)


def test_names_and_amplitudes_are_those_of_the_recording_at_any_scale_of_the_search(mixed):
    found = rf.identify(mixed, dt=0.1, scales=1, bounds=1.0)
    assert list(found.name) == [rf.CONSTRAINTS[label].name for label in rf.CONSTRAINTS]
    assert not np.any(found.warning_codes & Caution.NOISY_SCALE)
    default = rf.identify(mixed, dt=0.1)
    # over the free axes, whose directions in a plane are arbitrary
    sizes = [np.linalg.norm(of.linear.amplitude * of.linear.dof, axis=1) for of in (found, default)]
    np.testing.assert_allclose(*sizes, rtol=0.01)
    others = [row for row, label in enumerate(rf.CONSTRAINTS) if label != "D"]
    third = [of.linear.amplitude[others, 2] for of in (found, default)]
    np.testing.assert_allclose(*third, rtol=0.1)
    noise = PoseErrors(sigma=0.02)
    noisy = jax.vmap(disturb, in_axes=(0, None, None, None))(mixed, jax.random.key(0), noise, 0.1)
    found = rf.identify(noisy, dt=0.1, scales=1, bounds=1.0)
    assert np.all(found.warning_codes & Caution.NOISY_SCALE)


@pytest.mark.parametrize("pitch", [0.0, 0.02])
def test_the_order_of_poses_has_no_effect_on_a_comparison_with_their_mean(pitch):
    """Consecutive rows of shuffled poses are more than half a turn apart."""
    rng, angle = np.random.default_rng(0), 2 * np.sin(np.linspace(0, 25, 160))
    turn = Rotation.from_rotvec(np.outer(angle, [0, 0, 1]))
    poses = np.tile(np.eye(4), (160, 1, 1))
    poses[:, :3, :3] = turn.as_matrix()
    poses[:, :3, 3] = turn.apply([0.3, 0, 0.1]) + np.outer(pitch * angle, [0, 0, 1])
    poses[:, :3, 3] += rng.normal(0, 1e-4, (160, 3))
    found = rf.identify(np.stack([poses, rng.permutation(poses)]), dt=0.05, scales="mean")
    np.testing.assert_array_equal(found.name, "Screw joint" if pitch else "Revolute joint")
    np.testing.assert_allclose(found.angular.amplitude[:, 2], np.std(angle), rtol=1e-2)
    np.testing.assert_allclose(found.linear.amplitude[:, 2], max(pitch * np.std(angle), 1e-4), rtol=0.2)
    np.testing.assert_allclose(*found.linear.position, atol=1e-6)
    np.testing.assert_allclose(*found.probability, atol=1e-3)


@pytest.mark.parametrize("label", "EF")
def test_velocities_are_those_of_the_reported_origin(label):
    """Every origin along the normal of the slot is equally valid; its velocity depends on the choice."""
    poses, _ = windows(label)
    poses = np.asarray(poses[0, 0], float)
    found = rf.identify(poses, dt=0.1)
    rotation, position, origin = poses[:, :3, :3], poses[:, :3, 3], np.asarray(found.linear.position)
    middle = Rotation.from_matrix(rotation[:-1]).inv() * Rotation.from_matrix(rotation[1:])
    middle = rotation[:-1] @ Rotation.from_rotvec(middle.as_rotvec() / 2).as_matrix()
    if label == "E":  # a point of the body, in axes of the body
        moved = np.einsum("kji,kj->ki", middle, np.diff(position + rotation @ origin, axis=0))
    else:  # a point of the ground, in axes of the ground
        in_body = np.einsum("kji,kj->ki", rotation, origin - position)
        moved = np.einsum("kij,kj->ki", middle, -np.diff(in_body, axis=0))
    speeds = np.sqrt(np.mean(np.square(moved / 0.1 @ np.asarray(found.linear.axes)), axis=0))
    np.testing.assert_allclose(found.linear.rms[2], speeds[2], rtol=5e-3)


def test_amplitudes_tell_free_axes_from_constrained_ones(mixed):
    found = rf.identify(mixed, dt=0.1)
    for frame, limit in ((found.angular, 2e-3), (found.linear, 5e-4)):
        size, free = np.asarray(frame.amplitude), np.asarray(frame.dof) == 1
        assert np.all(size[~free] < limit)
        assert np.all(size[free] > 10 * limit)


def test_vmap_equals_loop_and_batch(mixed):
    batch = rf.identify(mixed, dt=0.1)
    vmapped = jax.jit(jax.vmap(lambda poses: rf.identify(poses, dt=0.1)))(mixed)
    same(batch, vmapped, atol=1e-4)  # without padding
    for i in (0, 5, 10):
        single = rf.identify(mixed[i], dt=0.1)
        assert single.linear.frame_type is rf.LinearType(int(batch.linear.type_code[i]))
        assert single.name == batch.name[i]
        same(single, batch[i])


def test_any_batch_axes_and_sizes_beyond_one_chunk(mixed):
    shaped = rf.identify(mixed.reshape(3, 4, 51, 4, 4), dt=0.1)
    assert shaped.linear.rotvec.shape == (3, 4, 3)
    assert shaped.name.shape == (3, 4)
    many = rf.identify(jnp.tile(mixed, (50, 1, 1, 1)), dt=0.1)
    same(many[:12], many[588:])
    same(many[:12], rf.identify(mixed, dt=0.1))


def test_a_bad_window_has_a_status_and_leaves_the_others_alone(mixed):
    good = rf.identify(mixed, dt=0.1)
    bad = mixed.at[0, 3, 0, 3].set(jnp.nan).at[1, 5, 0, 0].add(0.5).at[2].set(mixed[2, :1])
    found = rf.identify(bad, dt=0.1)
    assert [rf.Status(int(code)) for code in found.status_code[:4]] == [
        rf.Status.NOT_FINITE,
        rf.Status.NOT_A_POSE,
        rf.Status.NO_MOTION,
        rf.Status.OK,
    ]
    for x, y in zip(jax.tree.leaves(good), jax.tree.leaves(found), strict=True):
        np.testing.assert_array_equal(np.asarray(x)[3:], np.asarray(y)[3:])
    assert np.all(np.isnan(np.asarray(found.linear.norm)[:3]))
    assert found.name[0].startswith("No result")


def test_neighbours_with_larger_scales_leave_a_window_alone():
    poses = np.array(windows("K")[0][0, :9])  # more than are computed one by one
    before = rf.identify(poses, dt=0.1)
    poses[2:5] = synthetic.add_pose_noise(poses[2:5], jax.random.key(3), 6e-3)
    after = rf.identify(poses, dt=0.1)
    same = np.asarray([0, 1, *range(5, 9)])
    assert np.all(before.scale == 1)
    assert np.all(after.scale[2:5] > 1)
    for x, y in zip(jax.tree.leaves(before[same]), jax.tree.leaves(after[same]), strict=True):
        np.testing.assert_array_equal(x, y)


def test_irregular_times_give_the_same_frame(mixed):
    truth = rf.ConstraintFrame.named("K")
    key = jax.random.key(0)
    dense = synthetic.simulate(truth, key, dt=0.02).exact_poses
    keep = np.sort(np.random.default_rng(0).choice(np.arange(1, 250), 51, replace=False))
    found = rf.identify(dense[keep], times=0.02 * keep)
    np.testing.assert_allclose(found.linear.position, truth.position, atol=1e-5)
    assert found.linear.frame_type is rf.LinearType.GB


def test_the_answer_moves_with_the_ground_frame(mixed):
    shift = jnp.eye(4).at[:3, :3].set(rotation_exp(jnp.asarray([0.4, -1.0, 0.8])))
    shift = shift.at[:3, 3].set(jnp.asarray([5.0, -3.0, 2.0]))
    here, there = rf.identify(mixed, dt=0.1), rf.identify(shift[None, None] @ mixed, dt=0.1)
    assert list(here.name) == list(there.name)
    l_type = np.asarray(here.linear.type_code)
    ground = (l_type == 2) | (l_type == 3)
    moved = np.asarray(here.linear.position) @ np.asarray(shift[:3, :3]).T + np.asarray(shift[:3, 3])
    expected = np.where(ground[:, None], moved, here.linear.position)
    np.testing.assert_allclose(there.linear.position, expected, atol=1e-5)


class Middle:
    """The middle of the box, without a search, which would take long to compile."""

    def minimise(self, objective, box, key):
        x = jnp.zeros((3, *objective.moments.shape[2:]))
        value = objective.value(x)
        return Solution(x, value, jnp.ones_like(value))


def test_one_trace_per_shape(mixed):
    before, solver = len(PROGRAMS), Middle()
    rf.identify(mixed, dt=0.1, thresholds=rf.Thresholds(), solver=solver)
    assert len(PROGRAMS) == before + 1
    rf.identify(mixed + 0, dt=0.2, thresholds=rf.Thresholds(0.1, 0.02), solver=solver)
    assert len(PROGRAMS) == before + 1


def test_float32_finds_the_same_frames_at_its_own_precision():
    poses, truth = windows("K")
    each = [rf.identify(window, dt=np.float32(0.1)) for window in poses[4].astype(jnp.float32)]
    found = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
    assert found.linear.norm.dtype == jnp.float32
    assert np.all(metrics.types_correct(found, truth))
    assert np.median(metrics.geometry_errors(found, truth).position) < 2e-3


def test_float64_arrays_are_computed_in_float64_where_jax_is_set_to_float32():
    poses, truth = windows("K")
    poses = np.asarray(poses[0])
    with jax.enable_x64(False):
        found = rf.identify(poses, dt=0.1)
        assert found.linear.norm.dtype == jnp.float32
    errors = metrics.geometry_errors(found, truth)
    assert np.median(np.asarray(errors.position)) < 1e-5


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"poses": np.zeros((10, 4, 3)), "dt": 0.1}, "poses must have shape"),
        ({"poses": np.tile(np.eye(4), (4, 1, 1)), "dt": 0.1}, "at least 5 poses"),
        ({"poses": np.tile(np.eye(4), (51, 1, 1))}, "either times"),
        ({"poses": np.tile(np.eye(4), (51, 1, 1)), "dt": 0.1}, "All poses of the window are equal"),
        ({"poses": np.full((51, 4, 4), np.nan), "dt": 0.1}, "NaN"),
        ({"poses": np.tile(np.eye(4), (51, 1, 1)), "times": np.arange(50.0)}, "times must have shape"),
        ({"poses": np.tile(2 * np.eye(4), (51, 1, 1)), "dt": 0.1}, "rigid transform"),
        ({"poses": np.tile(np.eye(4), (51, 1, 1)), "times": np.zeros(51)}, "do not increase"),
        ({"poses": np.tile(np.eye(4), (51, 1, 1)), "dt": 0.1, "norm": 3}, "exponent"),
        ({"poses": np.tile(np.eye(4), (51, 1, 1)), "dt": 0.1, "bounds": -1.0}, "bounds"),
        ({"poses": np.tile(np.eye(4), (51, 1, 1)), "dt": 0.1, "discretization": "right"}, "discretization"),
        ({"poses": np.tile(np.eye(4), (51, 1, 1)), "dt": 0.1, "thresholds": (1, 2)}, "must be Thresholds"),
        (
            {"poses": np.tile(np.eye(4), (51, 1, 1)), "dt": 0.1, "thresholds": rf.Thresholds(linear=-1)},
            "0 or more",
        ),
        ({"poses": np.tile(np.eye(4), (51, 1, 1)), "dt": 0.1, "solver": rf.ValleySteps(3)}, "BasinHopping"),
    ],
)
def test_bad_input_is_refused_in_words(arguments, words):
    poses = arguments.pop("poses")
    with pytest.raises(ValueError, match=words):
        rf.identify(poses, **arguments)

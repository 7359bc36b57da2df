"""The covariance of an identification: against its errors, under slow errors, and its form."""

from dataclasses import replace
from itertools import combinations

import jax
import numpy as np
import pytest
from contacts import DT, POSES, Contact, simulate_contact
from scipy.spatial.transform import Rotation

import reframe_jax as rf
from benchmarks.uncertainty_doors import (
    DOOR_DATA,
    DOORS,
    EVERY,
    check_door,
    check_rate,
    in_region,
)
from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.simulation import synthetic
from reframe_jax.uncertainty.refit import turn_of_frame
from reframe_jax.uncertainty.spread import widen

EACH = 16


def errors_of(found: rf.Identification, truth: Contact) -> tuple[np.ndarray, np.ndarray]:
    """Turn of the axis, and shift of the origin across what is free, of one window."""
    frame = found.angular if np.sum(found.angular.dof) == 1 else found.linear
    axes, dof = np.asarray(frame.axes), np.sum(frame.dof)
    body = frame.frame_type if frame is found.angular else frame.frame_type.orientation_body
    true = truth.ground_axis if body == rf.AngularType.G else truth.body_axis
    axis = axes[:, 2 if dof == 1 else 0]
    in_ground = found.linear.frame_type.position_body == rf.AngularType.G
    point = truth.ground_point if in_ground else truth.body_point
    shift = np.asarray(found.linear.position) - point
    if np.trace(found.linear.free_position) > 0.5:  # the nearest point of the true axis
        own = truth.ground_axis if in_ground else truth.body_axis
        free = np.asarray(found.linear.free_position)
        shift = shift - own * (shift @ free @ own) / (own @ free @ own)
    return np.cross(true, axis * np.sign(axis @ true)), shift


def covered(truths: list[Contact], found: rf.Identification, covariances: rf.Covariance) -> float:
    """Share of 95 % regions, of axes and origins, that hold the truth."""
    inside = []
    for i, truth in enumerate(truths):
        turn, shift = errors_of(found[i], truth)
        axes = covariances.angular_axes if np.sum(found.angular.dof[i]) == 1 else covariances.linear_axes
        inside += [
            in_region(turn, np.asarray(axes[i])),
            in_region(shift, np.asarray(covariances.position[i])),
        ]
    return float(np.mean(inside))


@pytest.fixture(scope="module")
def windows():
    """Hinges and pins on a plane: recordings with their truth, and what was found of all."""
    truths = [simulate_contact(kind, seed) for kind in "AK" for seed in range(EACH)]
    poses = np.stack([truth.poses for truth in truths])
    return truths, poses, rf.identify(poses, dt=DT)


@pytest.fixture(scope="module")
def covariances(windows):
    _, poses, found = windows
    return rf.covariance(found, poses, dt=DT)


def test_regions_hold_the_truth(windows, covariances):
    truths, poses, found = windows
    assert list(found.name) == ["Revolute joint"] * EACH + ["Pin-plane contact"] * EACH
    assert covered(truths, found, covariances) >= 0.88  # 64 regions
    assert np.all(covariances.first_order)
    white = rf.covariance(found, poses, dt=DT, errors="white")
    assert covered(truths, found, white) >= 0.8
    assert np.all(np.asarray(white.inflation) == 1)
    # differences of parts widen only beyond chance
    assert np.median(covariances.inflation) < 1.5
    variances = [np.trace(of.position, axis1=1, axis2=2) for of in (covariances, white)]
    # two programs fit the windows, which round differently
    np.testing.assert_allclose(np.sqrt(variances[0] / variances[1]), covariances.inflation[:, 2], rtol=1e-5)


def test_slow_errors_inflate():
    truths = [simulate_contact(kind, seed, sigma=1e-5, slow=1e-3) for kind in "AK" for seed in range(EACH)]
    poses = np.stack([truth.poses for truth in truths])
    found = rf.identify(poses, dt=DT)
    right = np.flatnonzero(found.name == np.array(["Revolute joint"] * EACH + ["Pin-plane contact"] * EACH))
    assert len(right) >= 28
    covariances = rf.covariance(found, poses, dt=DT)
    assert np.median(np.asarray(covariances.inflation)[:EACH, 0]) > 1.5
    assert covered([truths[i] for i in right], found[right], covariances[right]) >= 0.8


def interval_widths(found: rf.Identification, poses: np.ndarray) -> list[np.ndarray]:
    """Half-widths of 95 % intervals of the axis and the origin; their bounds without slow errors.

    The inflation is a ratio of RMS values over all directions, none of which exceeds this RMS times sqrt(3).
    """
    measured = rf.covariance(found, poses, dt=DT)
    parts = np.stack([measured.angular_axes, measured.position])
    widths = 1.96 * np.sqrt(np.linalg.eigvalsh(parts)[:, -1])
    sizes = np.sqrt(np.trace(parts, axis1=1, axis2=2))
    return [widths, 1.96 * sizes / np.asarray(measured.inflation)[[0, 2]]]


def flexing_body(rng: np.random.Generator) -> np.ndarray:
    """A joint like a knee: its axis leans by degrees and its pivot moves by 5 to 15 mm, with the joint angle.

    The amplitude grows, so that parts of the recording have different joint angles.
    """
    times = DT * np.arange(198)
    angle = (0.3 + 0.7 * times / times[-1]) * np.sin(2.0 * times)
    bent = np.stack([angle**2, angle**3, angle**2 - angle**3], axis=1)
    flexed = Rotation.from_rotvec(np.radians(4) * bent) * Rotation.from_rotvec(np.outer(angle, [0, 0, 1]))
    turned = flexed * Rotation.from_rotvec(1e-3 * rng.normal(size=(len(times), 3)))
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = turned.as_matrix()
    poses[:, :3, 3] = 0.015 * bent - flexed.apply([0.2, 0.1, 0.15]) + 3e-4 * rng.normal(size=(len(times), 3))
    return poses


@pytest.mark.parametrize("assume", ["hinge", "ball"])
def test_intervals_are_as_wide_as_parts_differ(rng: np.random.Generator, assume: str) -> None:
    poses = flexing_body(rng)
    whole = rf.identify(poses, dt=DT, assume=assume)
    kind, free = int(whole.linear.type_code), np.asarray(whole.linear.free_position)

    def estimate(first: int, end: int) -> tuple[np.ndarray, np.ndarray]:
        found = rf.identify(poses[first:end], dt=DT, assume=assume).candidates
        axis = np.asarray(rotation_exp(found.angular.rotvec[int(whole.angular.type_code)]))[:, 2]
        at = np.asarray(found.linear.position)[kind]
        return axis * np.sign(axis @ np.asarray(whole.angular.axes)[:, 2]), at - free @ at

    def largest(spans: list[tuple[int, int]]) -> np.ndarray:
        pairs = list(combinations([estimate(*span) for span in spans], 2))
        return np.max([[np.linalg.norm(p - q) for p, q in zip(*pair, strict=True)] for pair in pairs], axis=0)

    apart = np.maximum(largest([(0, 99), (99, 198)]), largest([(0, 66), (66, 132), (132, 198)]))
    measured, white = interval_widths(whole, poses)
    assert apart[1] > 3e-3
    # the refit of a part differs slightly from its identification
    assert measured[1] > 0.9 * apart[1] > white[1]
    if assume == "hinge":
        assert measured[0] > 0.9 * apart[0]
        assert apart[0] > white[0]


def test_intervals_are_as_wide_as_redundant_axes_differ(rng: np.random.Generator) -> None:
    """Parts of a turning wheel agree, but its orientation is measured in axes that are a degree off."""
    times = DT * np.arange(198)
    wheel = Rotation.from_rotvec(np.outer(3.0 * times, [0, 0, 1]))
    turned = Rotation.from_rotvec([np.radians(1), 0, 0]) * wheel
    turned = turned * Rotation.from_rotvec(1e-3 * rng.normal(size=(len(times), 3)))
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = turned.as_matrix()
    poses[:, :3, 3] = wheel.apply([0.3, 0.0, 0.05]) + 3e-4 * rng.normal(size=(len(times), 3))
    found = rf.identify(poses, dt=DT, assume="hinge")
    measured, white = interval_widths(found, poses)
    assert measured[0] > np.radians(0.9) > 5 * white[0]


def knee(seed: int) -> np.ndarray:
    """A sensor on soft tissue: it slips by centimetres and degrees, slowly and with the joint angle."""
    rng = np.random.default_rng(seed)
    times = 0.05 * np.arange(198)

    def wave() -> np.ndarray:
        rates, phases = rng.uniform(0.03, 0.3, (3, 3)), rng.uniform(0, 2 * np.pi, (3, 3))
        return np.sum(np.sin(2 * np.pi * rates * times[:, None, None] + phases), axis=1)

    angle = 0.5 + 0.5 * np.sin(2 * np.pi * 0.3 * times)
    bent = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    bent = bent - bent.mean(axis=0)
    turn, shift = (np.sqrt(1 / 6) * wave() + bent / 0.6 @ rng.normal(size=(2, 3)) for _ in range(2))
    turn = 0.03 * turn + 1e-3 * rng.normal(size=turn.shape)
    bend = Rotation.from_rotvec(np.outer(angle, [0, 0, 1]))
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = (Rotation.from_rotvec(turn) * bend).as_matrix()
    poses[:, :3, 3] = -bend.apply([0.02, -0.35, 0.05]) + 0.008 * shift + 3e-4 * rng.normal(size=shift.shape)
    return poses


def test_intervals_hold_the_estimates_of_parts() -> None:
    """Of knees, whose halves and thirds may have other types: those of the same type are compared."""
    turns, shifts = [], []
    for seed in range(10):
        poses = knee(seed)
        whole = rf.identify(poses, dt=DT, assume="hinge")
        axis, free = np.asarray(whole.angular.axes)[:, 2], np.asarray(whole.linear.free_position)
        (turn, shift), _ = interval_widths(whole, poses)
        for first, end in ((0, 99), (99, 198), (0, 66), (66, 132), (132, 198)):
            part = rf.identify(poses[first:end], dt=DT, assume="hinge")
            if part.angular.frame_type == whole.angular.frame_type:
                turns.append(np.linalg.norm(np.cross(axis, np.asarray(part.angular.axes)[:, 2])) < turn)
            if part.linear.frame_type == whole.linear.frame_type:
                apart = np.asarray(part.linear.position) - np.asarray(whole.linear.position)
                shifts.append(np.linalg.norm(apart - free @ apart) < shift)
    assert len(shifts) >= 24
    assert all(turns)
    assert np.mean(shifts) >= 0.95


@pytest.mark.parametrize("seed", range(3))
def test_a_part_at_rest_does_not_widen(seed: int) -> None:
    """A door opens, then hardly moves: the estimate of the last third is arbitrary."""
    rng = np.random.default_rng(seed)
    times = DT * np.arange(198)
    angle = np.radians(60) * np.clip(1.5 * times / times[-1], 0, 1) + 0.01 * np.sin(2.2 * times)
    drift = np.sin(np.outer(times, rng.uniform(0.3, 1.5, 6)) + rng.uniform(0, 6, 6))
    turned = Rotation.from_rotvec(np.outer(angle, [0, 0, 1]))
    turn = 0.01 * drift[:, :3] + 3e-3 * rng.normal(size=(len(times), 3))
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = (Rotation.from_rotvec(turn) * turned).as_matrix()
    poses[:, :3, 3] = (
        turned.apply([0.5, 0, 0.1]) + 1e-3 * drift[:, 3:] + 3e-4 * rng.normal(size=(len(times), 3))
    )
    found = rf.identify(poses, dt=DT, assume="hinge")
    third = rf.identify(poses[132:], dt=DT, assume="hinge")
    in_ground = np.asarray(third.candidates.linear.position)[int(rf.LinearType.BG)]
    assert np.linalg.norm(in_ground[:2]) > 0.05
    covariance = rf.covariance(found, poses, dt=DT)
    shift = np.asarray(found.linear.position)
    assert found.linear.frame_type.position_body == rf.AngularType.G
    shift = shift - np.asarray(found.linear.free_position) @ shift
    assert in_region(shift, np.asarray(covariance.position))
    measured, _ = interval_widths(found, poses)
    assert measured[1] < 0.04


def test_differences_widen_only_beyond_chance(rng: np.random.Generator) -> None:
    sets = np.array([0, 1, 2, 2, 2])
    factor = rng.normal(size=(9, 9)) * np.repeat([0.01, 0.02, 0.003], 3)[:, None]
    covariance, roots = factor @ factor.T, 0.01 * rng.normal(size=(5, 3, 3, 3))
    chance, apart = roots @ np.swapaxes(roots, 2, 3), rng.normal(size=(5, 3, 3))
    apart = np.einsum("pgij,pgj->pgi", roots, np.sqrt(3) * apart / np.linalg.norm(apart, axis=2)[:, :, None])
    np.testing.assert_allclose(widen(covariance, apart, chance, sets), covariance)
    np.testing.assert_allclose(widen(covariance, np.sqrt(1.9) * apart, chance, sets), 1.9 * covariance)
    for factor in (np.sqrt(4.1), 10.0, 1000.0):
        widened = np.asarray(widen(covariance, factor * apart, chance, sets))
        assert np.all(np.linalg.eigvalsh(widened - 0.999 * factor**2 * covariance) > 0)
        for group in range(3):
            rows = slice(3 * group, 3 * group + 3)
            lengths = factor * np.linalg.norm(apart[:, group], axis=1)
            least = np.hypot(lengths[0], np.max(lengths[1:]))
            assert 1.96 * np.sqrt(np.linalg.eigvalsh(widened[rows, rows])[0]) > 0.999 * least


def test_leaving_out_blocks_agrees(windows, covariances):
    truths, poses, found = windows
    # eight windows at a time use the program for one window, which other tests compile too
    rows = [slice(i, i + 8) for i in range(0, len(poses), 8)]
    parts = [rf.covariance(found[part], poses[part], dt=DT, method="bootstrap") for part in rows]
    second = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    sizes = [np.sqrt(np.trace(of.position, axis1=1, axis2=2)) for of in (covariances, second)]
    assert 0.6 < np.median(sizes[1] / sizes[0]) < 2
    assert covered(truths, found, second) >= 0.75
    free = np.einsum("nij,njk->nik", found.linear.free_position, second.position)
    assert np.max(np.abs(free)) < 1e-9 * np.max(second.position)


def test_free_directions_have_no_variance(windows, covariances):
    _, _, found = windows
    free = np.einsum("nij,njk->nik", found.linear.free_position, covariances.position)
    assert np.max(np.abs(free)) < 1e-9 * np.max(covariances.position)
    hinges, pins = slice(0, EACH), slice(EACH, None)
    # the linear axes of a hinge and the angular axes of a pin may be turned at will
    assert np.all(np.asarray(covariances.linear_axes)[hinges] == 0)
    assert np.all(np.asarray(covariances.angular_axes)[pins] == 0)
    axis = np.asarray(found.angular.axes)[hinges, :, 2:]
    assert np.max(np.abs(covariances.angular_axes[hinges] @ axis)) < 1e-9 * np.max(covariances.angular_axes)


@pytest.mark.parametrize("spin", [0.0, 0.5, 2.0])
def test_frames_turned_about_a_free_axis_are_equal(windows, spin: float):
    frame = windows[2][EACH].linear  # of a pin: the plane may be turned about its normal
    axis = np.asarray(frame.axes) @ np.asarray(frame.free_rotation)
    across = np.cross(axis, [1.0, 2.0, 3.0])
    across = 0.02 * across / np.linalg.norm(across)
    turned = rotation_exp(across) @ rotation_exp(spin * axis)
    np.testing.assert_allclose(
        turn_of_frame(frame.axes, frame.free_rotation, turned), np.sin(0.02) / 0.02 * across, atol=1e-12
    )


def test_what_is_not_determined_has_a_large_variance(windows, covariances):
    """The point on the axis of a hinge, if nothing says that it is free."""
    _, poses, found = windows
    closed = replace(found, linear=replace(found.linear, free_position=0 * found.linear.free_position))
    of_closed = rf.covariance(closed, poses, dt=DT)
    along = np.einsum("nij,nij->n", np.asarray(found.linear.free_position), np.asarray(of_closed.position))
    across = np.trace(covariances.position, axis1=1, axis2=2)
    assert np.all(along[:EACH] > 100 * across[:EACH])


def test_anything_computed_from_the_estimate(windows, covariances):
    _, _, found = windows
    np.testing.assert_allclose(
        covariances.of(lambda one: one.linear.position, found), covariances.position, atol=1e-18
    )
    one = found[EACH]
    normal = covariances[EACH].of(lambda one: one.linear.axes[:, 0], one)
    across = np.cross(np.eye(3), np.asarray(one.linear.axes)[:, 0])
    np.testing.assert_allclose(normal, across @ covariances[EACH].linear_axes @ across.T, atol=1e-15)


def test_one_window_is_as_in_a_batch(windows, covariances):
    _, poses, found = windows
    for i in (0, EACH):
        single = rf.covariance(found[i], poses[i], times=DT * np.arange(POSES))
        scale = np.sqrt(np.diag(covariances.matrix[i])) + 1e-12
        np.testing.assert_allclose(
            (single.matrix - covariances.matrix[i]) / np.outer(scale, scale), 0, atol=1e-3
        )
        np.testing.assert_allclose(single.inflation, covariances.inflation[i], rtol=1e-3)
        assert single.first_order == covariances.first_order[i]


def test_failed_windows_have_none(windows, covariances):
    _, poses, _ = windows
    broken = poses.copy()
    broken[1, 3, 0, 3] = np.nan
    found = rf.identify(broken, dt=DT)
    of_broken = rf.covariance(found, broken, dt=DT)
    assert np.all(np.isnan(of_broken.matrix[1]))
    assert np.all(np.isnan(of_broken.inflation[1]))
    assert not of_broken.first_order[1]
    np.testing.assert_allclose(of_broken.matrix[0], covariances.matrix[0], rtol=1e-6, atol=1e-15)


def test_what_is_refused(windows):
    _, poses, found = windows
    with pytest.raises(ValueError, match=r"of shape \(64, 4, 4\), not \(32, 64, 4, 4\)"):
        rf.covariance(found[0], poses, dt=DT)
    with pytest.raises(ValueError, match="either times"):
        rf.covariance(found[0], poses[0])
    with pytest.raises(ValueError, match="dt must"):
        rf.covariance(found[0], poses[0], dt=[DT, DT])
    with pytest.raises(ValueError, match="'derivative' or 'bootstrap'"):
        rf.covariance(found[0], poses[0], dt=DT, method="jackknife")
    with pytest.raises(ValueError, match="remove the option errors"):
        rf.covariance(found[0], poses[0], dt=DT, method="bootstrap", errors="white")
    with pytest.raises(ValueError, match="'measured' or 'white'"):
        rf.covariance(found[0], poses[0], dt=DT, errors="red")


needs_recordings = pytest.mark.skipif(not DOOR_DATA.is_dir(), reason="needs the recordings of ../shared/data")


@needs_recordings
def test_error_bars_of_doors_hold():
    """Of a camera, whose errors are slow: regions hold the circle's axis, and each half the other's line."""
    rows = [check_door(name) for name in DOORS]
    for key in ("line holds", "axis holds", "halves hold each other's line"):
        assert np.mean([row[key] for row in rows]) >= 0.8, key
    # the last third of door 411 hardly moves
    assert all(row["line within, mm"] < 60 for row in rows)


@needs_recordings
def test_error_bars_hold_a_measured_axis():
    for row in (check_door("hinge"), *(check_rate(every) for every in EVERY)):
        assert row["axis holds"]
        assert row["line holds"]


def test_frames_by_thresholds_have_error_bars_if_the_table_has_their_free_axes():
    """Types of a hinge are tied, so its origin is in either body; two rotations and a slide have no entry."""
    hinge = synthetic.simulate("A", jax.random.key(0), duration=5.0, dt=0.1, excitation="exciting")
    curve = synthetic.simulate("H", jax.random.key(0), duration=5.0, dt=0.02, excitation="exciting")
    poses = np.stack([hinge.exact_poses, curve.exact_poses[:51]])
    poses[..., :3, 3] += np.random.default_rng(0).normal(0, 1e-4, (2, 51, 3))
    steps = np.stack([np.full(50, 0.1), np.full(50, 0.02)])
    found = rf.identify(poses, dt=steps, scales=1, thresholds=rf.Thresholds(angular=0.3))
    spread = rf.covariance(found, poses, dt=steps, scales=1)
    assert found.name.tolist() == ["Revolute joint", "Unnamed: 2 rotations, 1 translation in GG"]
    deviation = 1e3 * np.sqrt(np.trace(np.asarray(spread.position), axis1=-2, axis2=-1))
    assert 0.05 < deviation[0] < 5
    assert spread.first_order.tolist() == [True, False]
    assert np.isnan(np.asarray(spread.matrix[1])).all()
    assert not rf.excitation(found, poses, dt=steps, scales=1).named[1]

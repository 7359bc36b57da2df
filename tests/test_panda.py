"""Demonstrations: constraints kept, recordings as imperfect as asked, identifications right."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.constraints.frame import frame_arrays
from reframe_jax.simulation import arm as panda
from reframe_jax.simulation import metrics
from reframe_jax.simulation.arm.demonstration import sampling
from reframe_jax.simulation.arm.guide import EXCITATIONS
from reframe_jax.simulation.arm.rollout import Track, rollout_status

BATCH = 8  # one compiled program for this module
KEY = jax.random.key(11)
LABELS = list(rf.CONSTRAINTS)


def demonstrate(label: str, **options: Any) -> panda.Demonstration:
    return jax.device_get(panda.demonstrate(label, KEY, batch=BATCH, spread=panda.SPREAD, **options))


@pytest.fixture(scope="module")
def rigid() -> dict[str, panda.Demonstration]:
    """Demonstrations of all twelve constraints on a perfect robot."""
    return {label: demonstrate(label) for label in LABELS}


def usable(made: panda.Demonstration) -> np.ndarray:
    good = np.flatnonzero(made.status_code == panda.RolloutStatus.OK)
    assert len(good) > BATCH / 2
    return good


def check_errors(
    errors: metrics.GeometryErrors,
    label: str,
    bounds: tuple[float, float, float],
    rows: slice | np.ndarray = slice(None),
) -> None:
    """Medians of the angular, linear (rad) and position (m) error, each NaN where nothing is determined."""
    entry = rf.CONSTRAINTS[label]
    determined = (entry.angular_axis is not None, entry.linear_axis is not None, any(entry.position))
    found = (errors.angular, errors.linear, errors.position)
    for error, known, bound in zip(found, determined, bounds, strict=True):
        if known:
            assert np.median(np.asarray(error)[rows]) < bound
        else:
            assert np.all(np.isnan(error))


def test_shapes(rigid: dict[str, panda.Demonstration]) -> None:
    made = rigid["K"]
    assert made.times.shape == (101,)
    assert made.poses.shape == made.exact_poses.shape == (BATCH, 101, 4, 4)
    assert made.joint_positions.shape == made.joint_velocities.shape == (BATCH, 101, 7)
    assert made.reaction.shape == made.slip.shape == (BATCH, 101, 6)
    assert made.truth.position.shape == (BATCH, 3)
    assert made[0].poses.shape == (101, 4, 4)
    assert made[0].status_code == panda.RolloutStatus.OK
    np.testing.assert_array_equal(made.poses, made.exact_poses)


@pytest.mark.parametrize("label", LABELS)
def test_constraint_is_kept(rigid: dict[str, panda.Demonstration], label: str) -> None:
    angle, distance = np.max(rigid[label].violation[usable(rigid[label])], axis=0)
    assert angle < 0.5e-3
    assert distance < 50e-6


@pytest.mark.parametrize("label", LABELS)
def test_free_axes_move_and_reactions_act_on_the_others(
    rigid: dict[str, panda.Demonstration], label: str
) -> None:
    made = rigid[label]
    free = np.array((*made.truth.angular_dof, *made.truth.linear_dof), dtype=bool)
    travel = np.ptp(made.slip, axis=1)
    assert np.all(travel[:, :3][:, free[:3]] > 0.15)
    assert np.all(travel[:, 3:][:, free[3:]] > 0.04)
    assert np.all(made.reaction[..., free] == 0)
    assert np.all(np.abs(made.reaction[:, 1:, ~free]).max(axis=1) > 1e-2)


def test_violation_agrees_with_the_poses(rigid: dict[str, panda.Demonstration]) -> None:
    """What has an integral is measured from the poses alone: fixed points, planes and axes."""

    def origins(made: panda.Demonstration, on_body: bool) -> np.ndarray:
        rotation, position = made.exact_poses[..., :3, :3], made.exact_poses[..., :3, 3]
        origin = made.truth.position[:, None]
        if on_body:
            return position + np.einsum("nkij,nlj->nki", rotation, origin)
        return np.einsum("nkji,nkj->nki", rotation, origin - position)

    def along(made: panda.Demonstration, path: np.ndarray, axes: list[int]) -> float:
        frames = np.asarray(made.truth.linear_axes)
        moved = np.einsum("nij,nki->nkj", frames, path - path[:, :1])
        return float(np.abs(moved[usable(made)][..., axes]).max())

    assert along(rigid["A"], origins(rigid["A"], on_body=True), [0, 1, 2]) < 50e-6
    assert along(rigid["K"], origins(rigid["K"], on_body=True), [2]) < 50e-6
    assert along(rigid["L"], origins(rigid["L"], on_body=False), [2]) < 50e-6
    assert along(rigid["I"], origins(rigid["I"], on_body=True), [1, 2]) < 50e-6
    assert along(rigid["J"], origins(rigid["J"], on_body=False), [1, 2]) < 50e-6
    turned = rigid["B"].exact_poses[..., :3, :3] - rigid["B"].exact_poses[:, :1, :3, :3]
    assert np.abs(turned).max() < 0.5e-3
    for label, axis in (("A", 1), ("C", 0), ("D", 2), ("E", 1), ("F", 1), ("I", 1), ("J", 1)):
        made = rigid[label]
        in_body = np.asarray(made.truth.angular_axes)[:, :, axis]
        if made.truth.angular_type == rf.AngularType.G:
            in_body = np.einsum("nji,nj->ni", made.exact_poses[:, 0, :3, :3], in_body)
        axes = np.einsum("nkij,nj->nki", made.exact_poses[..., :3, :3], in_body)
        assert np.abs(axes - axes[:, :1])[usable(made)].max() < 0.5e-3


@pytest.mark.parametrize("label", LABELS)
def test_identified_at_encoder_grade(label: str) -> None:
    made = demonstrate(label, imperfections=panda.ENCODER_GRADE)
    good = usable(made)
    assert 1e-7 < np.abs(made.poses - made.exact_poses).max() < 1e-3
    # all of them, for the sake of one compiled shape
    found = rf.identify(made.poses, times=made.times)
    assert np.all(found.counted)  # the arm moves fast, but does not jump
    start = jnp.asarray(made.exact_poses[:, 0])
    errors = metrics.geometry_errors(found, made.truth, start=start)
    assert np.all(metrics.types_correct(found, made.truth, ties=True)[good])
    assert np.all(metrics.dof_correct(found, made.truth)[good])
    check_errors(errors, label, (np.radians(0.1), np.radians(0.1), 0.5e-3), good)


def test_realistic_compliance_gives_way(rigid: dict[str, panda.Demonstration]) -> None:
    made = demonstrate("K", imperfections=panda.REALISTIC)
    force, slipped = made.reaction[..., 5], made.slip[..., 5]
    assert 1e-4 < np.abs(slipped).max() < 5e-3
    # the spring is a damped one: the two go together, but not exactly
    assert np.corrcoef(force.ravel(), -slipped.ravel())[0, 1] > 0.8
    assert np.all(made.status_code == rigid["K"].status_code)


@pytest.mark.parametrize("label", ["A", "K"])
def test_the_papers_robot_moved_as_fast(label: str) -> None:
    options = {"arm": "fr3", "excitation": "brisk", "imperfections": panda.ENCODER_GRADE}
    made = demonstrate(label, **options)
    good = np.flatnonzero(made.status_code == panda.RolloutStatus.OK)
    assert len(good) >= BATCH / 4
    assert np.all(np.asarray(made.violation)[good] < [0.5e-3, 50e-6])
    found = rf.identify(made.poses, times=made.times)
    assert np.all(metrics.types_correct(found, made.truth, ties=True)[good])
    assert np.all(metrics.dof_correct(found, made.truth)[good])
    errors = metrics.geometry_errors(found, made.truth, start=jnp.asarray(made.exact_poses[:, 0]))
    assert np.median(errors.position[good]) < 0.2e-3


@pytest.mark.slow
@pytest.mark.parametrize("arm", ["panda", "fr3"])
@pytest.mark.parametrize("label", LABELS)
def test_errors_are_the_papers_where_the_rms_is(label: str, arm: str) -> None:
    """Moved as fast as in Table 4 of the paper, and giving way as much."""
    options = {
        "chunk": 32,
        "spread": panda.SPREAD,
        "excitation": "brisk",
        "imperfections": panda.MATCHED,
        "arm": arm,
    }
    parts = list(panda.demonstrations(label, KEY, 20, **options))
    poses = np.concatenate([part.poses for part in parts])
    truth = jax.tree.map(lambda *leaves: np.concatenate(leaves), *(part.truth for part in parts))
    found = rf.identify(poses, times=parts[0].times)
    start = jnp.asarray(np.concatenate([part.exact_poses[:, 0] for part in parts]))
    errors = metrics.geometry_errors(found, truth, start=start)
    assert np.all(metrics.types_correct(found, truth, ties=True))
    assert np.all(metrics.dof_correct(found, truth))
    tilt = np.radians({"panda": 1.0, "fr3": 1.5}[arm])
    check_errors(errors, label, (tilt, np.radians(2.5), 8e-3))
    held = {0: 3, 1: 2, 3: 0}[sum(truth.angular_dof)]
    rms = np.median(found.angular.rms, axis=0)
    assert np.all((rms[:held] > 20e-3) & (rms[:held] < {"panda": 65e-3, "fr3": 80e-3}[arm]))
    if held == 2:
        assert 0.65 < rms[2] < 0.95


def test_number_of_a_key_is_one_demonstration(rigid: dict[str, panda.Demonstration]) -> None:
    later = demonstrate("E", first=3)
    np.testing.assert_allclose(later.poses[0], rigid["E"].poses[3], atol=1e-12)
    np.testing.assert_allclose(later.truth.position[0], rigid["E"].truth.position[3], atol=1e-15)
    assert np.all(np.abs(later.poses[1] - later.poses[0]).max() > 1e-3)


def test_imperfections_one_by_one(rigid: dict[str, panda.Demonstration]) -> None:
    """Each is off by default and does what it says; none but compliance changes the motion."""
    exact = rigid["C"]

    def recorded(**options: float) -> np.ndarray:
        made = demonstrate("C", imperfections=panda.Imperfections(**options))
        np.testing.assert_array_equal(made.exact_poses, exact.exact_poses)
        return made.poses

    def off(poses: np.ndarray) -> np.ndarray:
        return np.linalg.norm(poses[..., :3, 3] - exact.exact_poses[..., :3, 3], axis=-1)

    assert 0.2e-3 < off(recorded(encoder_noise=1e-3)).mean() < 3e-3
    assert 1e-5 < off(recorded(encoder_step=1e-4)).mean() < 1e-4


def test_status_tells_of_joint_limits() -> None:
    """Half of the demonstrations start with the elbow outside of its range."""
    start = np.tile(panda.PANDA.home, (BATCH, 1))
    start[::2, 3] = panda.PANDA.limits[1, 3] + 0.01
    distant = jax.device_get(panda.demonstrate("B", KEY, batch=BATCH, start=start))
    assert np.all(distant.status_code[::2] >= panda.RolloutStatus.JOINT_LIMIT)
    assert np.all(distant.status_code[1::2] == panda.RolloutStatus.OK)


def test_status_tells_what_is_wrong(rigid: dict[str, panda.Demonstration]) -> None:
    """Of one rollout, not of its neighbours; a soft axis may slip."""
    made = rigid["K"]
    free = jnp.broadcast_to(frame_arrays(rf.ConstraintFrame.named("K")).free, (BATCH, 6))
    sound = {
        "joints": made.joint_positions,
        "velocity": made.joint_velocities,
        "slip": np.zeros_like(made.slip),
        "force": made.reaction,
    }

    def judged(name: str, index: int, value: float, compliance: tuple[float, float] = (0.0, 0.0)) -> int:
        changed = sound[name].copy()
        changed[2, 5, index] = value
        track = Track(**jax.tree.map(jnp.asarray, {**sound, name: changed}))
        soft = jnp.asarray([compliance[0]] * 3 + [compliance[1]] * 3)
        status = np.asarray(rollout_status(track, free, soft, panda.PANDA))
        assert np.all(np.delete(status, 2) == panda.RolloutStatus.OK)
        return int(status[2])

    assert judged("slip", 5, 40e-6) == panda.RolloutStatus.OK
    assert judged("slip", 5, 60e-6) == panda.RolloutStatus.SLIPPED
    assert judged("slip", 5, 60e-6, compliance=(1e-3, 0.0)) == panda.RolloutStatus.SLIPPED
    assert judged("slip", 5, 60e-6, compliance=(0.0, 1e-4)) == panda.RolloutStatus.OK
    assert judged("slip", 4, 60e-6) == panda.RolloutStatus.OK, "a free axis"
    assert judged("velocity", 6, -2.7) == panda.RolloutStatus.SPEED_LIMIT
    assert judged("joints", 3, 0.0) == panda.RolloutStatus.JOINT_LIMIT
    assert judged("joints", 0, np.nan) == panda.RolloutStatus.DIVERGED


def test_demonstrations_come_in_chunks_and_only_good_ones() -> None:
    seen: list[tuple[int, int]] = []
    parts = list(
        panda.demonstrations(
            "K", KEY, 12, chunk=BATCH, spread=panda.SPREAD, progress=lambda *done: seen.append(done)
        )
    )
    assert sum(len(part.poses) for part in parts) == 12
    assert all(np.all(part.status_code == panda.RolloutStatus.OK) for part in parts)
    assert seen[-1] == (12, 12)


def pushed(size: float) -> Any:
    """Two of these differ in what they do and in their address, not in their name."""

    def push(t: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jnp.full(3, size) * jnp.sin(t), 0.1 * jnp.cos(t) * jnp.ones(3)

    return push


@pytest.mark.slow
def test_excitation_as_a_function(rigid: dict[str, panda.Demonstration]) -> None:
    """A hand that knows the door: the tool turns and shifts as the function says, where it can."""
    made = demonstrate("C", excitation=pushed(0.2))
    turn = 0.2 * (1 - np.cos(made.times))
    np.testing.assert_allclose(made.slip[..., 0], np.tile(turn, (BATCH, 1)), atol=0.05)
    np.testing.assert_allclose(made.slip[..., 3], np.tile(0.1 * np.sin(made.times), (BATCH, 1)), atol=0.02)


def test_the_hand_leaves_no_free_direction_at_rest() -> None:
    """Also between the axes: of 300 hands all move well above the thresholds along every direction."""
    free = jnp.asarray([1.0, 1.0, 1.0, 0.0, 1.0, 1.0])
    times = jnp.linspace(0, 5, 100)

    @jax.jit
    @jax.vmap
    def twists(key: jax.Array) -> jax.Array:
        return jnp.concatenate(jax.vmap(EXCITATIONS["exciting"](key, free))(times), axis=-1)

    moved = np.asarray(twists(jax.random.split(jax.random.key(0), 300)))
    for kind, threshold in (
        (moved[..., :3], rf.Thresholds().angular),
        (moved[..., 4:], rf.Thresholds().linear),
    ):
        covariance = np.einsum("nki,nkj->nij", kind, kind) / len(times)
        assert np.min(np.linalg.eigvalsh(covariance)) > (1.3 * threshold) ** 2


def test_step_divides_the_sample_time() -> None:
    for dt, substeps in ((0.05, 5), (0.1, 10), (0.033, 4), (0.004, 1)):
        assert sampling(1.0, dt).substeps == substeps


def test_demonstrations_that_cannot_be_made() -> None:
    start = np.array(panda.PANDA.home)
    start[3] = panda.PANDA.limits[1, 3] + 0.01
    with pytest.raises(ValueError, match="are usable"):
        list(panda.demonstrations("B", KEY, 64, chunk=BATCH, start=start))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"arm": "kuka"}, "choose from panda, fr3"),
        ({"excitation": "wild"}, "choose from exciting, brisk"),
        ({"batch": 0}, "batch must be at least 1"),
        ({"start": np.zeros(6)}, r"start must have shape \(7,\)"),
        ({"first": -1}, "first must be at least 0"),
        ({"duration": 0.01}, "Expected 0 < dt <= duration"),
        ({"excitation": None}, "choose from exciting, brisk"),
        ({"spread": 0.1}, "spread must be two numbers"),
        ({"imperfections": "realistic"}, r"Expected Imperfections\(...\), not 'realistic'"),
        (
            {"imperfections": panda.Imperfections(encoder_noise=-0.1)},
            "encoder_noise of Imperfections must not",
        ),
        ({"imperfections": panda.Imperfections(compliance=float("nan"))}, "must not be negative or nan"),
    ],
)
def test_bad_input(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        panda.demonstrate("A", KEY, **options)


def test_unknown_constraint() -> None:
    with pytest.raises(KeyError, match="Revolute joint"):
        panda.demonstrate("Z", KEY)
    with pytest.raises(ValueError, match="a label, a name or a ConstraintFrame, not 3"):
        panda.demonstrate(3, KEY)  # type: ignore[arg-type]


def test_a_named_constraint_is_placed_at_each_start(rng: np.random.Generator) -> None:
    starts = np.asarray(panda.PANDA.home) + 0.1 * rng.normal(size=(3, 7))
    for label in "KL":
        together = panda.frame_on_arm(label, start=starts)
        for i, start in enumerate(starts):
            single = panda.frame_on_arm(label, start=start)
            for got, want in zip(jax.tree.leaves(together), jax.tree.leaves(single), strict=True):
                np.testing.assert_allclose(np.broadcast_to(got, (3, 3))[i], want, atol=1e-14)


def test_geometry_of_another_batch() -> None:
    frame = rf.ConstraintFrame.named("A", position=np.zeros((3, 3)), rotvec=np.zeros((3, 3)))
    with pytest.raises(ValueError, match=r"must have shape \(3,\) or \(2, 3\)"):
        panda.demonstrate(frame, KEY, batch=2)
